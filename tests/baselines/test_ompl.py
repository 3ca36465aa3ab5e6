"""OMPL's planners over our kernel: verified paths, many goals, time, seeds, and no crash through C++."""

import gc
import runpy
import sys
from itertools import product
from unittest.mock import Mock

import numpy as np
import pytest

pytest.importorskip("ompl")

import robotdiffuse as rd
from helpers.box_arm import box_arm
from helpers.panda import LEFT, PANDA, RIGHT
from helpers.refusals import refuses
from robotdiffuse.baselines import ompl
from robotdiffuse.collision import CollisionChecker

WALL = rd.Scene([rd.Box([0.45, 0.0, 0.25], [0.3, 0.05, 0.5], name="wall")])
FIRST = (ompl.OmplRRT, ompl.OmplRRTConnect, ompl.OmplPRM)
ANYTIME = (ompl.OmplRRTStar, ompl.OmplInformedRRTStar, ompl.OmplBITStar, ompl.OmplAORRTC)
every = pytest.mark.parametrize("planner", FIRST + ANYTIME, ids=lambda planner: planner.name)


def problem(*goals: np.ndarray, scene: rd.Scene = WALL) -> rd.Problem:
    return rd.Problem(PANDA, scene, LEFT, rd.JointGoal(np.stack(goals)))


def plan(planner: type[ompl.OmplPlanner], problem: rd.Problem, seed: int = 1, limit: float = 0.5) -> rd.PlanResult:
    """Anytime planners use all of their time, so they get a short limit; the others get a longer one, for busy machines."""
    if not planner.anytime:
        limit = 120.0
    result = planner().plan(problem, time_limit=limit, seed=seed)
    while not result.solved and limit < 60.0:
        limit *= 10
        result = planner().plan(problem, time_limit=limit, seed=seed)
    return result


@pytest.fixture(scope="module", autouse=True)
def compiled() -> None:
    ompl.OmplRRTConnect().plan(problem(RIGHT), time_limit=120.0)


@every
def test_a_goal_where_the_arm_stands_and_an_end_when_no_path_can_be_shorter(planner):
    assert planner().plan(problem(LEFT), time_limit=120.0).path.length < 1e-5
    if planner.anytime:
        result = planner().plan(problem(RIGHT, scene=rd.Scene([])), time_limit=20.0)
        assert result.path.length <= 1.0002 * np.linalg.norm(RIGHT - LEFT)
        assert result.planning_time < 20.0


@pytest.mark.timeout(300)
def test_prm_with_many_goals_ends():
    """Regression: the two threads of OMPL's PRM deadlocked on the locks of its roadmap and of Python."""
    many = problem(*(RIGHT + 0.1 * np.random.default_rng(0).standard_normal((20, 7))))
    for seed in range(5):
        result = ompl.OmplPRM().plan(many, time_limit=120.0, seed=seed)
        assert result.path is not None and rd.verify(many, result.path).valid


@every
def test_no_way_to_the_goal_times_out(planner, monkeypatch):
    monkeypatch.undo()  # OMPL has a clock of its own
    corridor = rd.Scene([rd.Box([0.8, side * 0.12, 0.0], [1.2, 0.08, 0.2]) for side in (-1, 1)])
    result = planner().plan(rd.Problem(box_arm(), corridor, [2.0, 0.0, 0.0], np.zeros(3)), time_limit=0.2)
    assert result.status is rd.Status.TIMEOUT and result.path is None
    assert "no path was found" in result.reason


@pytest.mark.parametrize("planner", [ompl.OmplRRT, ompl.OmplRRTConnect])
def test_same_seed_same_path(planner):
    once, again, other = (plan(planner, problem(RIGHT), seed).path for seed in (3, 3, 4))
    np.testing.assert_array_equal(once.positions, again.positions)
    assert once.length != other.length


def test_range_bounds_the_extensions_which_simplifying_shortens():
    result = ompl.OmplRRT(ompl.OmplSettings(range=0.3, simplify=False)).plan(problem(RIGHT), 120.0, seed=1)
    assert np.linalg.norm(np.diff(result.path.positions, axis=0), axis=1).max() < 0.3 + 1e-6
    assert ompl.OmplRRT(ompl.OmplSettings(range=0.3)).plan(problem(RIGHT), 120.0, seed=1).path.length < result.path.length
    for planner in (ompl.OmplPRM, ompl.OmplBITStar):
        refuses(f"{planner.name} has no range", planner, ompl.OmplSettings(range=1.0))


@pytest.mark.parametrize("planner", [ompl.OmplRRTConnect, ompl.OmplAORRTC])
def test_a_refused_path_is_searched_again_more_closely(planner, monkeypatch):
    resolutions = []

    def first_without_the_wall(start_goal, resolution, clearance):
        resolutions.append(resolution)
        if len(resolutions) == 1:
            start_goal = ompl.StartGoal(CollisionChecker(PANDA, rd.Scene([])), LEFT, RIGHT[None])
        return space(start_goal, resolution, clearance)

    space = ompl.StartGoal.space
    monkeypatch.setattr(ompl.StartGoal, "space", first_without_the_wall)
    result = plan(planner, problem(RIGHT))
    assert resolutions[:2] == [0.05, 0.025]
    assert rd.verify(problem(RIGHT), result.path).valid


@every
def test_an_error_below_ompl_comes_out(planner, monkeypatch):
    checked = ompl.StartGoal(CollisionChecker(PANDA, WALL), LEFT, RIGHT[None])  # by the kernel, too
    with monkeypatch.context() as patched:
        patched.setattr(ompl, "motions_free", Mock(side_effect=RuntimeError("broken kernel")))
        patched.setattr("robotdiffuse.planning.planner.usable_start_goal", lambda _: checked)
        with pytest.raises(RuntimeError, match="broken kernel"):
            planner().plan(problem(RIGHT), time_limit=120.0)
    assert plan(planner, problem(RIGHT)).solved


def test_nothing_stays_in_memory():
    for planner, seed in product(FIRST + ANYTIME, range(3)):
        planner().plan(problem(RIGHT), time_limit=0.05, seed=seed)
    gc.collect()
    checks = ompl.ob.MotionValidator, ompl.ob.StateValidityChecker
    assert not [each for each in gc.get_objects() if issubclass(type(each), checks)]


def test_without_ompl_the_error_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "ompl", None)
    monkeypatch.delitem(sys.modules, ompl.__name__)
    refuses(r"pip install \"robotdiffuse\[baselines\]\"", runpy.run_path, ompl.__file__)
