"""Pictures and replays: their content, that replays are self-contained, and errors for bad input."""

import base64
import json
import re
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

import robotdiffuse as rd
from helpers.visual_bundles import visual_meshes, write_visual
from robotdiffuse.core.errors import InputError
from robotdiffuse.core.results import PlanResult
from robotdiffuse.core.transforms import transform
from robotdiffuse.core.types import Path, Status, Trajectory
from robotdiffuse.robots.kinematics import link_pose
from robotdiffuse.robots.robot import ConvexMesh, Joint, Robot
from robotdiffuse.robots.visual_meshes import VisualMesh, load_visual
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import Box, Capsule, Cylinder, Mesh, PointCloud, Sphere
from robotdiffuse.visualization import PictureSettings, write_picture, write_replay
from robotdiffuse.visualization.picture import render
from robotdiffuse.visualization.style import creased, decimated, dense, robot_surfaces, tool_point, trace

SMALL = PictureSettings(width=320, height=200, ghosts=2)
CORNERS = np.array([[x, y, z] for x in (-1.0, 1) for y in (-1, 1) for z in (-1, 1)])
FACES = "013 032 467 475 045 051 237 276 026 064 157 173"
CUBE = np.array([[int(corner) for corner in face] for face in FACES.split()])


def bar(length: float) -> ConvexMesh:
    """A square bar of 8 cm along z, from the origin."""
    return ConvexMesh(CORNERS * [0.04, 0.04, length / 2] + [0, 0, length / 2], CUBE)


@pytest.fixture(scope="module")
def arm() -> Robot:
    """Three bars: a turning pillar, a hinge with its axis off z, a slide."""
    quarter = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    z, y = np.array([0.0, 0, 1]), np.array([0.0, 1, 0])
    limits = (-3.0, 3.0, 2.0, 5.0, 50.0)
    joints = (
        Joint("turn", "revolute", "base", "pillar", transform(np.array([0, 0, 0.1])), z, *limits),
        Joint("hinge", "revolute", "pillar", "arm", transform(np.array([0, 0, 0.4]), quarter), y, *limits),
        Joint("slide", "prismatic", "arm", "tip", transform(np.array([0, 0, 0.3])), z, *limits),
    )
    meshes = {"base": (bar(0.1),), "pillar": (bar(0.4),), "arm": (bar(0.3),), "tip": (bar(0.2),)}
    spheres = {"tip": np.array([[0, 0, 0.1, 0.12]])}
    return Robot("three_bars", "base", "tip", joints, spheres, meshes)


@pytest.fixture(scope="module")
def scene() -> Scene:
    cloud = np.random.default_rng(3).uniform(-0.1, 0.1, (500, 3)) + np.array([0.2, 0.5, 0.6])
    tilted = np.array([0.9, 0.0, 0.1, 0.2])
    return Scene(
        [
            Sphere(np.array([-0.5, 0.4, 0.5]), 0.1),
            Box(np.array([0.4, 0.4, 0.1]), np.array([0.1, 0.2, 0.2]), tilted),
            Cylinder(np.array([-0.4, -0.4, 0.2]), 0.05, 0.4),
            Capsule(np.array([0.4, -0.5, 0.3]), 0.05, 0.2, tilted),
            PointCloud(cloud, 0.01),
            Mesh(0.1 * CORNERS, CUBE, np.array([0.0, 0.7, 0.3])),
        ]
    )


@pytest.fixture(scope="module")
def motion(arm: Robot) -> Trajectory:
    t = np.linspace(0, 2.0, 501)
    q = np.stack([-1.2 + 1.2 * t, 0.3 + 0.2 * t, 0.1 * t], axis=1)
    return Trajectory(arm.joint_names, t, q, np.gradient(q, t, axis=0), np.zeros_like(q))


def page_data(text: str) -> dict:
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', text, re.S)
    assert found is not None
    return json.loads(found[1])


def test_replay_holds_everything(arm, scene, motion, tmp_path):
    path = Path(arm.joint_names, motion.positions)
    result = PlanResult(
        Status.SOLVED,
        "",
        "robotdiffuse",
        arm.name,
        0.0123,
        0,
        "refinement",
        path,
        motion,
        min_clearance=0.042,
    )
    file = tmp_path / "replay.html"
    write_replay(
        arm, scene, motion, file, result=result, title="a < b </script> {{data}}", candidates=(path, path)
    )
    text = file.read_text("utf-8")
    data = page_data(text)
    assert "a &lt; b &lt;/script&gt; {{data}}" in text
    assert data["robot"]["joints"] == list(arm.joint_names)
    assert [shape["kind"] for shape in data["scene"]] == [shape.kind for shape in scene.shapes]
    assert len(data["times"]) == len(data["positions"]) == 121, "60 rows a second and no more"
    np.testing.assert_allclose(data["positions"][0], motion.positions[0], atol=1e-5)
    np.testing.assert_allclose(data["positions"][-1], motion.positions[-1], atol=1e-5)
    assert np.shape(data["candidates"]) == (2, 120, 3)
    assert dict(data["facts"])["clearance"] == "42.0 mm"
    assert dict(data["facts"])["planner"] == "robotdiffuse · refinement"
    assert data["robot"]["spheres"] == [[3, 0.0, 0.0, 0.1, 0.12]]
    assert file.stat().st_size < 800_000


def test_replay_loads_nothing(arm, scene, motion, tmp_path):
    file = tmp_path / "replay.html"
    write_replay(arm, scene, motion, file)
    text = file.read_text("utf-8")
    # The one address is the name of a namespace, which no browser opens.
    assert set(re.findall(r"https?://[^\s\"'`)]+", text)) <= {"http://www.w3.org/1999/xhtml"}
    for loading in (r"<link\b", r"\bsrc\s*=\s*[\"']", r"@import", r"url\((?!#)", r"\bimport\s*\("):
        assert not re.search(loading, text.split("<script>")[0]), loading
    assert not re.search(r"<script[^>]+src", text)


def test_replay_geometry_decodes_to_the_meshes(arm, scene, motion, tmp_path):
    write_replay(arm, scene, motion, tmp_path / "replay.html")
    data = page_data((tmp_path / "replay.html").read_text("utf-8"))
    for surface, part in zip(robot_surfaces(arm), data["robot"]["frames"], strict=True):
        raw = np.frombuffer(base64.b64decode(part["vertices"]), "<u2").reshape(-1, 3)
        np.testing.assert_allclose(part["low"] + raw * part["step"], surface.vertices, atol=1e-5)
        faces = np.frombuffer(base64.b64decode(part["faces"]), "<u2").reshape(-1, 3)
        np.testing.assert_array_equal(faces, surface.faces)


@pytest.mark.parametrize("rows", [1, 2])
def test_path_that_does_not_move(arm, rows, tmp_path):
    path = Path(arm.joint_names, np.tile([0.1, 0.2, 0.1], (rows, 1)))
    write_replay(arm, Scene(), path, tmp_path / "still.html", candidates=[path])
    write_picture(arm, Scene([PointCloud(np.zeros((0, 3)))]), path, tmp_path / "still.png", settings=SMALL)
    assert page_data((tmp_path / "still.html").read_text("utf-8"))["times"] == [0.0] * rows


def test_large_input_stays_small(arm, tmp_path):
    rng = np.random.default_rng(5)
    n = 330
    x, y = np.meshgrid(np.linspace(0, 1, n), np.linspace(0, 1, n))
    vertices = np.stack([x, y, 0.05 * np.sin(20 * x)], axis=-1).reshape(-1, 3)
    i = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).reshape(-1)
    faces = np.concatenate([np.stack([i, i + 1, i + n], 1), np.stack([i + 1, i + n + 1, i + n], 1)])
    scene = Scene([PointCloud(rng.uniform(-1, 1, (300_000, 3))), Mesh(vertices, faces)])
    write_replay(arm, scene, Path(arm.joint_names, rng.uniform(0, 0.2, (50_000, 3))), tmp_path / "large.html")
    assert (tmp_path / "large.html").stat().st_size < 3_000_000
    fewer, kept = decimated(vertices, faces)
    assert 10_000 < len(kept) <= 60_000
    np.testing.assert_allclose(np.ptp(fewer, axis=0), np.ptp(vertices, axis=0), atol=0.02)


def test_picture_shows_the_tip_where_kinematics_puts_it(arm, motion, tmp_path):
    pixels, camera = render(arm, Scene(), motion, SMALL)
    middle_of_tip = link_pose(arm, motion.positions[-1], "tip") @ [0, 0, 0.1, 1]
    column, row, _ = camera.project(middle_of_tip[None, :3])[0].astype(int)
    away, _ = render(arm, Scene(), Path(arm.joint_names, motion.positions[:1]), replace(SMALL, ghosts=0))
    assert away.shape == (200, 320, 3)
    assert 0 < column < 320 and 0 < row < 200
    patch = pixels[row - 2 : row + 3, column - 2 : column + 3].reshape(-1, 3).astype(int)
    assert np.ptp(patch, axis=1).max() < 60, "the arm is grey; the trace ends beyond the middle of the tip"
    background = pixels[3, 3].astype(int)
    assert np.abs(patch - background).max() > 12

    write_picture(arm, Scene(), motion, tmp_path / "motion.png", settings=SMALL)
    with Image.open(tmp_path / "motion.png") as image:
        assert image.format == "PNG" and image.size == (320, 200)


def test_picture_shows_obstacles_in_their_colour(arm, scene, motion):
    pixels, camera = render(arm, Scene([scene.shapes[0]]), motion, SMALL)
    column, row, _ = camera.project(np.array([[-0.5, 0.4, 0.5]]))[0].astype(int)
    r, g, b = pixels[row, column].astype(int)
    assert r > g + 25 > b + 25


def test_picture_is_the_same_twice(arm, scene, motion):
    first, _ = render(arm, scene, motion, SMALL)
    second, _ = render(arm, scene, motion, SMALL)
    np.testing.assert_array_equal(first, second)


def test_trace_follows_the_outer_end_of_the_tip(arm, motion):
    tool = tool_point(arm, robot_surfaces(arm))
    points = trace(arm, tool, motion.positions[::100])
    for q, point in zip(motion.positions[::100], points, strict=True):
        np.testing.assert_allclose(point, (link_pose(arm, q, "tip") @ [0, 0, 0.2, 1])[:3], atol=1e-12)


def test_creases_keep_edges_of_a_box_and_smooth_a_ball():
    import trimesh

    box = creased(CORNERS, CUBE, np.ones((12, 3)))
    assert len(box.vertices) == 24
    assert np.sort(np.abs(box.normals), axis=1)[:, :2].max() < 1e-12
    ball = trimesh.creation.icosphere(subdivisions=3)
    smooth = creased(
        ball.vertices.view(np.ndarray), ball.faces.view(np.ndarray), np.ones((len(ball.faces), 3))
    )
    assert len(smooth.vertices) == len(ball.vertices)
    assert (smooth.normals * smooth.vertices).sum(axis=1).min() > 0.999


def test_dense_steps_are_equal():
    q = dense(np.array([[0.0, 0], [1, 0], [1, 3]]), 41)
    np.testing.assert_allclose(np.linalg.norm(np.diff(q, axis=0), axis=1), 0.1, atol=1e-12)


def test_without_meshes_the_spheres_are_drawn(arm):
    drawn = load_visual(replace(arm, meshes={}))
    assert list(drawn) == ["tip"]
    assert np.linalg.norm(drawn["tip"][0].vertices - [0, 0, 0.1], axis=1).max() == pytest.approx(0.12)


def test_visual_meshes_survive_the_file_and_must_agree(arm, tmp_path, monkeypatch):
    colors = np.tile(np.array([[10, 20, 30], [200, 100, 0]], np.uint8), (6, 1))
    written = VisualMesh(arm.meshes["tip"][0].vertices, CUBE, colors)
    elsewhere = VisualMesh(written.vertices + 0.1, CUBE, colors)
    folder = tmp_path / "data" / arm.name
    folder.mkdir(parents=True)
    write_visual({"tip": written, "arm": elsewhere}, folder / "visual.npz")
    monkeypatch.setattr("robotdiffuse.robots.visual_meshes.files", lambda _: tmp_path)
    drawn = load_visual(arm)
    np.testing.assert_allclose(drawn["tip"][0].vertices, written.vertices, atol=2.5e-5)
    np.testing.assert_array_equal(drawn["tip"][0].faces, CUBE)
    np.testing.assert_array_equal(drawn["tip"][0].colors, colors)
    np.testing.assert_array_equal(drawn["arm"][0].vertices, arm.meshes["arm"][0].vertices)


def test_visual_meshes_of_a_urdf(tmp_path):
    import trimesh

    trimesh.Trimesh(CORNERS, CUBE, process=False).export(tmp_path / "cube.stl")
    urdf = """<robot name="r"><link name="a"><visual><origin xyz="0 0 1" rpy="0 0 1.5707963267948966"/>
      <geometry><mesh filename="{}" scale="1 2 3"/></geometry></visual></link></robot>"""
    (tmp_path / "r.urdf").write_text(urdf.format("cube.stl"))
    meshes = visual_meshes(tmp_path / "r.urdf")
    assert list(meshes) == ["a"] and len(meshes["a"].vertices) == 8 and len(meshes["a"].faces) == 12
    np.testing.assert_allclose(meshes["a"].vertices.min(0), [-2, -1, -2], atol=1e-6)
    np.testing.assert_allclose(meshes["a"].vertices.max(0), [2, 1, 4], atol=1e-6)
    (tmp_path / "r.urdf").write_text(urdf.format("package://gone/missing.stl"))
    with pytest.raises(InputError, match=r"package://gone/missing\.stl"):
        visual_meshes(tmp_path / "r.urdf")


@pytest.mark.parametrize(
    "name", ["motion.jpg", "motion", "missing/motion.{}", "folder.{}", "folder.{}/motion.{}x"]
)
@pytest.mark.parametrize(("write", "ending"), [(write_picture, "png"), (write_replay, "html")])
def test_bad_output_is_one_line(arm, motion, write, ending, name, tmp_path):
    (tmp_path / f"folder.{ending}").mkdir()
    with pytest.raises(InputError) as error:
        write(arm, Scene(), motion, tmp_path / name.format(ending, ending))
    assert "\n" not in str(error.value)
    assert [entry.name for entry in tmp_path.iterdir()] == [f"folder.{ending}"], "nothing is left behind"


@pytest.mark.parametrize("settings", [{"width": 0}, {"height": 3}, {"ghosts": -1}])
def test_bad_settings(settings):
    with pytest.raises(InputError):
        PictureSettings(**settings)


@pytest.mark.parametrize("flat", [[[1, 1, 1]] * 3, [[1, 1, 1], [2, 2, 2], [3, 3, 3]]])
def test_meshes_without_area_are_drawn(flat: list[list[int]]) -> None:
    surface = creased(np.array(flat, np.float64), np.array([[0, 1, 2]]), np.ones((1, 3)))
    assert np.isfinite(surface.normals).all()


def test_names_of_obstacles_stay_text_in_a_replay(tmp_path) -> None:
    panda, name = rd.load_robot("panda"), "</script><script>alert(1)</script>"
    q = np.zeros((2, panda.dof))
    motion = rd.Trajectory(panda.joint_names, np.array([0.0, 1.0]), q, 0 * q, 0 * q)
    file = tmp_path / "replay.html"
    write_replay(panda, rd.Scene([rd.Sphere([1, 1, 1], 0.1, name=name)]), motion, file)
    text = file.read_text("utf-8")
    assert "<script>alert" not in text
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', text, re.S)
    assert found is not None and name in json.dumps(json.loads(found.group(1)), ensure_ascii=False)
