"""The default planner: every stage verified, point clouds, robots without weights, reproducible."""

import time
from dataclasses import replace

import numpy as np
import pytest

from helpers.box_arm import box_arm
from helpers.small_model import small_model
from robotdiffuse import Box, JointGoal, PointCloud, Problem, Scene, Sphere, Status, load_robot, verify
from robotdiffuse.collision import CollisionChecker
from robotdiffuse.learning.diffusion import SAMPLERS
from robotdiffuse.learning.exported_model import exported_model
from robotdiffuse.learning.weight_files import weights_for
from robotdiffuse.planning import hybrid
from robotdiffuse.planning.diffusion import Diffusion, DiffusionSettings, encode
from robotdiffuse.planning.hybrid import BATCH_WORK, RobotDiffuse, RobotDiffuseSettings, smooth_noise
from robotdiffuse.planning.search import rrt_kernel
from robotdiffuse.planning.search.rrt import AnytimeSearch, AORRTCSettings
from robotdiffuse.problems.families.rop import ROP
from robotdiffuse.scenes.surface_points import sample_surface
from robotdiffuse.validation.validator import verify_trajectory

PANDA = load_robot("panda")
LEFT = np.array([0.9, 0.3, 0.0, -1.9, 0.0, 2.2, 0.785])
RIGHT = np.array([-0.9, 0.3, 0.0, -1.9, 0.0, 2.2, 0.785])
BALL = Sphere([0.5, 0.0, 0.4], 0.15, name="ball")
PROBLEM = Problem(PANDA, Scene([BALL]), LEFT, JointGoal(RIGHT[None]))


@pytest.fixture(scope="module")
def planner():
    return RobotDiffuse()


@pytest.fixture
def no_search(monkeypatch):
    """The search counts its iterations and finds nothing, so that only the network's batches find paths."""
    monkeypatch.setattr(rrt_kernel, "search", lambda *_: np.empty((0, 7), np.float32))


def test_the_network_solves_and_the_validator_agrees(planner, no_search):
    result = planner.plan(PROBLEM, time_limit=60.0)
    assert result.stage == "network" and result.path is not None and result.trajectory is not None
    assert verify(PROBLEM, result.path).valid and verify_trajectory(PROBLEM, result.trajectory).valid
    assert np.array_equal(result.path.positions[[0, -1]], np.stack([LEFT, RIGHT]))
    assert result.min_clearance is not None and result.min_clearance > 0


@pytest.mark.parametrize("index", range(8))
def test_solved_means_verified(planner, index):
    problem = ROP.draw(PANDA, np.random.default_rng([12, index])).problem(PANDA)
    result = planner.plan(problem, time_limit=60.0, seed=index)
    if result.solved:
        assert result.path is not None and verify(problem, result.path).valid
    else:
        assert result.status is Status.TIMEOUT and result.reason


def test_same_seed_same_path(planner):
    first, second = (planner.plan(PROBLEM, time_limit=60.0, seed=3).path for _ in range(2))
    assert first is not None and second is not None
    assert np.array_equal(first.positions, second.positions)


@pytest.mark.parametrize("sampler", SAMPLERS)
def test_any_sampler_plans(sampler, no_search):
    planner = RobotDiffuse(RobotDiffuseSettings(sampler=sampler, guided_share=1.0, sampling_steps=8))
    result = planner.plan(PROBLEM, time_limit=60.0)
    assert result.stage == "network" and result.path is not None and verify(PROBLEM, result.path).valid


def test_weights_that_need_no_scene_encoding_get_none(planner, no_search, monkeypatch):
    """The encoding of the scene made none of the hybrid's paths shorter, and took 2 ms."""
    monkeypatch.setattr("robotdiffuse.planning.hybrid.encode", None)
    assert planner.plan(PROBLEM, time_limit=60.0).stage == "network"


def test_weights_that_need_a_scene_encoding_get_it(planner):
    model = small_model().requires_grad_(False).eval()
    assert not model.settings.null_condition
    checker = CollisionChecker(box_arm(), Scene([BALL]))
    code = planner.code(model, checker, np.random.default_rng(0))
    assert code.shape == (model.settings.code,) and np.isfinite(code).all()


def test_a_free_straight_line_is_the_answer(planner):
    result = planner.plan(Problem(PANDA, Scene(), LEFT, JointGoal(RIGHT[None])), time_limit=60.0)
    assert result.stage == "straight_line" and result.path_length == pytest.approx(1.8)


def test_a_point_cloud_in_place_of_shapes(planner, no_search):
    """The same ball as points, as a camera sees it."""
    points = sample_surface(PROBLEM.scene, 4000, np.random.default_rng(0))
    problem = Problem(PANDA, Scene([PointCloud(points, 0.01)]), LEFT, JointGoal(RIGHT[None]))
    result = planner.plan(problem, time_limit=60.0)
    assert result.path is not None and result.stage in ("network", "refinement")
    assert verify(PROBLEM, result.path).valid, "the ball lies within its points"


def test_search_answers_where_the_network_gives_nothing(planner, monkeypatch):
    def nothing(self, *_arguments):
        return np.zeros((1, 2, 7), np.float32)

    monkeypatch.setattr(RobotDiffuse, "draw", nothing)
    monkeypatch.setattr(RobotDiffuse, "refine", nothing)
    result = planner.plan(PROBLEM, time_limit=60.0)
    assert result.stage == "aorrtc" and result.path is not None
    assert verify(PROBLEM, result.path).valid


def test_the_first_path_comes_before_the_network_runs(monkeypatch):
    """So a time limit that ends during sampling costs no plan; and the returned path is no longer than the
    first."""
    began = []

    def late(self, *arguments, draw=RobotDiffuse.draw):
        began.append(time.perf_counter() - start)
        return draw(self, *arguments)

    planner = RobotDiffuse(RobotDiffuseSettings(network_share=0.9))  # which is due soon after the path
    planner.plan(PROBLEM, time_limit=60.0, objective="length")
    monkeypatch.setattr(RobotDiffuse, "draw", late)
    start = time.perf_counter()
    result = planner.plan(PROBLEM, time_limit=2.0, until="time_limit", objective="length")
    assert result.path is not None and verify(PROBLEM, result.path).valid
    (first, longest), *_, (_, shortest) = result.progress
    assert first < began[0] and result.path.length == pytest.approx(shortest) and shortest <= longest


def test_the_network_is_loaded_before_the_clock_starts(monkeypatch):
    """So it has its turn from the first call on, however short the limit, and costs that call nothing."""
    order = []
    model = RobotDiffuse.model
    solve = RobotDiffuse.solve
    monkeypatch.setattr(
        RobotDiffuse, "model", lambda self, robot: order.append("model") or model(self, robot)
    )
    monkeypatch.setattr(
        RobotDiffuse, "solve", lambda self, *given: order.append("solve") or solve(self, *given)
    )
    drawn = []
    draw = RobotDiffuse.draw
    monkeypatch.setattr(RobotDiffuse, "draw", lambda *given: drawn.append(1) or draw(*given))
    planner = RobotDiffuse(RobotDiffuseSettings(network_share=0.9))  # which is due soon after the path
    planner.plan(PROBLEM, time_limit=2.0, until="time_limit", objective="length")
    assert order[:2] == ["model", "solve"] and drawn


def test_batches_get_their_part_of_the_work(monkeypatch):
    drawn = []
    draw = RobotDiffuse.draw
    monkeypatch.setattr(RobotDiffuse, "draw", lambda *arguments: drawn.append(1) or draw(*arguments))
    counts = {}
    for share in (0.0, 0.5):
        drawn.clear()
        settings = RobotDiffuseSettings(network_share=share, search=AORRTCSettings(patience=40_000))
        assert RobotDiffuse(settings).plan(PROBLEM, time_limit=60.0, objective="length").solved
        counts[share] = len(drawn)
    assert counts[0.0] == 0 and counts[0.5] >= 40_000 // BATCH_WORK - 1


def test_a_candidate_that_the_validator_refuses_is_not_returned(planner, monkeypatch):
    """The compiled check is not the validator: here it calls candidates through the ball free, and they are
    refused."""

    def through(self, _model, _checker, _code, start, goals, _rng):
        line = start + np.linspace(0, 1, 48)[:, None] * (goals[0] - start)
        return line[None].astype(np.float32)

    monkeypatch.setattr(RobotDiffuse, "draw", through)
    result = planner.plan(PROBLEM, time_limit=60.0)
    assert result.path is not None and result.stage != "network" and verify(PROBLEM, result.path).valid


def test_a_robot_without_weights_is_planned_by_search_and_noise(planner):
    stranger = replace(PANDA, name="stranger")
    assert planner.model(stranger) is None
    result = planner.plan(Problem(stranger, Scene([BALL]), LEFT, JointGoal(RIGHT[None])), time_limit=60.0)
    assert result.stage in ("aorrtc", "smooth_noise") and result.solved
    assert any("no weights" in note for note in result.notes)
    straight = planner.plan(Problem(stranger, Scene(), LEFT, JointGoal(RIGHT[None])))
    assert straight.stage == "straight_line" and not straight.notes  # neither was needed


STRANGER = Problem(replace(PANDA, name="stranger"), Scene([BALL]), LEFT, JointGoal(RIGHT[None]))
"""A problem for a robot without weights."""


@pytest.fixture
def noise_at(monkeypatch):
    """The iterations of search before each batch of smooth noise, and whether there was a path."""
    drawn = []
    searches = []
    search_of = AnytimeSearch.of

    def search(*arguments):
        searches.append(search_of(*arguments))
        return searches[-1]

    def noise(*arguments):
        drawn.append((searches[-1].work, searches[-1].best is not None))
        return smooth_noise(*arguments)

    monkeypatch.setattr(hybrid.AnytimeSearch, "of", search)
    monkeypatch.setattr(hybrid, "smooth_noise", noise)
    return drawn


def test_no_smooth_noise_before_search_has_a_path(planner, no_search, noise_at):
    """Regression: on hard problems of arms without weights, batches of noise took three fifths of the time,
    and the default planner solved fewer problems than its own search."""
    assert planner.plan(STRANGER, time_limit=0.5).status is Status.TIMEOUT
    assert not noise_at


def test_smooth_noise_keeps_to_its_share_of_the_work(noise_at):
    settings = RobotDiffuseSettings(network_share=0.5, search=AORRTCSettings(patience=40_000))
    assert RobotDiffuse(settings).plan(STRANGER, time_limit=60.0, objective="length").solved
    assert noise_at and all(there for _, there in noise_at)
    assert all(work >= k * BATCH_WORK for k, (work, _) in enumerate(noise_at, start=1))


def test_smooth_noise_shortens_and_the_validator_agrees(monkeypatch):
    """The search finds one long detour and then nothing."""
    up = [0.0, -1.0, 0.0, -1.9, 0.0, 2.2, 0.785]
    paths = [np.array([LEFT, up, RIGHT], np.float32)]
    none = np.empty((0, 7), np.float32)
    monkeypatch.setattr(rrt_kernel, "search", lambda *_: paths.pop() if paths else none)
    search = AORRTCSettings(patience=5 * BATCH_WORK, smoothings=0, tightenings=0)
    settings = RobotDiffuseSettings(search=search)
    result = RobotDiffuse(settings).plan(STRANGER, time_limit=60.0, objective="length")
    assert result.stage == "smooth_noise" and result.path is not None and verify(STRANGER, result.path).valid


def test_encodings_distinguish_scenes():
    """Encodings z of two clouds of one scene are nearer to each other than those of two scenes."""
    model = exported_model("model", None, PANDA)
    rng = np.random.default_rng(0)
    near = CollisionChecker(PANDA, Scene([BALL]))
    far = CollisionChecker(PANDA, Scene([Box([-0.4, 0.4, 0.5], [0.2, 0.2, 0.2])]))
    a, b, c = (encode(model, checker, 320, rng) for checker in (near, near, far))
    assert np.linalg.norm(a - b) < 0.5 * np.linalg.norm(a - c)


def test_the_guidance_scale_reaches_the_network():
    checker = CollisionChecker(PANDA, PROBLEM.scene)
    model = exported_model("model", None, PANDA)
    code = encode(model, checker, 320, np.random.default_rng(0))
    plain, same, strong = (
        RobotDiffuse(RobotDiffuseSettings(samples=2, guidance_steps=0, guidance_scale=scale)).draw(
            model, checker, code, LEFT, RIGHT[None], np.random.default_rng(1)
        )
        for scale in (1.0, 1.0, 3.0)
    )
    assert np.array_equal(plain, same) and np.abs(strong - plain).max() > 0.01


def test_the_paper_s_planner_has_a_guidance_scale():
    paths = [
        Diffusion(DiffusionSettings(guidance_scale=scale)).plan(PROBLEM, time_limit=60.0).path
        for scale in (0.0, 1.0, 3.0)
    ]
    assert all(path is not None and verify(PROBLEM, path).valid for path in paths)
    assert len({path.length for path in paths if path is not None}) == 3


def test_locked_joints_that_the_network_does_not_know_keep_the_weights():
    """Fingers locked at another opening; with a locked arm joint the network would have fewer joints."""
    for opening in (0.0, 0.065):
        robot = load_robot("panda", locked={"panda_finger_joint1": opening})
        assert weights_for("model", robot) is not None and RobotDiffuse().model(robot) is not None
    assert weights_for("model", load_robot("panda", locked={"panda_joint7": 0.3})) is None
