"""The data factory: the same data after any interruption, and motions that agree with their records."""

import json
import multiprocessing
import os
import random
import re
import shutil
import signal
import time
from contextlib import ExitStack
from dataclasses import replace
from importlib.metadata import PackageNotFoundError
from itertools import pairwise
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from numpy import ndarray

import robotdiffuse as rd
from helpers import factory_runs
from helpers.full_disk import full_disk
from helpers.refusals import refuses
from helpers.sphere_oracles import least_clearance
from robotdiffuse.collision import CollisionChecker
from robotdiffuse.core.errors import OutputError
from robotdiffuse.core.files import lock_folder
from robotdiffuse.core.transforms import rotation_from_quaternion
from robotdiffuse.datasets.shards import check_shard, path_of, problem_of, read_manifest, read_shard
from robotdiffuse.generation import GenerationSettings, factory, generate
from robotdiffuse.generation.aorrtc_solver import AORRTCSearchSettings
from robotdiffuse.robots import names_a_file
from robotdiffuse.scenes.packed_scenes import PackedScenes

MIX = {"rop": 0.5, "rop_dense": 0.5}
SETTINGS = GenerationSettings(trajectories=12, shard=4, waypoints=32, seed=3, mix=MIX, goals=4)
PANDA = rd.load_robot("panda")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("data") / "new"
    seen = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(factory, "on_this_machine", factory_runs.in_this_process)
        assert generate(SETTINGS, out, progress=lambda *at: seen.append(at)) == 12
    assert seen == [(0, 12), (4, 12), (8, 12), (12, 12)]
    return out


def test_a_folder_called_like_a_robot_does_not_hide_it_from_nodes(tmp_path, monkeypatch):
    """Regression: if the working folder contained a folder with the robot's name, nodes got its path instead of the robot."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "panda").mkdir()
    assert (
        not names_a_file("panda") and names_a_file("./panda") and names_a_file("ARM.URDF") and rd.load_robot("panda") is PANDA
    )


@pytest.fixture(scope="module")
def rows(folder: Path) -> dict[str, ndarray]:
    parts = [read_shard(folder, index) for index in range(SETTINGS.shards)]
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0].arrays}


def test_the_same_data_with_more_workers_and_after_an_interruption(folder: Path, tmp_path: Path) -> None:
    """A killed run leaves a manifest, a finished shard, and incomplete files of another shard and of a manifest."""
    shutil.copy(folder / "manifest.json", tmp_path)
    shutil.copytree(folder / "shard_00001.zarr", tmp_path / "shard_00001.zarr")
    kept = (tmp_path / "shard_00001.zarr").stat().st_mtime_ns
    half = tmp_path / ".shard_00002.zarr.abc" / "new"
    half.mkdir(parents=True)
    (half / "zarr.json").write_text("{")
    (tmp_path / ".manifest.json.0123456789abcdef.tmp").write_text("{")
    seen: list[tuple[int, int]] = []
    assert generate(SETTINGS, tmp_path, 2, progress=lambda *at: seen.append(at)) == 12
    assert seen == [(4, 12), (8, 12), (12, 12)]
    assert factory_runs.contents(tmp_path) == factory_runs.contents(folder)
    assert (tmp_path / "shard_00001.zarr").stat().st_mtime_ns == kept
    before = {file: file.stat().st_mtime_ns for file in tmp_path.rglob("*")}
    assert generate(SETTINGS, tmp_path) == 12
    assert {file: file.stat().st_mtime_ns for file in tmp_path.rglob("*")} == before, "finished"


def test_shards_are_whole_and_what_the_manifest_says(folder: Path) -> None:
    manifest = read_manifest(folder)
    assert (manifest.trajectories, manifest.shard, manifest.slots) == (12, 4, 12)
    assert tuple(manifest.families) == tuple(MIX)
    assert set(manifest.versions) == {"robotdiffuse", "python", "numpy", "numba", "zarr"}
    for index in range(SETTINGS.shards):
        shard = check_shard(folder, index, manifest)
        assert len(shard) == 4
        counts = dict(shard.counts)
        assert counts["solved"] == 4 and counts.pop("tried") == sum(counts.values())
        # numbers of problems rise, and no other shard has them
        assert (np.diff(shard["seed"].astype(np.int64)) > 0).all()
        assert (shard["seed"] // factory.PROBLEMS_PER_SHARD == index).all()


def checked_problem(row: dict[str, Any]) -> tuple[rd.Problem, CollisionChecker]:
    number, drawn = factory.draw(SETTINGS, PANDA, np.random.default_rng([SETTINGS.seed, int(row["seed"])]))
    assert row["family"] == number
    floor = list(SETTINGS.families.values())[number].floor
    packed = PackedScenes.pack([drawn.scene], SETTINGS.slots, floor is not None)
    np.testing.assert_array_equal(row["obstacle_kinds"], packed.kinds[0])
    np.testing.assert_array_equal(row["obstacle_params"], packed.params[0])
    np.testing.assert_array_equal(row["start"], drawn.start)
    k = len(drawn.goals)
    np.testing.assert_array_equal(row["goals"][:k], drawn.goals)
    assert np.isnan(row["goals"][k:]).all() and np.isnan(row["goal_costs"][k:]).all()
    assert not np.isnan(row["goal_costs"][:k]).any()
    return drawn.problem(PANDA), CollisionChecker(PANDA, drawn.scene)


@pytest.mark.parametrize("i", range(12))
def test_every_trajectory_is_what_it_claims_to_be(i: int, rows: dict[str, ndarray]) -> None:
    row: dict[str, Any] = {name: values[i] for name, values in rows.items()}
    problem, checker = checked_problem(row)
    q = np.array(row["trajectories"])
    np.testing.assert_array_equal(q[0], row["start"])
    np.testing.assert_array_equal(q[-1], row["goals"][row["goal_index"]])
    assert ((q >= PANDA.lower - 1e-6) & (q <= PANDA.upper + 1e-6)).all()
    assert rd.verify(problem, rd.Path(PANDA.joint_names, q.astype(float))).valid
    fine = np.concatenate([a + np.linspace(0, 1, 20)[:, None] * (b - a) for a, b in pairwise(q)])
    assert least_clearance(checker, fine.astype(float)).min() > -1e-3
    # costs: of the best goal, not shorter than the line, and hardly longer than the waypoints
    assert row["cost"] == row["goal_costs"][row["goal_index"]] == np.nanmin(row["goal_costs"])
    straight = np.linalg.norm(q[-1] - q[0])
    lines = np.linalg.norm(row["goals"] - row["start"], axis=1)
    assert (np.isnan(lines) | (row["goal_costs"] >= lines * (1 - 1e-5))).all()
    length = np.linalg.norm(np.diff(q, axis=0), axis=1)
    assert length.sum() <= row["cost"] * (1 + 1e-5) and length.sum() > 0.97 * row["cost"]
    # even, but for waypoints that cut a corner
    assert length.max() <= row["cost"] / 31 * (1 + 1e-4)
    np.testing.assert_allclose(row["detour"], row["cost"] / straight, rtol=1e-5)
    # difficulty: by other means than the search's
    line = q[0] + np.linspace(0, 1, 400)[:, None] * (q[-1] - q[0])
    deepest = least_clearance(checker, line.astype(float)).min()
    assert deepest > -0.01 if row["line_free"] else deepest < 0.01
    assert row["line_free"] or row["detour"] > 1 + 1e-4
    links = checker.link_clearances(fine.astype(float)).min(axis=1)
    np.testing.assert_allclose(row["clearance"], checker.link_clearances(q).min(), atol=1e-6)
    assert links.min() <= row["clearance"] + 1e-6
    assert row["clearance"] > min(row["safety_distance"], links[0], links[-1]) - 0.015


@pytest.mark.parametrize("target", ["position", "pose"])
def test_the_target_holds_for_all_goals(target: str, rows: dict[str, ndarray]) -> None:
    if target == "pose":
        rows, _ = factory.make_shard(replace(SETTINGS, trajectories=3, target="pose"), 0)
    several = 0
    for goals, wanted in zip(rows["goals"], rows["target_pose"], strict=True):
        poses = [PANDA.fk(q.astype(float), PANDA.tip) for q in goals if np.isfinite(q).all()]
        np.testing.assert_allclose([T[:3, 3] for T in poses], [wanted[4:]] * len(poses), atol=1e-3)
        rotation = rotation_from_quaternion(wanted[:4].astype(float))
        for T in poses if target == "pose" else poses[:1]:
            np.testing.assert_allclose(T[:3, :3], rotation, atol=5e-3)
        several += len(poses)
    assert several > len(rows["goals"])


def test_thinning_leaves_out_what_the_line_solves_and_nothing_else() -> None:
    whole = replace(SETTINGS, trajectories=8, shard=8, mix={"rop_dense": 1.0})
    arrays, counts = factory.make_shard(whole, 0)
    assert counts["thinned"] == 0
    hard = ~arrays["line_free"]
    assert 0 < hard.sum() < 8
    thin, counts = factory.make_shard(replace(whole, trajectories=int(hard.sum()), trivial_share=0.0), 0)
    assert counts["thinned"] > 0
    for name, values in arrays.items():
        np.testing.assert_array_equal(thin[name], values[hard], err_msg=name)


def test_frames_in_time_keep_the_velocity_limits() -> None:
    arrays, _ = factory.make_shard(replace(SETTINGS, trajectories=3, timing="time"), 0)
    times = arrays["times"].astype(float)
    q = arrays["trajectories"].astype(float)
    assert times.shape == (3, 32) and (times[:, 0] == 0).all() and (np.diff(times) > 0).all()
    np.testing.assert_allclose(np.diff(times, 2), 0, atol=1e-5)
    rates = np.abs(np.diff(q, axis=1)) / np.diff(times)[..., None]
    assert (rates <= PANDA.velocity * 1.01).all()
    # some joint is near a limit of it, or the motion would take longer than it needs
    assert (rates / PANDA.velocity).max(axis=(1, 2)).min() > 0.2
    np.testing.assert_array_equal(q[:, 0], arrays["start"])


def test_bad_settings_are_refused() -> None:
    refuses("trajectories is 0", replace, SETTINGS, trajectories=0)
    refuses("trivial_share is nan", replace, SETTINGS, trivial_share=float("nan"))
    refuses("target.*posse.*pose, position", replace, SETTINGS, target="posse")
    refuses("mix is empty", replace, SETTINGS, mix={})
    refuses("share of rop is nan", replace, SETTINGS, mix={"rop": float("nan")})
    refuses(r"pantry.*rop, rop_dense", replace, SETTINGS, mix={"pantry": 1.0})
    refuses("planner is aorrtc, but its settings are SharedTreeSettings", replace, SETTINGS, planner="aorrtc")
    refuses(r"planner 'bi_rrt'; known: aorrtc, shared_tree_rrt_star", replace, SETTINGS, planner="bi_rrt")
    assert GenerationSettings.from_json(AORRTC.to_json(), "settings") == AORRTC


def test_other_settings_are_refused_by_name(folder: Path) -> None:
    search = replace(SETTINGS.search, safety_distance=0.02)
    for changed, message in (
        (replace(SETTINGS, seed=4), "seed 3, not 4"),
        (replace(SETTINGS, mix={"rop": 1.0}), r'mix .*"rop_dense".*, not {"rop": 1.0}'),
        (replace(SETTINGS, mix=dict(reversed(SETTINGS.mix.items()))), r"mix .*, not "),
        (replace(SETTINGS, planner="aorrtc", search=AORRTC.search), r'begun with planner "shared_tree_rrt_star", not "aorrtc"'),
        (replace(SETTINGS, search=search), r"search\.safety_distance 0\.05, not 0\.02"),
    ):
        before = factory_runs.contents(folder)
        refuses(message, generate, changed, folder)
        assert factory_runs.contents(folder) == before


def test_data_of_other_versions_and_robots_are_refused(folder, tmp_path):
    for change, message in (
        (lambda data: data["versions"].update(numba="0.1"), "begun with numba 0.1; this is"),
        (lambda data: data["versions"].pop("robotdiffuse"), "begun with robotdiffuse None"),
        (lambda data: data.update(robot_fingerprint="0" * 16), "fingerprint 0000000000000000"),
        (lambda data: data.update(format=9), "format is 9"),
    ):
        data = json.loads((folder / "manifest.json").read_text())
        change(data)
        (tmp_path / "manifest.json").write_text(json.dumps(data))
        refuses(message, generate, SETTINGS, tmp_path)


def test_a_locked_folder_that_stays_empty_leaves_no_parents(tmp_path: Path) -> None:
    """Regression: a refused training left the folders above its own."""
    with lock_folder(tmp_path / "new" / "out"):
        pass
    assert not list(tmp_path.iterdir())


def test_unusable_folders_workers_and_clusters_are_refused(folder: Path, tmp_path: Path) -> None:
    refuses("workers is 0", generate, SETTINGS, tmp_path / "data", 0)
    refuses(r"cluster.*slurm.*ray", generate, SETTINGS, tmp_path / "data", cluster="slurm")
    with lock_folder(tmp_path), pytest.raises(rd.InputError, match="another process is filling"):
        generate(SETTINGS, tmp_path)
    assert not list(tmp_path.iterdir())
    (tmp_path / "file").write_text("")
    refuses(r"cannot use the folder .*file", generate, SETTINGS, tmp_path / "file")
    refuses(r"below.* cannot be written: Not a directory", generate, SETTINGS, tmp_path / "file" / "below")
    shutil.copytree(folder / "shard_00000.zarr", tmp_path / "shard_00000.zarr")
    refuses("holds shards but no manifest", generate, SETTINGS, tmp_path)
    for damaged in ("{", "[" * 100_000):
        (tmp_path / "manifest.json").write_text(damaged)
        refuses(r"manifest\.json is damaged", generate, SETTINGS, tmp_path)


def test_furniture_among_the_families(tmp_path: Path) -> None:
    generate(replace(SETTINGS, mix={"shelf": 1.0, "crate": 1.0, "table": 1.0}, trajectories=6, shard=6), tmp_path, 1)
    manifest = read_manifest(tmp_path)
    shard = check_shard(tmp_path, 0, manifest)
    assert manifest.slots == 16 and len(set(shard["family"].tolist())) > 1
    for row in range(6):
        problem = problem_of(manifest, PANDA, shard, row)
        assert problem.scene.shapes[0].name == "floor" and len(problem.scene.shapes) > 4
        assert rd.verify(problem, path_of(PANDA, shard, row)).valid
        reached = PANDA.fk(shard["trajectories"][row, -1].astype(float))
        np.testing.assert_allclose(reached[:3, 3], shard["target_pose"][row, 4:], atol=1e-5)


AORRTC = replace(SETTINGS, mix={"rop_dense": 1.0}, seed=0, trivial_share=0.0, planner="aorrtc", search=AORRTCSearchSettings())


@pytest.mark.parametrize("name", ["panda", "ur5e"])
def test_motions_are_free_reach_a_goal_and_keep_their_distance(name: str) -> None:
    settings = replace(AORRTC, robot=name, trajectories=3)
    robot = rd.load_robot(name)
    arrays, _ = factory.make_shard(settings, 0)
    for row in (dict(zip(arrays, values, strict=True)) for values in zip(*arrays.values(), strict=True)):
        drawn = factory.draw(settings, robot, np.random.default_rng([settings.seed, int(row["seed"])]))[1]
        q = np.asarray(row["trajectories"], np.float64)
        assert rd.verify(drawn.problem(robot), rd.Path(robot.joint_names, q)).valid
        np.testing.assert_array_equal(q[-1], row["goals"][row["goal_index"]])
        assert np.isfinite(row["goal_costs"]).sum() == 1
        length = np.linalg.norm(np.diff(q, axis=0), axis=1).sum()
        assert length == pytest.approx(row["goal_costs"][row["goal_index"]], rel=0.02)
        clearances = CollisionChecker(robot, drawn.scene).link_clearances(q).min(axis=1)
        assert clearances.min() >= min(row["safety_distance"], *clearances[[0, -1]]) - 0.004


@pytest.mark.parametrize("name", ["ur5e", "gen3"])
def test_goals_a_turn_away_are_taken_the_short_way(name: str) -> None:
    """Regression: a seventh of the motions of joints with a range of two turns went the long way; of continuous ones more."""
    robot = rd.load_robot(name)
    far = list[int]()
    settings = GenerationSettings(robot=name, mix={"rop": 1.0}, target="pose", goals=1, waypoints=16)
    turning = (robot.upper - robot.lower > 2 * np.pi + 0.1) | robot.continuous
    for number in range(60):
        drawn = factory.draw(settings, robot, np.random.default_rng([settings.seed, number]))[1]
        if np.abs(drawn.goals[0] - drawn.start)[turning].max() > np.pi:
            far.append(number)
            row = factory.solve(settings, robot, number)
            assert row != "refused"
            if not isinstance(row, str):
                assert np.abs(np.asarray(row["goals"])[0] - drawn.start)[turning].max() <= np.pi + 1e-6
        if len(far) == 3:
            return
    pytest.fail(f"only {len(far)} such problems")


MANY = GenerationSettings(trajectories=30, shard=3, waypoints=16)


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    out = tmp_path_factory.mktemp("undisturbed")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(factory, "on_this_machine", factory_runs.in_this_process)
        generate(MANY, out)
    assert factory_runs.shards(out) == MANY.shards
    return factory_runs.contents(out)


@pytest.mark.slow
def test_killed_at_a_random_moment_it_ends_in_the_same_data(undisturbed, tmp_path):
    run = factory_runs.start(tmp_path, MANY, 2)
    factory_runs.wait_for_shards(run, tmp_path, 1)
    time.sleep(random.uniform(0, 0.1))
    assert len(factory_runs.members(run.pid)) >= 2, "the command and a worker; the other may be at its start or end"
    run.kill()
    run.communicate(timeout=500)
    assert run.returncode == -signal.SIGKILL and factory_runs.shards(tmp_path) < MANY.shards
    assert factory_runs.group_ends(run.pid), "workers outlive the command"
    run = factory_runs.start(tmp_path, MANY, 2)
    said, complaints = run.communicate(timeout=400)
    assert run.returncode == 0 and re.fullmatch(r"trajectories: \d+ of 30\n", complaints)
    assert said == f"30 trajectories of 16 waypoints in {tmp_path}\n"
    assert factory_runs.contents(tmp_path) == undisturbed
    assert factory_runs.group_ends(run.pid)


@pytest.mark.slow
@pytest.mark.parametrize("count", [0, 1])
def test_ctrl_c_stops_all_in_one_line(count: int, tmp_path: Path) -> None:
    """Ctrl-C reaches all processes, as in a terminal: while the workers start, and while they work."""
    run = factory_runs.start(tmp_path, MANY, 2)
    while len(factory_runs.members(run.pid)) < 3:
        assert run.poll() is None
        time.sleep(0.02)
    factory_runs.wait_for_shards(run, tmp_path, count)
    os.killpg(run.pid, signal.SIGINT)
    said, complaints = run.communicate(timeout=500)
    assert (run.returncode, said) == (130, "")
    assert re.fullmatch(r"(trajectories: \d+ of 30\n)*robotdiffuse: stopped\n", complaints)
    assert factory_runs.group_ends(run.pid) and factory_runs.shards(tmp_path) < MANY.shards
    assert not [name for name in factory_runs.contents(tmp_path) if name.startswith(".")]


@pytest.mark.slow
def test_a_full_disk_is_one_line_and_leaves_nothing_half_written(undisturbed, tmp_path, monkeypatch):
    """Files cannot grow beyond a kilobyte, so that writing any file fails as on a full disk."""
    monkeypatch.setattr(factory, "on_this_machine", factory_runs.in_this_process)

    def fill_up(done: int, _total: int) -> None:
        if done == 2 * MANY.shard:
            filled.enter_context(full_disk(1000))

    with ExitStack() as filled:
        with pytest.raises(OutputError, match=r"shard_00002\.zarr cannot be written: File too large$"):
            generate(MANY, tmp_path, progress=fill_up)
        assert factory_runs.shards(tmp_path) == 2 and len(list(tmp_path.iterdir())) == 3
        with pytest.raises(OutputError, match=r"manifest\.json.*: File too large$"):
            generate(MANY, tmp_path / "other")
        assert not (tmp_path / "other").exists()
    generate(MANY, tmp_path)
    assert factory_runs.contents(tmp_path) == undisturbed


@pytest.mark.slow
def test_a_worker_killed_from_outside_is_one_line_and_the_next_call_goes_on(undisturbed, tmp_path, monkeypatch):
    def kill(done: int, _total: int) -> None:
        if done == MANY.shard:
            os.kill(multiprocessing.active_children()[0].pid or 0, signal.SIGKILL)

    refuses(r"worker process was killed.*run the same command again$", generate, MANY, tmp_path, workers=2, progress=kill)
    assert 0 < factory_runs.shards(tmp_path) < MANY.shards
    monkeypatch.setattr(factory, "on_this_machine", factory_runs.in_this_process)
    generate(MANY, tmp_path)
    assert factory_runs.contents(tmp_path) == undisturbed


def test_a_missing_zarr_is_said_before_any_planning(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Regression: without the extra `data`, `data generate` ended with a traceback."""
    monkeypatch.setattr(factory, "version", Mock(side_effect=PackageNotFoundError("zarr")))
    refuses(r'zarr, not installed: pip install "robotdiffuse\[data\]"', generate, SETTINGS, tmp_path)
    assert not list(tmp_path.iterdir())
