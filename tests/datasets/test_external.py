"""Data sets of motions from other sources: any motions, and the file layout of the paper's authors, both read as written."""

import zipfile
from pathlib import Path

import numpy as np

import robotdiffuse as rd
from helpers.box_arm import box_arm
from helpers.commands import Said
from helpers.panda import GOAL, HOME, PANDA, START
from helpers.refusals import refuses
from helpers.stores import line, random_arrays, record, write_motions, write_store
from robotdiffuse.datasets import external as robot_npz
from robotdiffuse.datasets.external import export_npz, import_npz
from robotdiffuse.datasets.shards import SPLITS, check_shard, problem_of, read_manifest, read_shard, write_shard
from robotdiffuse.evaluation.checks import check_data
from robotdiffuse.scenes.packed_scenes import SPHERE


def made(folder: Path) -> Path:
    """Straight motions between two spheres; the first motion passes through a sphere."""
    rows = []
    for i in range(3):
        spheres = rd.Sphere([0.5 + i, 0.0, 0.5], 0.25), rd.Sphere([-0.9, 0.1 * i, 0.4], 0.25)
        rows.append(record(PANDA, rd.Scene(spheres), line(START, GOAL, 254)))
    write_motions(folder / "set", PANDA, rows, waypoints=254)
    export_npz(folder / "set", folder / "robot.npz")
    return folder / "robot.npz"


def test_export_for_the_authors(tmp_path):
    write_store(tmp_path, PANDA, (30, 20))
    arrays = random_arrays(PANDA, 3, np.random.default_rng(1))
    arrays["obstacle_kinds"][:] = [SPHERE, SPHERE, SPHERE, 0]  # one too many
    arrays["obstacle_kinds"][0] = [SPHERE, 0, 0, SPHERE]
    arrays["obstacle_params"][0, 3, :3] = [1, 2, 3]
    write_shard(tmp_path, 2, arrays, {})
    count, left_out = export_npz(tmp_path, tmp_path / "robot.npz")
    with np.load(tmp_path / "robot.npz") as file:
        x = file["x_train"]
        y = file["y_train"]
    kinds = np.concatenate([read_shard(tmp_path, i)["obstacle_kinds"] for i in (0, 1)])
    assert left_out == 53 - count  # 30 + 20 + 3 motions
    assert count == len(x) == ((kinds == SPHERE).sum(1) == 2).sum() + 1
    assert x.shape[1:] == (254, 7) and y.shape[1:] == (23,)
    assert x.dtype == y.dtype == np.float32
    np.testing.assert_array_equal(x[-1], arrays["trajectories"][0])
    centers = arrays["obstacle_params"][0, [0, 3], :3].reshape(-1)
    goal = arrays["goals"][0, arrays["goal_index"][0]]
    np.testing.assert_array_equal(y[-1], np.concatenate([arrays["start"][0], goal, centers, arrays["target_pose"][0, 4:]]))
    np.testing.assert_array_equal(y[:, :14], np.concatenate([x[:, 0], x[:, -1]], 1))
    refuses(r"the folder .*nothing does not exist", export_npz, tmp_path, tmp_path / "nothing" / "robot.npz")


def test_what_cannot_be_exported(tmp_path):
    store = tmp_path / "arm"
    write_store(store, box_arm(), (3,), 20)
    refuses(r"20 waypoints of 3 joints; robot\.npz holds 254 waypoints of 7", export_npz, store, tmp_path / "robot.npz")
    write_store(tmp_path / "panda", PANDA, ())
    refuses("holds no shards; make some with", export_npz, tmp_path / "panda", tmp_path / "robot.npz")
    arrays = random_arrays(PANDA, 3, np.random.default_rng(1)) | {"obstacle_kinds": np.full((3, 4), SPHERE, np.uint8)}
    write_shard(tmp_path / "panda", 0, arrays, {})
    refuses("no scene of exactly two spheres", export_npz, tmp_path / "panda", tmp_path / "robot.npz")
    assert not (tmp_path / "robot.npz").exists() and len([*tmp_path.iterdir()]) == 2


def test_what_was_exported_is_a_data_set_again(tmp_path):
    file = made(tmp_path)
    seen = []
    assert import_npz(file, tmp_path / "again", progress=lambda *n: seen.append(n)) == 3
    assert seen == [(3, 3)]
    manifest = read_manifest(tmp_path / "again")
    before = read_shard(tmp_path / "set", 0)
    shard = check_shard(tmp_path / "again", 0, manifest)
    for name in ("trajectories", "start", "cost", "detour"):
        np.testing.assert_allclose(shard[name], before[name], rtol=1e-6)
    np.testing.assert_array_equal(shard["goals"][:, 0], shard["trajectories"][:, -1])
    np.testing.assert_array_equal(shard["obstacle_params"], before["obstacle_params"][:, :2])
    np.testing.assert_allclose(shard["clearance"], before["clearance"].clip(max=shard["clearance"]), atol=1e-6)
    assert shard["line_free"].tolist() == [False, True, True]
    tip = PANDA.fk(shard["goals"][0, 0].astype(float), PANDA.tip)
    np.testing.assert_allclose(shard["target_pose"][:, 4:], [tip[:3, 3]] * 3, atol=1e-6)
    floor, *spheres = problem_of(manifest, PANDA, shard, 2).scene.shapes
    assert isinstance(floor, rd.Box) and floor.size.tolist() == [2.0, 2.0, 0.1]
    assert [type(shape) for shape in spheres] == [rd.Sphere, rd.Sphere]
    assert sum(len(rd.RopDataset(tmp_path / "again", split, points=8)) for split in SPLITS) == 3
    import_npz(file, tmp_path / "small", radius=0.2)
    assert (read_shard(tmp_path / "small", 0)["obstacle_params"][..., 3] == np.float32(0.2)).all()
    export_npz(tmp_path / "again", tmp_path / "twice.npz")
    with np.load(file) as first, np.load(tmp_path / "twice.npz") as second:
        np.testing.assert_array_equal(first["x_train"], second["x_train"])
        np.testing.assert_array_equal(first["y_train"][:, :20], second["y_train"][:, :20])


def test_a_header_that_breaks_off_is_one_line(tmp_path):
    """NumPy passes the header to Python's tokenizer, whose errors are no ValueErrors; found by fuzzing."""
    file = tmp_path / "robot.npz"
    with zipfile.ZipFile(file, "w") as archive:
        header = b"{'descr': '<f4', 'shape': (3,"
        archive.writestr("x_train.npy", b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header)
    refuses(r"robot\.npz is damaged", import_npz, file, tmp_path / "out")


def test_what_cannot_be_imported(tmp_path, monkeypatch):
    with np.load(made(tmp_path / "good")) as good:
        x, y = good["x_train"], good["y_train"]
    endless, moved = x.copy(), y.copy()
    moved[1, 8] += 0.01
    endless[2, 5, 0] = np.inf
    file = tmp_path / "bad.npz"
    out = tmp_path / "out"
    for arrays, message in [
        ({"x_train": x}, "is damaged: .*y_train"),
        ({"x_train": x[:, :200], "y_train": y}, r"x_train has shape \(3, 200, 7\); it must be n x 254 x 7"),
        ({"x_train": x, "y_train": y[:2]}, r"y_train has shape \(2, 23\); it must be n x 23"),
        ({"x_train": x[:0], "y_train": y[:0]}, "with n at least 1"),
        ({"x_train": endless, "y_train": y}, "x_train holds numbers that are not finite"),
        ({"x_train": x, "y_train": moved}, "row 1 has a goal that differs from its last waypoint by 0.01"),
        ({"x_train": np.array(["text"]), "y_train": y}, "is damaged"),
    ]:
        np.savez(file, allow_pickle=False, **arrays)
        refuses(message, import_npz, file, out)
        assert not out.exists()
    # Regressions: a file in degrees was imported, and an .npy file was called damaged
    np.savez(file, x_train=50 * x, y_train=y * np.array([50.0] * 14 + [1.0] * 9))
    refuses(r".*bad.npz: x_train\[0\], row 0: panda_joint", import_npz, file, out)
    np.save(tmp_path / "single.npy", x)
    refuses("unknown data set format of .*'.npy'; known: .npz", import_npz, tmp_path / "single.npy", out)
    file.write_bytes(b"PK damaged")
    for wrong in (file, tmp_path / "single.npy", tmp_path / "nothing.npz"):
        refuses(f"{wrong.name}", import_npz, wrong, out)
    whole = tmp_path / "good" / "robot.npz"
    refuses("holds data already", import_npz, whole, tmp_path / "good" / "set")
    refuses("radius is 0", import_npz, whole, out, radius=0.0)
    monkeypatch.setattr(robot_npz, "load_robot", lambda name: box_arm())
    refuses(r"has 3 joints; robot\.npz holds 7", import_npz, whole, out, robot="arm.urdf")


FLOOR = rd.Box([0, 0, -0.05], [3, 3, 0.1], name="floor")
COUNT = 24
RNG = np.random.default_rng(0)
MOTIONS = [HOME + np.linspace(0, 1, 5 + i)[:, None] * RNG.uniform(-0.2, 0.2, 7) for i in range(COUNT)]
SCENES = [rd.Scene([FLOOR, rd.Sphere([0.6, 0.01 * i, 0.9], 0.1)][: 1 + (i % 3 > 0)]) for i in range(COUNT)]


def test_own_motions_are_a_data_set_like_any_other(tmp_path, said: Said):
    mixed = [rd.Path(PANDA.joint_names, MOTIONS[0]), MOTIONS[1].tolist(), *MOTIONS[2:]]
    assert rd.write_dataset(mixed, SCENES, tmp_path / "own", "panda", waypoints=48) == COUNT
    manifest = read_manifest(tmp_path / "own")
    assert (manifest.waypoints, manifest.slots, manifest.robot) == (48, 1, "panda")
    shard = check_shard(tmp_path / "own", 0, manifest)
    np.testing.assert_allclose(shard["trajectories"][3][[0, -1]], MOTIONS[3][[0, -1]], atol=1e-6)
    names = [shape.name for shape in problem_of(manifest, PANDA, shard, 1).scene.shapes]
    assert names == ["floor", "sphere"] and shard["line_free"][1]
    assert next(iter(rd.RopDataset(tmp_path / "own").batches(4))).trajectories.shape[1:] == (48, 7)
    assert "24" in said(0, "data", "check", tmp_path / "own", "--workers", 1, "--no-pybullet")
    refuses("holds data already", rd.write_dataset, MOTIONS, SCENES, tmp_path / "own", PANDA)


def test_own_motions_turn_the_short_way_keep_the_limits_and_may_be_closed(tmp_path: Path) -> None:
    """Regression: logs wrapped to ±pi were stored as whole turns, and `data check` refused closed or slightly wide motions."""
    wrapped = np.tile([0, 0.3, 0, 1.2, 0, 0.8, 0.0], (9, 1))
    wrapped[:, 0] = (np.linspace(2.8, 3.6, 9) + np.pi) % (2 * np.pi) - np.pi
    rd.write_dataset([wrapped] * COUNT, SCENES, tmp_path / "gen3", "gen3", waypoints=32)
    np.testing.assert_allclose(read_shard(tmp_path / "gen3", 0)["cost"], 0.8, atol=1e-5)
    wide = HOME + np.eye(7)[0] * (PANDA.upper[0] + 9e-4 - HOME[0])
    rd.write_dataset([[HOME, wide, HOME]] * COUNT, SCENES, tmp_path / "own", "panda", waypoints=17)
    assert not check_data(tmp_path / "own", pybullet=False).findings
    opened = rd.load_robot("panda", locked={"panda_finger_joint1": 0.0})
    refuses("as it is", rd.write_dataset, MOTIONS, SCENES, tmp_path / "new", opened)


def test_what_is_wrong_is_named(tmp_path: Path) -> None:
    far = [*MOTIONS[:2], MOTIONS[2] + 9.0]
    for paths, around, message in (
        ([], SCENES[0], "paths is empty"),
        ([[0.0] * 7], SCENES[0], r"paths\[0\] is .* it must be n x 7 numbers"),
        (far, SCENES[:3], r"paths\[2\], row 0: panda_joint1 is 9 rad; its limits are -2.8973"),
        (MOTIONS, SCENES[:3], "scenes has 3 entries; give one rd.Scene, or one for each of 24 paths"),
        (MOTIONS[:1], rd.Scene([rd.Cylinder([1, 1, 1], 0.1, 0.1)]), "only spheres and boxes can be packed"),
    ):
        refuses(message, rd.write_dataset, paths, around, tmp_path / "own")
    assert not (tmp_path / "own" / "manifest.json").exists()


def test_joint_names_and_contacts_of_motions_are_not_dropped(tmp_path: Path) -> None:
    scene = rd.Scene([rd.Box(PANDA.fk(GOAL)[:3, 3], [0.05, 0.05, 0.05], name="part")], allowed_contacts={"part": "all"})
    path = rd.Path(rd.load_robot("gen3").joint_names, np.stack([START, GOAL]))
    refuses(r"paths\[0\].joint_names is joint_1", rd.write_dataset, [path] * 3, scene, tmp_path / "own", PANDA)
    refuses("allowed_contacts with part", rd.write_dataset, [[START, GOAL]], scene, tmp_path / "own", PANDA)
    np.savez(tmp_path / "robot.npz", x_train=np.float32(1), y_train=np.zeros((1, 23), np.float32))
    refuses("x_train has shape", import_npz, tmp_path / "robot.npz", tmp_path / "set")
