"""Depth views: points of pixels by hand, clouds as images, what is refused; files of images and clouds."""

import importlib.util
import json
from dataclasses import replace
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import numpy as np
import pytest
from PIL import Image

import robotdiffuse as rd
from helpers.refusals import refuses
from robotdiffuse.core.transforms import quaternion_from_rotation, rotation_about, transform
from robotdiffuse.perception.depth_view import DepthNoise, SeenPoints
from robotdiffuse.perception.depth_view_files import read_depth, read_views, view_entry
from robotdiffuse.scenes.surface_points import sample_surface

K = (50.0, 50.0, 31.5, 23.5)
MATRIX = [[K[0], 0, K[2]], [0, K[1], K[3]], [0, 0, 1]]
CAMERA = {"xyz": [0, 0, 0], "wxyz": [1, 0, 0, 0]}
T = transform(np.array([1.5, 0.2, 0.8]), rotation_about(np.array([0.6, 0.0, 0.8]), 1.1))


def test_points_of_pixels_and_intrinsics_as_a_mapping_or_a_matrix() -> None:
    depth = np.zeros((48, 64))
    depth[10, 20] = 2.0
    depth[0, 0] = np.nan
    depth[1, 1] = np.inf
    depth[2, 2] = -1.0
    by_hand = T @ [(20 - 31.5) / 50 * 2, (10 - 23.5) / 50 * 2, 2.0, 1.0]
    assert np.allclose(rd.DepthView(depth, K, T).points(), by_hand[:3])
    each: list[Any] = [dict(zip(("fx", "fy", "cx", "cy"), K, strict=True)), MATRIX, np.array(MATRIX)]
    for given in each:
        assert rd.DepthView(depth, given, T).intrinsics == K


def test_a_cloud_becomes_the_image_that_its_camera_had() -> None:
    """From a dense cloud of two walls, the nearer one hides the other; the points themselves are kept."""
    u, v = np.meshgrid(np.linspace(-0.5, 0.5, 200), np.linspace(-0.4, 0.4, 160))
    near, far = (np.stack([u * z, v * z, np.full_like(u, z)], -1).reshape(-1, 3) for z in (1.0, 2.0))
    points = np.concatenate([far, near[: len(near) // 2]]) @ T[:3, :3].T + T[:3, 3]
    view = rd.DepthView.from_cloud(points, T)
    h, w = view.depth.shape
    assert np.array_equal(view.points(), points) and h * w <= 320 * 240
    for half, z in ((view.depth[2 : h // 2 - 2, 2:-2], 1.0), (view.depth[h // 2 + 2 : -2, 2:-2], 2.0)):
        assert np.mean(half > 0) > 0.6 and np.allclose(half[half > 0], z, atol=1e-5)
    refuses("none of 10 is in front", rd.DepthView.from_cloud, T[:3, 3] - T[:3, 2] + np.zeros((10, 3)), T)
    for wrong in (np.zeros((3, 2)), np.ones((2, 3)) + 1j, [[0, 0, np.nan]], "abc", []):
        refuses("view.points", rd.DepthView.from_cloud, wrong, T)


def test_what_is_refused() -> None:
    for change, message in (
        ({"depth": np.zeros(5)}, "view.depth is an array of 5"),
        ({"intrinsics": (0.0, 1.0, 0.0, 0.0)}, "fx and fy must be at least"),
        ({"intrinsics": (1.0, 1.0)}, "view.intrinsics is .* 4 finite numbers"),
        ({"intrinsics": {"fx": 1.0}}, r"view\.intrinsics has \['fx'\]; it must have fx, fy, cx, cy"),
        ({"intrinsics": [[460.0, 1, 319.5], [0, 461.0, 239.5], [0, 0, 1]]}, "without skew"),
        ({"T_base_camera": 2 * np.eye(4)}, "the determinant 8 .* it must be a homogeneous transform"),
        ({"T_base_camera": np.diag([1.0, -1.0, 1.0, 1.0])}, "the determinant -1 and the last row"),
        ({"T_base_camera": T.T}, r"the last row \[1\."),
        ({"configuration": [[0.5]]}, "view.configuration is .*; it must be n finite numbers"),
        ({"range": "far"}, "view.range is 'far'; it must be a number"),
        ({"noise": 0.01}, "noise is 0.01; it must be what rd.measure_noise returns"),
        ({"pose_deviation": (0.0, 1.0)}, "view.pose_deviation is .* angle up to 0.5"),
    ):
        refuses(message, rd.DepthView, **{"depth": np.ones((4, 4)), "intrinsics": K, "T_base_camera": T} | change)


def test_depth_files(tmp_path: Path) -> None:
    image = np.random.default_rng(0).integers(0, 4000, (6, 8)).astype(np.uint16)
    Image.fromarray(image).save(tmp_path / "a.png")
    np.save(tmp_path / "a.npy", image / 1000)
    np.savez(tmp_path / "a.npz", depth=image, other=image)
    np.save(tmp_path / "one.npy", image[:, :, None] / 1000)
    np.save(tmp_path / "half.npy", np.array([[1.5]], np.float16))
    assert read_depth(tmp_path / "half.npy") == 1.5, "without a warning of an overflow"
    for name in ("a.png", "a.npy", "a.npz", "one.npy"):
        assert np.allclose(read_depth(tmp_path / name), image / 1000)
    assert np.allclose(read_depth(tmp_path / "a.png", 0.0001), image / 10000)
    Image.fromarray(image.astype(np.uint8)).save(tmp_path / "gray.png")
    np.save(tmp_path / "color.npy", np.zeros((4, 4, 3)))
    (tmp_path / "bad.png").write_bytes(b"no image")
    with ZipFile(tmp_path / "text.npz", "w") as archive:
        archive.writestr("notes.txt", "none")
    for name, message in {
        "gray.png": "grayscale with 16 bits",
        "color.npy": "holds float64 of 4 x 4 x 3",
        "bad.png": "is damaged",
        "text.npz": "notes.txt is b'none'; it must be an array",
        "none.png": "does not exist",
        "a.jpg": "unknown depth image format",
    }.items():
        refuses(message, read_depth, tmp_path / name)
    # integers of 65535 are no returns
    Image.fromarray(np.array([[1000, 65535]], np.uint16)).save(tmp_path / "a.png")
    np.save(tmp_path / "a.npy", np.array([[1000, 65535]], np.uint16))
    np.save(tmp_path / "long.npy", np.array([[1000, 2**32 - 1]], np.uint32))
    for name in ("a.png", "a.npy", "long.npy"):
        assert read_depth(tmp_path / name).tolist() == [[1.0, 0.0]]
    refuses("view.scale is -1.0; it must be a number", read_depth, tmp_path / "a.png", -1.0)


def test_depths_that_files_write_for_infinity_are_infinite() -> None:
    view = rd.DepthView([[1.0, np.inf]], K, T, range=np.float32(4.0))  # type: ignore[arg-type]
    assert rd.DepthView(view_entry(view, None)["depth"], K, T).depth.tolist() == [[1.0, np.inf]] and type(view.range) is float


def test_openexr_depth(tmp_path: Path) -> None:
    OpenEXR = pytest.importorskip("OpenEXR")
    image = np.random.default_rng(0).random((6, 8)).astype(np.float32)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, {"Z": OpenEXR.Channel(image)}).write(str(tmp_path / "a.exr"))
    assert np.array_equal(read_depth(tmp_path / "a.exr"), image)


def test_views_survive_their_files(tmp_path: Path) -> None:
    Image.fromarray(np.full((6, 8), 1500, np.uint16)).save(tmp_path / "a.png")
    points = np.random.default_rng(0).random((50, 3)) + T[:3, 3] + 3 * T[:3, 2]
    np.save(tmp_path / "cloud.npy", points)
    camera = {"xyz": T[:3, 3].tolist(), "wxyz": quaternion_from_rotation(T[:3, :3]).tolist()}
    entries = [
        {"depth": "a.png", "scale": 0.002, "intrinsics": list(K), "camera": camera},
        {"cloud": "cloud.npy", "camera": camera, "configuration": [0.5, 1.0]},
    ]
    entries[0] |= {"range": 4.0, "noise": {"spread": 0.006}, "pose_deviation": [0.005, 0.02]}
    views, _ = read_views(entries, tmp_path)
    assert np.allclose(views[0].depth, 3.0) and views[1].cloud is not None
    written = [view_entry(view, tmp_path) for view in views]
    assert written[0].items() >= {"range": 4.0, "pose_deviation": [0.005, 0.02]}.items()
    assert read_views(written, tmp_path)[0][0].noise == DepthNoise(spread=0.006)
    assert [w["depth" if "depth" in w else "cloud"] for w in written] == ["a.png", "cloud.npy"]
    inline = [rd.DepthView(views[0].depth, K, T), rd.DepthView.from_cloud(points, T)]
    for view in (*read_views(written, tmp_path)[0], *read_views([view_entry(v, None) for v in inline], tmp_path)[0]):
        twin = views[0] if view.cloud is None else views[1]
        assert np.array_equal(view.depth, twin.depth) and np.allclose(view.points(), twin.points())
        assert np.allclose(view.T_base_camera, T)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.json", {"fx": K[0], "fy": K[1], "ppx": K[2], "ppy": K[3], "width": 8, "model": "brown"}),
        ("a.json", {"width": 8, "intrinsic_matrix": np.ravel(MATRIX, "F").tolist()}),  # Open3D
        ("a.json", {"cam_K": np.ravel(MATRIX).tolist(), "depth_scale": 1.0}),
        ("camera_info.yaml", {"camera_matrix": {"rows": 3, "cols": 3, "data": np.ravel(MATRIX).tolist()}}),
        ("a.txt", "\n".join(" ".join(map(str, row)) for row in MATRIX)),
        ("a.npy", MATRIX),
    ],
)
def test_intrinsics_beside_an_image(name: str, content: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    Image.fromarray(np.full((6, 8), 1500, np.uint16)).save(tmp_path / "a.png")
    if name.endswith("npy"):
        np.save(tmp_path / name, content)
    else:
        (tmp_path / name).write_text(content if isinstance(content, str) else json.dumps(content))
    entry: dict[str, Any] = {"depth": "a.png", "camera": CAMERA}
    if name.startswith("camera"):
        entry["intrinsics"] = name
    monkeypatch.chdir(tmp_path.parent)
    before = dict(entry)
    for folder in (tmp_path, Path(tmp_path.name)):
        assert read_views([entry], folder)[0][0].intrinsics == K
    assert entry == before, "regression: the name of the file was written into it"


@pytest.mark.parametrize(
    "stated", [{"width": 16, "height": 12}, {"width": 6, "height": 8}, {"image_width": 16, "image_height": 12}]
)
def test_intrinsics_in_a_file_for_images_of_another_size(stated: dict[str, int], tmp_path: Path) -> None:
    """Regression: the size in the file was ignored, and resized and transposed images were taken as they were."""
    Image.fromarray(np.full((6, 8), 1500, np.uint16)).save(tmp_path / "a.png")
    content = {"fx": K[0], "fy": K[1], "cx": K[2], "cy": K[3]}
    entry = {"depth": "a.png", "intrinsics": "camera.json", "camera": CAMERA}
    (tmp_path / "camera.json").write_text(json.dumps(content | stated))
    refuses(r"camera.json is for images of .* pixels, h x w; this one has \(6, 8\)", read_views, [entry], tmp_path)
    (tmp_path / "camera.json").write_text(json.dumps(content | {"width": 8, "height": 6, "coeffs": [0.1, 0, 0, 0, 0]}))
    (view,), notes = read_views([entry], tmp_path)
    assert view.intrinsics == K
    assert notes[0].endswith("camera.json: the distortion coeffs is ignored; the image must be rectified")


def test_what_is_wrong_in_a_file(tmp_path: Path) -> None:
    for name in "abc":
        Image.fromarray(np.full((6, 8), 1500, np.uint16)).save(tmp_path / f"{name}.png")
    (tmp_path / "b.json").write_text('{"K": [1.0, 2.0]}')
    (tmp_path / "d.json").write_text('{"K": {"rows": 3}}')
    (tmp_path / "c.json").write_text('{"fx": "wide", "fy": 1.0, "cx": 1.0, "cy": 1.0}')
    np.save(tmp_path / "image.npy", np.ones((6, 8)))
    for entry, message in (
        ({"cloud": "a.ply", "camera": {}, "scale": 1}, r"unknown field of views\[0\]"),
        ({"cloud": "a.ply", "camera": CAMERA | {"xyz": [0, 0]}}, r"views\[0\]: camera.xyz"),
        ({"cloud": "a.ply", "camera": CAMERA}, "a.ply does not exist"),
        ("a.png", r"views\[0\] is 'a.png'"),
        ({"depth": "a.png", "camera": CAMERA}, r"views\[0\] has no intrinsics"),
        ({"depth": "b.png", "camera": CAMERA}, "b.json holds no intrinsics"),
        ({"depth": "c.png", "camera": CAMERA}, "view.intrinsics is"),
        ({"depth": "a.png", "camera": CAMERA, "intrinsics": "K.mat"}, "unknown intrinsics format of .*K.mat: '.mat'"),
        ({"depth": "a.png", "camera": CAMERA, "intrinsics": "image.npy"}, "image.npy holds no intrinsics"),
        ({"depth": "a.png", "camera": CAMERA, "intrinsics": "d.json"}, "d.json holds no intrinsics"),
    ):
        refuses(message, read_views, [entry], tmp_path)


def test_points_that_were_seen_are_sampled_as_a_cloud() -> None:
    """Regression: the network needed surface points of a kind of point cloud, and the sampling looked for a mesh."""
    points = np.random.default_rng(0).uniform(0.2, 0.5, (50, 3))
    found = sample_surface(rd.Scene([SeenPoints(points, 0.01)]), 20, np.random.default_rng(1))
    assert len(found) == 20 and all((point == points).all(axis=1).any() for point in found)


def test_small_images_cannot_fill_the_memory(tmp_path: Path) -> None:
    """Regression: a PNG of 350 kB unpacked to gigabytes, and an EXR image took 48 s."""
    huge = np.zeros((4097, 4096), np.uint16)
    Image.fromarray(huge).save(tmp_path / "huge.png")
    np.savez_compressed(tmp_path / "huge.npz", huge)
    endings = ["png", "npz"]
    if importlib.util.find_spec("OpenEXR"):
        import OpenEXR

        OpenEXR.File({}, {"Z": huge.astype(np.float16)}).write(str(tmp_path / "huge.exr"))
        endings.append("exr")
    for ending in endings:
        refuses("16,781,312 pixels; it must have at most 16,777,216", read_depth, tmp_path / f"huge.{ending}")


def test_moved_clouds_and_noisy_images_are_saved_as_they_are(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Regressions: the name of the file was written, also relative to another working folder."""
    monkeypatch.chdir(tmp_path)
    np.save("c.npy", [[0.5, 0.0, 0.2], [0.6, 0.1, 0.3]])
    np.save("d.npy", np.ones((8, 8)))
    entries = [{"cloud": "c.npy", "camera": CAMERA}, {"depth": "d.npy", "intrinsics": [9, 9, 4, 4], "camera": CAMERA}]
    (cloud, image), _ = read_views(entries, Path())
    moved = cloud.moved(transform(np.array([0.0, 0.0, 1.0])))
    assert view_entry(moved, tmp_path)["cloud"] == moved.points().tolist()
    noisy = DepthNoise(spread=0.05).applied(image, np.random.default_rng(0))
    replaced = replace(image, depth=np.full((8, 8), 2.0))
    for one in (noisy, replaced):
        assert view_entry(one, tmp_path)["depth"] == one.depth.tolist()
    monkeypatch.chdir(Path(__file__).parent)
    assert view_entry(image, tmp_path)["depth"] == "d.npy"
