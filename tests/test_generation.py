"""The data factory: the same data whatever happens, and motions that are what they claim to be."""

import json
from dataclasses import asdict, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from numpy import ndarray

from robotdiffuse import generation
from robotdiffuse.collision import CollisionChecker
from robotdiffuse.errors import InputError
from robotdiffuse.generation import GenerationSettings, generate, resample
from robotdiffuse.problem import JointGoal
from robotdiffuse.robots import load_robot
from robotdiffuse.rop_problems import sample_problem
from robotdiffuse.scenes.rop import ROP, ROP_DENSE, pack_scene

SETTINGS = GenerationSettings(
    problems=36, shard=12, seed=3, dense_share=0.5, trivial_share=0.5, iterations=400, attempts=1
)


def data(folder: Path) -> dict[str, ndarray]:
    shards = [np.load(file) for file in sorted(folder.glob("shard_*.npz"))]
    return {key: np.concatenate([shard[key] for shard in shards]) for key in shards[0]}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("data")
    seen: list[tuple[int, int]] = []
    count = generate(SETTINGS, out, 1, lambda done, total: seen.append((done, total)))
    assert seen == [(0, 3), (1, 3), (2, 3), (3, 3)]
    assert count == len(data(out)["q"]) > 8
    return out


def same(a: Path, b: Path) -> None:
    first, second = data(a), data(b)
    assert set(first) == set(second)
    for key, values in first.items():
        np.testing.assert_array_equal(values, second[key], err_msg=key)


def test_the_same_data_with_more_workers_and_after_an_interruption(folder: Path, tmp_path: Path) -> None:
    """What a killed run leaves: finished shards, and a part of one."""
    for name in ("settings.json", "shard_00001.npz"):
        (tmp_path / name).write_bytes((folder / name).read_bytes())
    (tmp_path / "shard_00002.123.part").write_bytes(b"half of it")
    kept = (tmp_path / "shard_00001.npz").stat().st_mtime_ns
    assert generate(SETTINGS, tmp_path, 2) == len(data(folder)["q"])
    same(folder, tmp_path)
    assert (tmp_path / "shard_00001.npz").stat().st_mtime_ns == kept


def test_a_finished_folder_is_left_as_it_is(folder: Path) -> None:
    before = {file: file.stat().st_mtime_ns for file in folder.iterdir()}
    assert generate(SETTINGS, folder, 1) == len(data(folder)["q"])
    assert {file: file.stat().st_mtime_ns for file in folder.iterdir()} == before


def test_other_settings_are_refused(folder: Path) -> None:
    with pytest.raises(InputError, match="holds other settings"):
        generate(replace(SETTINGS, seed=4), folder, 1)


@pytest.mark.parametrize("content", ["{", "[]", ""])
def test_damaged_settings_are_refused(content: str, tmp_path: Path) -> None:
    (tmp_path / "settings.json").write_text(content)
    with pytest.raises(InputError):
        generate(SETTINGS, tmp_path, 1)


def test_unusable_folders_and_workers_are_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot use the data folder"):
        generate(SETTINGS, tmp_path / "file", 1)
    with pytest.raises(InputError, match="workers is 0"):
        generate(SETTINGS, tmp_path / "data", 0)


def test_settings_are_kept_beside_the_data(folder: Path) -> None:
    kept = json.loads((folder / "settings.json").read_text())
    assert GenerationSettings(**kept | {"clearances": tuple(kept["clearances"])}) == SETTINGS
    assert kept == json.loads(json.dumps(asdict(SETTINGS)))


def problems() -> list[tuple[CollisionChecker, ndarray, ndarray]]:
    """Every problem that the settings draw: checker, ends, packed obstacles."""
    robot, found = load_robot("panda"), []
    for index in range(SETTINGS.problems):
        rng = np.random.default_rng([SETTINGS.seed, index])
        family = ROP_DENSE if rng.random() < SETTINGS.dense_share else ROP
        problem = sample_problem(robot, family, rng)
        assert isinstance(problem.goal, JointGoal)
        ends = np.stack([problem.start, problem.goal.positions[0]]).astype(np.float32)
        scene = type(problem.scene)(problem.scene.shapes[1:])
        found.append((CollisionChecker(robot, problem.scene), ends, pack_scene(scene, 12)[1]))
    return found


def test_every_trajectory_is_what_it_claims_to_be(folder: Path) -> None:
    """Right ends, within limits, free between the frames, as far away as recorded, and of its own scene."""
    rows, robot = data(folder), load_robot("panda")
    drawn, at, depths = problems(), 0, []
    for q, params, trivial, clearance in zip(
        rows["q"], rows["params"], rows["trivial"], rows["clearance"], strict=True
    ):
        while not np.array_equal(drawn[at][1], q[[0, -1]]):
            at += 1
        checker, ends, packed = drawn[at]
        np.testing.assert_array_equal(params, packed)
        assert ((q >= robot.lower - 1e-6) & (q <= robot.upper + 1e-6)).all()
        assert clearance in np.array(SETTINGS.clearances, np.float32)
        fine = np.concatenate([a + np.linspace(0, 1, 30)[:, None] * (b - a) for a, b in pairwise(q)])
        depth = -checker.clearance(fine.astype(float)).min()
        depths.append(depth)
        # a point of the arm moves no further than the resolution between two checks of the search
        assert depth < generation.RESOLUTION / 2
        assert checker.link_clearances(q.astype(float)).min() >= clearance - generation.RESOLUTION / 2
        line = ends[0] + np.linspace(0, 1, 200)[:, None] * (ends[1] - ends[0])
        assert trivial <= checker.free(line.astype(float)).all()
    assert np.mean(np.array(depths) < 1e-3) > 0.9
    assert {True, False} <= set(rows["trivial"].tolist())


def test_frames_are_even_in_length() -> None:
    path = np.array([[0.0, 0], [3, 0], [3, 1]])
    np.testing.assert_allclose(resample(path, 5), [[0, 0], [1, 0], [2, 0], [3, 0], [3, 1]])
    np.testing.assert_array_equal(resample(path, 2), path[[0, -1]])
    np.testing.assert_array_equal(resample(path[[0, 0]], 3), np.zeros((3, 2)))


@pytest.mark.parametrize(
    ("name", "value"),
    [("problems", 0), ("shard", 0), ("attempts", 0), ("iterations", 0), ("dense_share", 1.5), ("frames", 1)],
)
def test_bad_settings_are_refused(name: str, value: float) -> None:
    with pytest.raises(InputError, match=f"{name} is {value}"):
        replace(SETTINGS, **{name: value})
