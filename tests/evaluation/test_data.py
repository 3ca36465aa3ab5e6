"""Data sets: both validators find and name wrong motions and accept right ones; figures against figures by hand, the page."""

import re
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import robotdiffuse as rd
from helpers.box_arm import box_arm
from helpers.refusals import refuses
from helpers.stores import line, random_motions, record, write_motions
from robotdiffuse.datasets.shards import motion_of, pick_rows, problem_of, read_shard, shard_path, write_shard
from robotdiffuse.evaluation import data_report
from robotdiffuse.evaluation.checks import check_data
from robotdiffuse.evaluation.report import histograms

ARM = box_arm()
BALL = rd.Scene([rd.Sphere([0.0, 0.9, 0.0], 0.1)])
"""Where the stretched arm comes by on its way from -1 to 2.5 rad of the first joint."""
AWAY, BACK = np.array([-1.0, 0.0, 0.0]), np.array([2.5, 0.0, 0.0])


@pytest.fixture
def pybullet():
    return pytest.importorskip("pybullet")


def right(n: int = 3) -> list[dict[str, np.ndarray]]:
    return random_motions(ARM, n)


def found(folder: Path, robot: rd.Robot = ARM, **options) -> dict[str, int]:
    return {kind: n for kind, n in check_data(folder, robot, **options).counts.items() if n}


@pytest.mark.sim
def test_what_is_right_passes(tmp_path, pybullet):
    write_motions(tmp_path, ARM, right(5), shard=2)
    seen = []
    check = check_data(tmp_path, ARM, progress=lambda *numbers: seen.append(numbers))
    assert not check.findings
    assert (check.shards, check.motions, check.planned, check.checked) == (3, 5, 5, 5)
    assert seen == [(0, 5), (2, 5), (4, 5), (5, 5)]
    assert check.least_clearance == min(row["clearance"] for row in right(5))


@pytest.mark.sim
def test_collision_is_found_by_both_validators(tmp_path, pybullet):
    write_motions(tmp_path, ARM, [*right(3), record(ARM, BALL, line(AWAY, BACK))], shard=3)
    check = check_data(tmp_path, ARM)
    assert {kind: n for kind, n in check.counts.items() if n} == COLLISION
    for example in check.findings:
        assert example.where == "shard 1, row 0"
        assert "sphere" in example.message and "inside" in example.message
    assert found(tmp_path, pybullet=False) == {"collision": 1}


COLLISION = {"collision": 1, "pybullet": 1}
UNSOUND = {
    "a collision between frames": (rd.Scene([rd.Box([0.0, 1.1, 0.0], [0.01] * 3)]), line(AWAY, BACK, waypoints=4), COLLISION),
    "self-collision": (rd.Scene(), line(0 * AWAY, np.array([0.0, 2.7, 2.7])), COLLISION),
    "a start out of limits": (rd.Scene(), line(np.array([2.9, 0, 0]), -2 * AWAY), {"motion": 1}),
    "twitching": (rd.Scene(), line(AWAY, BACK)[[*(i * (i % 2 == 0) for i in range(19)), 19]], {"motion": 1}),
}


@pytest.mark.sim
@pytest.mark.parametrize(("scene", "q", "kinds"), UNSOUND.values(), ids=UNSOUND)
def test_unsound_motions_are_found(scene, q, kinds, tmp_path, pybullet):
    write_motions(tmp_path, ARM, [record(ARM, scene, q)], waypoints=len(q))
    assert found(tmp_path) == kinds


@pytest.mark.sim
def test_limits_on_the_way_are_found_but_not_of_continuous_joints(tmp_path, pybullet):
    q = line(np.array([2.7, 0.0, 0.0]), np.array([2.7, 1.0, 0.0]))
    q[7, 0] = 2.801
    write_motions(tmp_path / "arm", ARM, [*right(1), record(ARM, rd.Scene([]), q)])
    check = check_data(tmp_path / "arm", ARM)
    assert {kind: n for kind, n in check.counts.items() if n} == {"limits": 1}
    (example,) = check.findings
    assert example.where == "shard 0, row 1" and "j0 is 2.801 at waypoint 7" in example.message
    robot = rd.load_robot("gen3")
    q = line(np.where(robot.continuous, 9.6, 0.0), np.where(robot.continuous, 9.5, 0.1))
    write_motions(tmp_path / "gen3", robot, [record(robot, rd.Scene([]), q)])
    assert any(robot.continuous) and check_data(tmp_path / "gen3", robot, pybullet=False).counts["limits"] == 0


WRONG = {
    "start": ("ends", lambda row: row | {"start": row["start"] + np.float32(1e-6)}),
    "goal": ("ends", lambda row: row | {"goals": row["goals"] + 1e-6}),
    "no such goal": ("ends", lambda row: row | {"goal_index": np.array(2)}),
    "cost": ("cost", lambda row: row | {"cost": 1.1 * row["cost"], "detour": 1.1 * row["detour"]}),
    "detour": ("cost", lambda row: row | {"detour": 1.01 * row["detour"]}),
    "clearance": ("clearance", lambda row: row | {"clearance": row["clearance"] - 0.001}),
}


@pytest.mark.parametrize(("kind", "spoil"), WRONG.values(), ids=WRONG)
def test_what_is_recorded_wrongly_is_found(kind, spoil, tmp_path):
    near = record(ARM, rd.Scene([rd.Sphere([0.0, 1.5, 0.0], 0.1)]), line(AWAY, np.array([1.0, 0.0, 0.0])))
    write_motions(tmp_path, ARM, [*right(2), spoil(near)])
    assert found(tmp_path, pybullet=False) == {kind: 1}


def test_damaged_shard_is_named_and_the_others_are_validated(tmp_path):
    write_motions(tmp_path, ARM, right(4), shard=2)
    chunk = next(file for file in (shard_path(tmp_path, 1) / "cost" / "c").rglob("*") if file.is_file())
    chunk.write_bytes(chunk.read_bytes()[:-1])
    check = check_data(tmp_path, ARM, pybullet=False)
    assert check.counts["damaged"] == 1 and check.checked == check.motions == 2
    (example,) = check.findings
    assert example.where == "shard 1" and "shard_00001.zarr, array cost" in example.message


def test_no_data_and_another_robot_are_refused(tmp_path):
    for rows, robot, message in (
        (None, ARM, "no data set"),
        ([], ARM, "holds no shards"),
        (right(), replace(ARM, allowed_collisions=frozenset()), "fingerprint"),
    ):
        if rows is not None:
            write_motions(tmp_path, ARM, rows)
        refuses(message, check_data, tmp_path, robot, pybullet=False)


def test_random_motions_are_the_same_for_the_same_seed_and_all_are_in_more_processes(tmp_path):
    write_motions(tmp_path, ARM, [record(ARM, BALL, line(AWAY, BACK)) for _ in range(6)], shard=2)
    a, b, c = (check_data(tmp_path, ARM, 3, seed, pybullet=False) for seed in (1, 1, 2))
    assert a.checked == a.counts["collision"] == 3
    assert a.findings == b.findings != c.findings
    one, two = (check_data(tmp_path, ARM, workers=n, pybullet=False) for n in (1, 2))
    assert replace(one, seconds=0.0) == replace(two, seconds=0.0)


def test_missing_pybullet_is_one_line(tmp_path, monkeypatch):
    write_motions(tmp_path, ARM, right(1))
    for name in [name for name in sys.modules if name.startswith("robotdiffuse.simulation")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "pybullet", None)
    refuses(r'pip install "robotdiffuse\[sim\]"', check_data, tmp_path, ARM)
    assert not check_data(tmp_path, ARM, pybullet=False).findings


def test_rows_are_problems_and_motions_again(tmp_path):
    shapes = rd.Sphere([0.0, 1.5, 0.0], 0.1), rd.Box([1, 0, 1], [0.1, 0.2, 0.3])
    near = record(ARM, rd.Scene(shapes), line(AWAY, BACK))
    manifest = write_motions(tmp_path, ARM, [near])
    shard = read_shard(tmp_path, 0)
    problem = problem_of(manifest, ARM, shard, 0)
    assert [shape.kind for shape in problem.scene.shapes] == ["sphere", "box"]
    assert np.array_equal(problem.start, near["start"])
    assert isinstance(problem.goal, rd.JointGoal) and np.allclose(problem.goal.positions, near["goals"][:2])
    motion = motion_of(ARM, shard, 0)
    assert isinstance(motion, rd.Path) and np.array_equal(motion.positions, near["trajectories"])
    floor = {"center": [0.0, 0.0, -0.2], "size": [3.0, 2.0, 0.4]}
    first, *others = problem_of(replace(manifest, floors={"rop": floor, "rop_dense": None}), ARM, shard, 0).scene.shapes
    assert isinstance(first, rd.Box) and first.size.tolist() == floor["size"] and first.name == "floor"
    assert len(others) == 2
    refuses("family is 0; the manifest has 0", problem_of, replace(manifest, families={}, floors={}), ARM, shard, 0)
    times = np.linspace(0, 2, len(near["trajectories"]))
    write_shard(tmp_path, 0, {k: v[None] for k, v in (near | {"times": times}).items()}, {})
    motion = motion_of(ARM, read_shard(tmp_path, 0), 0)
    assert isinstance(motion, rd.Trajectory) and motion.duration == 2
    assert np.allclose(motion.velocities[:, 0], 1.75, atol=1e-5)
    assert np.allclose(motion.accelerations, 0, atol=1e-4)


def test_picked_rows_do_not_repeat():
    sizes = {0: 5, 2: 0, 7: 9}
    picked = pick_rows(sizes, 10, seed=3)
    assert picked.keys() == sizes.keys() and sum(map(len, picked.values())) == 10
    for index, rows in picked.items():
        assert len(set(rows.tolist())) == len(rows) and all(0 <= row < sizes[index] for row in rows)
    assert [rows.tolist() for rows in pick_rows(sizes, None, 0).values()] == [list(range(size)) for size in sizes.values()]


@pytest.fixture
def rows():
    pytest.importorskip("matplotlib")
    return random_motions(ARM, 11)


def test_figures(tmp_path, rows):
    write_motions(tmp_path, ARM, rows, shard=4)
    found = data_report.read_figures(tmp_path)
    costs = np.array([row["cost"] for row in rows])
    assert (found.trajectories, found.manifest.trajectories, found.shards) == (11, 11, 3)
    assert data_report.facts(found)[:2] == [("motions", "11"), ("waypoints, evenly spaced in length", "220")]
    assert found.counts == {"tried": 17, "solved": 11, "unsolved": 3, "refused": 0, "thinned": 3}
    assert sum(found.splits.values()) == 11 and list(found.splits) == ["train", "validation", "test"]
    _, families, spreads = data_report.tables(found)
    assert [row[:2] for row in families.rows] == [("rop", 6), ("rop_dense", 5)]
    lengths = [costs.mean(), *np.quantile(costs, [0, 0.05, 0.5, 0.95, 1])]
    assert spreads.texts[0] == ["length [rad]", *(f"{length:.3f}" for length in lengths)]
    assert spreads.texts[1][1:] == ["1.000"] * 6
    assert families.columns[5].heading == "trivial"
    free = [[row["line_free"] for row in rows if row["family"] == family] for family in (0, 1)]
    assert [row[5] for row in families.rows] == [pytest.approx(np.mean(each)) for each in free]
    shares = np.array([row[5:13] for row in families.rows], float)
    assert np.allclose(shares[:, :4].sum(axis=1), 1) and np.allclose(shares[:, 4:].sum(axis=1), 1)
    assert found.safety_distance == pytest.approx(0.05)
    assert [text for _, text in data_report.facts(found)[4:]] == [
        "78.6 %; tried: 17, of these 3 unsolved, 0 refused, 3 thinned",  # 11 of 14
        "100.0 %",
        "100.0 %",
        "1.0",
        "63.6 %",  # 7 of 11
    ]
    assert found.bytes == sum(f.stat().st_size for f in tmp_path.glob("*.zarr/**/*") if f.is_file())


def test_large_sets_are_sampled_evenly(tmp_path, rows, monkeypatch):
    monkeypatch.setattr(data_report, "SAMPLED_MOTIONS", 4)
    write_motions(tmp_path, ARM, rows, shard=3)
    found = data_report.read_figures(tmp_path)
    assert len(found.all["cost"]) == 11
    chosen = [rows[i] for i in (0, 2, 4, 6, 8, 10)]
    np.testing.assert_allclose(found.sample["goal_costs"], [row["goal_costs"] for row in chosen], rtol=1e-6)
    kept = found.sample["trajectories"]
    assert kept.shape == (6, min(data_report.SAMPLED_WAYPOINTS, 20), 3)
    assert np.array_equal(kept[:, [0, -1]], [row["trajectories"][[0, -1]] for row in chosen])


def test_a_page_is_complete_the_same_again_and_not_of_another_robot(tmp_path, rows):
    data = tmp_path / "arm <1>"
    file = tmp_path / "report.html"
    write_motions(data, ARM, rows)
    data_report.write_page(data, file, ARM)
    page = file.read_text("utf-8")
    assert page.count("<svg") == 3
    told = "91.7 %; tried: 13, of these 1 unsolved, 0 refused, 1 thinned", "clearance [cm]", "up to 5 % longer"
    for text in ("arm &lt;1&gt;", "rop_dense", *told, *ARM.joint_names):
        assert text in page, text
    assert "arm <1>" not in page
    addresses = set(re.findall(r"""(?:src|href)=["'](.*?)["']""", page))
    assert all(address.startswith(("data:", "#")) for address in addresses), "it must open without network"
    before = file.read_bytes()
    data_report.write_page(data, file, ARM)
    assert file.read_bytes() == before
    write_motions(data, ARM, rows[:1])
    data_report.write_page(data, file, ARM)  # of hardly any motions
    refuses("unknown ending", data_report.write_page, data, tmp_path / "a.pdf", ARM)
    refuses("fingerprint", data_report.write_page, data, file, rd.load_robot("panda"))


def test_ticks_of_histograms_say_where_they_are() -> None:
    """Regression: 2.5, 7.5 and 12.5 % were labelled 2, 8 and 12 %."""
    pytest.importorskip("matplotlib")
    svg = histograms({"length": (np.arange(8.0), {"a": np.arange(7.0)})}, across=1)
    ticks = [float(text) for text in re.findall(r">([\d.]+)%<", svg)]
    assert np.allclose(np.diff(ticks), 2.5), "the example has ticks between whole percents"
