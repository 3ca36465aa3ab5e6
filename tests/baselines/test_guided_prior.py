"""The diffusion prior of MPD and EDMP, their guides, and planners around a denoiser of closed form."""

from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from jaxtyping import Float
from numpy import ndarray

from helpers.panda import LEFT, PANDA, RIGHT
from helpers.refusals import refuses
from helpers.trainings import trained
from robotdiffuse import JointGoal, Problem, Scene, Sphere, Status
from robotdiffuse.baselines import guided_prior
from robotdiffuse.collision import CollisionChecker
from robotdiffuse.core.deadline import OutOfTimeError, deadline
from robotdiffuse.learning.denoisers import UNetSettings
from robotdiffuse.learning.diffusion import NoiseSchedule, ScheduleSettings
from robotdiffuse.learning.motion_network import MotionNetwork
from robotdiffuse.learning.training.batches import Batches, TrajectoryData
from robotdiffuse.learning.training.config import planner_training
from robotdiffuse.learning.training.loop import Processes
from robotdiffuse.learning.training.tasks import PlannerLoss, model_settings, planning_success
from robotdiffuse.learning.weight_files import RobotIdentity
from robotdiffuse.scenes.packed_scenes import PackedScenes

RANGES = RobotIdentity.of(PANDA)
BALL = Sphere([0.5, 0.0, 0.4], 0.15, name="ball")
PROBLEM = Problem(PANDA, Scene([BALL]), LEFT, JointGoal(RIGHT[None]))
CHECKER = CollisionChecker(PANDA, PROBLEM.scene)
TRAINING = planner_training("trajectory_prior", {"data": "", "batch": 16, "samples": 640})
SMALL = replace(model_settings(TRAINING, None), denoiser_settings=UNetSettings(16, (1, 2), condition_width=16))
WAYPOINTS = 48


def bumps(waypoints: int) -> Float[ndarray, "inner inner"]:
    t = np.linspace(0, 1, waypoints)[1:-1, None]
    waves = np.concatenate([0.25 / k * np.sin(np.pi * k * t) for k in (1, 2, 3)], 1)
    return waves @ waves.T + 1e-6 * np.eye(waypoints - 2)


class Gaussian(MotionNetwork):
    """The exact denoiser of straight lines with Gaussian bumps."""

    def denoise(self, features: torch.Tensor, level: torch.Tensor, condition: torch.Tensor, dropped=None) -> torch.Tensor:
        at = round(float(level[0]) * self.schedule.steps)
        x = features.numpy()
        signal, noise = float(self.schedule.signal[at]), float(self.schedule.noise[at])
        t = np.linspace(0, 1, x.shape[1])[1:-1, None]
        line = (1 - t) * x[:, :1] + t * x[:, -1:]
        total = signal**2 * bumps(x.shape[1]) + noise**2 * np.eye(x.shape[1] - 2)
        seen = noise * np.linalg.solve(total, x[:, 1:-1].astype(np.float64) - signal * line)
        return torch.nn.functional.pad(torch.from_numpy(seen.astype(np.float32)), (0, 0, 1, 1))


GAUSSIAN = Gaussian(RANGES, SMALL)


def data_of(count: int, waypoints: int = WAYPOINTS) -> TrajectoryData:
    rng = np.random.default_rng(1)
    t = np.linspace(0, 1, waypoints)[:, None]
    middle = (PANDA.lower + PANDA.upper) / 2
    ends = middle + (PANDA.upper - PANDA.lower) * rng.uniform(-0.3, 0.3, (2, count, 1, PANDA.dof))
    q = (1 - t) * ends[0] + t * ends[1] + 0.3 * np.sin(np.pi * t) * rng.normal(size=(count, 1, PANDA.dof))
    scenes = PackedScenes.pack([Scene([BALL])] * count, 1)
    return TrajectoryData(q.astype(np.float32), scenes, np.arange(count) % 3 == 0, None, "x", 0)


@pytest.mark.slow
def test_the_loss_falls() -> None:
    torch.manual_seed(0)
    network = MotionNetwork(RANGES, SMALL)
    rng = np.random.default_rng(0)
    batches = Batches(data_of(32), network, lambda _scenes, _q: np.zeros(0), 0.1, None)
    loss_of = PlannerLoss(network, PANDA, TRAINING, Processes("cpu"))
    losses = trained(network, lambda _: loss_of(batches.draw(16, rng), 0.0, rng), 40, 4e-3)
    # an untrained network predicts no noise, whose variance is 1
    assert losses[0] == pytest.approx(1.0, abs=0.1) and np.mean(losses[-5:]) < 0.6
    share = planning_success(network, PANDA, data_of(6), 4, 2, rng)
    assert share is not None and 0 <= share <= 1
    # Regression: without a problem that is not trivial, `train planner` printed "success: nan".
    assert planning_success(network, PANDA, data_of(1), 4, 2, rng) is None


def test_share_of_trivial_motions() -> None:
    data = data_of(30)
    rng = np.random.default_rng(0)
    drawn = data.draw(4000, 0.2, rng)
    assert data.trivial[drawn].mean() == pytest.approx(0.2, abs=0.02)
    assert set(np.unique(drawn)) == set(range(30))
    for trivial in (np.ones(30, bool), np.zeros(30, bool)):  # of one kind alone
        assert set(np.unique(replace(data, trivial=trivial).draw(4000, 0.2, rng))) == set(range(30))


@pytest.mark.slow
def test_samples_have_the_mean_and_variance_of_the_data() -> None:
    starts, goals = (np.repeat(end[None], 300, 0) for end in (LEFT, RIGHT))
    levels = GAUSSIAN.schedule.sampling_levels(100)[:-1]
    q = guided_prior.sample(GAUSSIAN, starts, goals, levels, np.random.default_rng(0), lambda q, _: q)
    x = GAUSSIAN.normalizer.to_unit(q.astype(np.float64))
    t = np.linspace(0, 1, WAYPOINTS)[:, None]
    bump = x - ((1 - t) * x[:, :1] + t * x[:, -1:])
    # joints whose bumps are clipped at the limits say nothing about the sampler
    whole = np.abs(x).max((0, 1)) < 0.99
    assert whole.sum() >= 2
    bump = bump[:, 1:-1, whole]
    variance = np.diag(bumps(WAYPOINTS))
    assert np.abs(bump.mean((0, 2))).max() < 4 * np.sqrt(variance.max() / (300 * whole.sum()))
    assert bump.var((0, 2)).mean() == pytest.approx(variance.mean(), rel=0.1)


def test_samples_hold_their_ends_exactly() -> None:
    torch.manual_seed(0)
    network = MotionNetwork(RANGES, SMALL)
    rng = np.random.default_rng(0)
    starts, goals = (rng.uniform(PANDA.lower, PANDA.upper, (3, PANDA.dof)).astype(np.float32) for _ in "ab")
    levels = np.array([255, 100, 20, 1])
    q = guided_prior.sample(network, starts, goals, levels, rng, lambda q, left: q + np.float32(0.1 * (left < 2)))
    assert q.dtype == np.float32 and q.shape == (3, WAYPOINTS, PANDA.dof)
    assert np.array_equal(q[:, 0], starts) and np.array_equal(q[:, -1], goals)
    assert np.all(q >= PANDA.lower - 1e-5) and np.all(q <= PANDA.upper + 1e-5)


def test_the_guide_gets_the_number_of_steps_to_come() -> None:
    guide = Mock(side_effect=lambda q, left: q)
    ends = LEFT[None], RIGHT[None]
    guided_prior.sample(GAUSSIAN, *ends, np.array([255, 90, 1]), np.random.default_rng(0), guide, quiet_steps=2)
    assert [call.args[1] for call in guide.call_args_list] == [2, 1, 0, 0, 0]
    with deadline(lambda: 0.0), pytest.raises(OutOfTimeError):
        guided_prior.sample(GAUSSIAN, *ends, np.array([255, 1]), np.random.default_rng(0), guide)
    assert guide.call_count == 5


@pytest.mark.parametrize("spaced", [guided_prior.exponential_levels, guided_prior.quadratic_levels])
@pytest.mark.parametrize("steps", [2, 25, 255])
def test_spaced_levels(spaced, steps: int) -> None:
    schedule = NoiseSchedule(ScheduleSettings(steps=255))
    levels = spaced(schedule, steps)
    assert len(levels) == steps and levels[0] == 255 and levels[-1] >= 1 and np.all(np.diff(levels) < 0)
    refuses("between 1 and 255", spaced, schedule, 256)


def test_the_precision_is_that_of_the_process() -> None:
    """Compares with the covariance of the process, propagated from a first state with a large variance."""
    waypoints = 8
    transition = np.array([[1.0, 1.0], [0.0, 1.0]])
    noise = np.array([[1 / 3, 1 / 2], [1 / 2, 1.0]])
    covariance = np.zeros((2 * waypoints, 2 * waypoints))
    covariance[:2, :2] = 1e3 * np.eye(2)
    for i in range(1, waypoints):
        here = slice(2 * i, 2 * i + 2)
        before = slice(2 * i - 2, 2 * i)
        covariance[here, : 2 * i] = transition @ covariance[before, : 2 * i]
        covariance[: 2 * i, here] = covariance[here, : 2 * i].T
        covariance[here, here] = transition @ covariance[before, before] @ transition.T + noise
    assert guided_prior.position_precision(waypoints) == pytest.approx(np.linalg.inv(covariance[::2, ::2]), abs=0.01)


def test_implicit_step_of_the_process() -> None:
    q = np.random.default_rng(0).normal(size=(2, 10, 3))
    x = guided_prior.implicit_step(q, 5.0)
    precision = guided_prior.position_precision(10)
    assert np.array_equal(x[:, [0, -1]], q[:, [0, -1]])
    assert x[:, 1:-1] == pytest.approx((q - 5.0 * precision @ x)[:, 1:-1])
    assert np.all((x * (precision @ x)).sum((1, 2)) < (q * (precision @ q)).sum((1, 2)))


def lines(count: int) -> Float[ndarray, "count waypoints dof"]:
    t = np.linspace(0, 1, WAYPOINTS)[:, None]
    bump = np.sin(np.pi * t) * np.random.default_rng(3).normal(0, 0.1, (count, 1, PANDA.dof))
    return ((1 - t) * LEFT + t * RIGHT + bump).astype(np.float32)


def collision_costs(q: np.ndarray, margins: tuple[float, float], between: int = 0) -> np.ndarray:
    """The costs of trajectories whose gradient is `collision_gradient`."""
    total = np.zeros(len(q))
    for share in np.arange(between + 1) / (between + 1):
        rows = q if share == 0 else q[:, :-1] + np.float32(share) * np.diff(q, axis=1)
        squares = CHECKER.cost_gradients(rows.reshape(-1, PANDA.dof), *margins)[0]
        total = total + np.sqrt(2 * squares).reshape(rows.shape[:2]).sum(1) / (between if share else 1)
    return total


@pytest.mark.parametrize("between", [0, 1, 3])
def test_gradient_of_the_collision_cost(between: int) -> None:
    """Compares with the difference of costs along the gradient, within 3 %: the cost has kinks at margins and corners."""
    q = lines(3)
    gradient = guided_prior.collision_gradient(CHECKER, q, 0.05, 0.01, between)
    size = np.sqrt((gradient**2).sum((1, 2)))[:, None, None]
    step = 1e-2 * gradient / size
    up, here, down = (collision_costs(rows, (0.05, 0.01), between) for rows in (q + step, q, q - step))
    assert np.all(here > 0.1)
    assert (up - down) / 2e-2 == pytest.approx(size[:, 0, 0], rel=0.03)


def test_guidance_lowers_the_collision_cost() -> None:
    q = lines(12)
    before = collision_costs(q, (0.0, 0.0))
    for planner in (guided_prior.MPD(), guided_prior.EDMP(guided_prior.EDMPSettings(samples=12))):
        moved = planner.guided(CHECKER, q, 0)
        assert np.all(collision_costs(moved, (0.0, 0.0)) < before) and np.array_equal(moved[:, [0, -1]], q[:, [0, -1]])


def test_each_guide_moves_only_its_rows() -> None:
    edmp = guided_prior.EDMP(guided_prior.EDMPSettings(samples=30))
    shares = edmp.settings.shares()
    assert np.array_equal(np.concatenate([np.arange(30)[share] for share in shares]), np.arange(30))
    assert len(set(guided_prior.ENSEMBLE)) == len(shares) == 12
    same = np.repeat(lines(1), 30, 0)
    moved = edmp.guided(CHECKER, same, 10)
    first = [moved[share][0] for share in shares]
    for i, one in enumerate(first):
        assert all(np.array_equal(one, row) for row in moved[shares[i]])
        assert not any(np.array_equal(one, other) for other in first[:i])
    # before any guide begins
    guides = tuple(replace(guide, guided_share=0.4) for guide in guided_prior.ENSEMBLE)
    late = guided_prior.EDMP(guided_prior.EDMPSettings(guides=guides))
    assert np.array_equal(late.guided(CHECKER, same[:24], 12), same[:24])


@pytest.fixture(params=["mpd", "edmp"])
def planner(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch):
    made = guided_prior.MPD() if request.param == "mpd" else guided_prior.EDMP()
    monkeypatch.setattr(made, "network", lambda _robot: GAUSSIAN)
    return made


def test_the_same_seed_gives_the_same_path(planner: guided_prior.MPD | guided_prior.EDMP) -> None:
    paths = [planner.plan(PROBLEM, time_limit=120.0, seed=seed).path.positions for seed in (0, 0, 1)]
    assert np.array_equal(paths[0], paths[1]) and not np.array_equal(paths[0], paths[2])
    assert np.array_equal(paths[0][[0, -1]], np.stack([LEFT, RIGHT]))


def test_failure_says_what_was_wrong(planner, monkeypatch):
    monkeypatch.setattr(guided_prior, "sample", lambda *_arguments: lines(planner.settings.samples))
    planner.plan(PROBLEM, time_limit=0.1)  # compiles and loads
    result = planner.plan(PROBLEM, time_limit=0.5)
    assert result.status is Status.TIMEOUT and result.path is None
    assert result.refused == "scene_collision" and "samples" in result.reason


def test_bad_settings() -> None:
    refuses(r"model.encoder is pointnet and encoder_settings are", replace, SMALL, encoder="pointnet")
    refuses(r"denoiser is encoder_decoder", replace, SMALL, denoiser="encoder_decoder")
    refuses(r"target is limits and smooth_noise is True", replace, TRAINING, smooth_noise=True)
    refuses(r"edmp.samples is 11; it must be at least 12, one for each guide", guided_prior.EDMPSettings, samples=11)
