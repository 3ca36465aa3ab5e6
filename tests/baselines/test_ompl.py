"""OMPL's planners over our kernel: verified paths, many goals, time, seeds, and no crash through C++."""

import gc
import runpy
import sys
from itertools import product

import numpy as np
import pytest

pytest.importorskip("ompl")

import robotdiffuse as rd
from helpers.box_arm import box_arm
from robotdiffuse.baselines import ompl
from robotdiffuse.baselines import ompl as planners
from robotdiffuse.collision import CollisionChecker
from robotdiffuse.collision.exact_meshes import explain_collision
from robotdiffuse.robots.kinematics import link_pose

PANDA = rd.load_robot("panda")
LEFT = np.array([0.9, 0.3, 0.0, -1.9, 0.0, 2.2, 0.785])
RIGHT = np.array([-0.9, 0.3, 0.0, -1.9, 0.0, 2.2, 0.785])
READY = np.array([0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785])
WALL = rd.Scene([rd.Box([0.45, 0.0, 0.25], [0.3, 0.05, 0.5], name="wall")])
FIRST = (planners.OmplRRT, planners.OmplRRTConnect, planners.OmplPRM)
ANYTIME = (planners.OmplRRTStar, planners.OmplInformedRRTStar, planners.OmplBITStar, planners.OmplAORRTC)
every = pytest.mark.parametrize("planner", FIRST + ANYTIME, ids=lambda planner: planner.name)
anytime = pytest.mark.parametrize("planner", ANYTIME, ids=lambda planner: planner.name)


def problem(*goals: np.ndarray, scene: rd.Scene = WALL) -> rd.Problem:
    return rd.Problem(PANDA, scene, LEFT, rd.JointGoal(np.stack(goals)))


def plan(
    planner: type[planners.OmplPlanner], problem: rd.Problem, seed: int = 1, limit: float = 0.5
) -> rd.PlanResult:
    """Plan with a short time limit for anytime planners, which use all of it, and a longer one where a busy
    machine finds no path in it."""
    if not planner.anytime:
        limit = 120.0
    result = planner().plan(problem, time_limit=limit, seed=seed)
    while not result.solved and limit < 60.0:
        limit *= 10
        result = planner().plan(problem, time_limit=limit, seed=seed)
    return result


@pytest.fixture(scope="module", autouse=True)
def compiled() -> None:
    """Compile and load the kernels before the planners are timed."""
    planners.OmplRRTConnect().plan(problem(RIGHT), time_limit=120.0)


def test_an_anytime_planner_improves():
    for limit in (1.5, 15.0):
        result = plan(planners.OmplInformedRRTStar, problem(RIGHT), limit=limit)
        if len(result.progress) > 2 and result.progress[-1][1] < 0.9 * result.progress[0][1]:
            return
    pytest.fail(f"no better path after the first: {result.progress}")


@anytime
def test_an_anytime_planner_ends_when_no_path_can_be_shorter(planner):
    limit = 20.0
    result = planner().plan(problem(RIGHT, scene=rd.Scene([])), time_limit=limit)
    assert result.path is not None
    assert result.path.length <= 1.0002 * np.linalg.norm(RIGHT - LEFT)
    assert result.planning_time < limit


@every
def test_a_goal_where_the_arm_stands(planner):
    result = planner().plan(problem(LEFT), time_limit=120.0)
    assert result.solved and result.path is not None
    assert result.path.length < 1e-5


@every
def test_one_of_several_goals(planner):
    blocked = np.append(0.0, LEFT[1:])
    near = LEFT + 0.05
    several = problem(blocked, RIGHT, near)
    assert explain_collision(PANDA, WALL, blocked) is not None
    result = plan(planner, several)
    assert result.path is not None and rd.verify(several, result.path).valid
    if planner.anytime:
        np.testing.assert_allclose(result.path.positions[-1], near, atol=1e-6)


@pytest.mark.timeout(300)
def test_prm_with_many_goals_ends():
    """Regression: its two threads deadlocked on the roadmap's and Python's locks."""
    rng = np.random.default_rng(0)
    many = problem(*(RIGHT + 0.1 * rng.standard_normal((20, 7))))
    for seed in range(5):
        result = planners.OmplPRM().plan(many, time_limit=120.0, seed=seed)
        assert result.path is not None and rd.verify(many, result.path).valid


def corridor() -> rd.Problem:
    """A planar arm with its goal between two walls, so long that the arm can neither leave nor enter."""
    walls = [rd.Box([0.8, side * 0.12, 0.0], [1.2, 0.08, 0.2]) for side in (-1, 1)]
    return rd.Problem(box_arm(), rd.Scene(walls), np.array([2.0, 0.0, 0.0]), rd.JointGoal(np.zeros((1, 3))))


@every
def test_no_way_to_the_goal_times_out(planner, monkeypatch):
    monkeypatch.undo()  # OMPL has a clock of its own
    result = planner().plan(corridor(), time_limit=0.2)
    assert result.status is rd.Status.TIMEOUT and result.path is None
    assert "no path was found" in result.reason


@pytest.mark.parametrize("planner", [planners.OmplRRTConnect, planners.OmplAORRTC])
def test_start_that_only_the_spheres_call_in_collision(planner):
    ahead = link_pose(PANDA, READY, "panda_hand")[:3, 3] - [0.0, 0.0, 0.2]
    radii = np.arange(0.1, 0.05, -0.0002)
    balls = (rd.Sphere(ahead, float(radius)) for radius in radii)
    ball = next(ball for ball in balls if explain_collision(PANDA, rd.Scene([ball]), READY) is None)
    scene = rd.Scene([rd.Sphere(ahead, ball.radius - 0.002)])
    assert not CollisionChecker(PANDA, scene).free(READY[None])[0]
    close = rd.Problem(PANDA, scene, READY, rd.JointGoal(LEFT[None]))
    result = plan(planner, close)
    assert result.path is not None and rd.verify(close, result.path).valid
    np.testing.assert_array_equal(result.path.positions[0], READY)


@pytest.mark.parametrize("planner", [planners.OmplRRT, planners.OmplRRTConnect])
def test_same_seed_same_path(planner):
    once, again, other = (plan(planner, problem(RIGHT), seed).path for seed in (3, 3, 4))
    assert once is not None and again is not None and other is not None
    np.testing.assert_array_equal(once.positions, again.positions)
    assert once.length != other.length


def test_simplifying_shortens():
    raw = planners.OmplRRT(planners.OmplSettings(simplify=False)).plan(problem(RIGHT), 120.0, seed=1)
    short = planners.OmplRRT().plan(problem(RIGHT), 120.0, seed=1)
    assert raw.path is not None and short.path is not None
    assert short.path.length < raw.path.length


def test_range_bounds_the_extensions():
    settings = planners.OmplSettings(range=0.3, simplify=False)
    result = planners.OmplRRT(settings).plan(problem(RIGHT), 120.0)
    assert result.path is not None
    assert np.linalg.norm(np.diff(result.path.positions, axis=0), axis=1).max() < 0.3 + 1e-6


@pytest.mark.parametrize("planner", [planners.OmplRRTConnect, planners.OmplAORRTC])
def test_a_refused_path_is_searched_again_more_closely(planner, monkeypatch):
    resolutions = []

    def first_without_the_wall(checker, resolution, *rest):
        resolutions.append(resolution)
        seen = checker if len(resolutions) > 1 else CollisionChecker(PANDA, rd.Scene([]))
        return search_space(seen, resolution, *rest)

    search_space = planners.search_space
    monkeypatch.setattr(planners, "search_space", first_without_the_wall)
    result = plan(planner, problem(RIGHT))
    assert resolutions[:2] == [0.05, 0.025]
    assert result.path is not None and rd.verify(problem(RIGHT), result.path).valid


@every
def test_an_error_below_ompl_comes_out(planner, monkeypatch):
    def broken(*_):
        raise RuntimeError("broken kernel")

    with monkeypatch.context() as patched:
        patched.setattr(ompl, "motions_free", broken)
        patched.setattr(ompl.lane_collision, "free_many", broken)
        # start and goal are checked by the kernel too
        patched.setattr("robotdiffuse.planning.pipeline.usable_start_goal", UncheckedStartGoal)
        with pytest.raises(RuntimeError, match="broken kernel"):
            planner().plan(problem(RIGHT), time_limit=120.0)
    assert plan(planner, problem(RIGHT)).solved


class UncheckedStartGoal(planners.StartGoal):
    """A start and a goal without collision checks."""

    def __init__(self, *_):
        self.checker = CollisionChecker(PANDA, WALL)
        self.start = LEFT
        self.start_lead = LEFT
        self.goals = [RIGHT]
        self.goal_leads = [RIGHT]


OMPL_CHECKS = planners.ob.MotionValidator, planners.ob.StateValidityChecker


def test_nothing_stays_in_memory():
    for planner, seed in product(FIRST + ANYTIME, range(3)):
        planner().plan(problem(RIGHT), time_limit=0.05, seed=seed)
    gc.collect()
    kept = [each for each in gc.get_objects() if issubclass(type(each), OMPL_CHECKS)]
    assert not kept


@pytest.mark.parametrize("planner", [planners.OmplPRM, planners.OmplBITStar])
def test_a_planner_without_a_range_refuses_one(planner):
    with pytest.raises(rd.InputError, match=f"{planner.name} has no range"):
        planner(planners.OmplSettings(range=1.0))


def test_without_ompl_the_error_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "ompl", None)
    monkeypatch.delitem(sys.modules, ompl.__name__)
    with pytest.raises(rd.InputError, match=r"pip install \"robotdiffuse\[baselines\]\""):
        runpy.run_path(planners.__file__)
