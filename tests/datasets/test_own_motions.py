"""Data sets of motions from other sources."""

from pathlib import Path

import numpy as np

import robotdiffuse as rd
from helpers.commands import run
from helpers.refusals import refuses
from robotdiffuse.datasets.rows import problem_of
from robotdiffuse.datasets.shards import check_shard, read_manifest

PANDA = rd.load_robot("panda")
START = np.array([0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785])
FLOOR = rd.Box([0, 0, -0.05], [3, 3, 0.1], name="floor")
COUNT = 24
RNG = np.random.default_rng(0)
MOTIONS = [START + np.linspace(0, 1, 5 + i)[:, None] * RNG.uniform(-0.2, 0.2, 7) for i in range(COUNT)]
SCENES = [rd.Scene([FLOOR, rd.Sphere([0.6, 0.01 * i, 0.9], 0.1)][: 1 + (i % 3 > 0)]) for i in range(COUNT)]


def test_own_motions_are_a_data_set_like_any_other(tmp_path, capsys):
    mixed = [rd.Path(PANDA.joint_names, MOTIONS[0]), MOTIONS[1].tolist(), *MOTIONS[2:]]
    assert rd.write_dataset(mixed, SCENES, tmp_path / "own", "panda", waypoints=48) == COUNT
    manifest = read_manifest(tmp_path / "own")
    assert (manifest.waypoints, manifest.slots, manifest.robot) == (48, 1, "panda")
    shard = check_shard(tmp_path / "own", 0, manifest)
    np.testing.assert_allclose(shard["trajectories"][3][[0, -1]], MOTIONS[3][[0, -1]], atol=1e-6)
    names = [shape.name for shape in problem_of(manifest, PANDA, shard, 1).scene.shapes]
    assert names == ["floor", "sphere"] and shard["line_free"][1]
    batch = next(iter(rd.RopDataset(tmp_path / "own").batches(4)))
    assert batch.trajectories.shape[1:] == (48, 7)
    assert run("data", "check", tmp_path / "own", "--workers", 1, "--no-pybullet") == 0
    assert "24" in capsys.readouterr().out
    refuses("holds data already", rd.write_dataset, MOTIONS, SCENES, tmp_path / "own", PANDA)


def test_what_is_wrong_is_named(tmp_path: Path) -> None:
    far = [*MOTIONS[:2], MOTIONS[2] + 9.0]
    for paths, around, message in (
        ([], SCENES[0], "paths is empty"),
        ([[0.0] * 7], SCENES[0], r"paths\[0\] is .* it must be n x 7 numbers"),
        (far, SCENES[:3], r"paths\[2\], row 0: panda_joint1 is 9 rad; its limits are -2.8973"),
        (MOTIONS, SCENES[:3], "scenes are 3; they must be one rd.Scene, or one for each of 24 paths"),
        (MOTIONS[:1], rd.Scene([rd.Cylinder([1, 1, 1], 0.1, 0.1)]), "only spheres and boxes can be packed"),
    ):
        refuses(message, rd.write_dataset, paths, around, tmp_path / "own")
    assert not (tmp_path / "own" / "manifest.json").exists()
