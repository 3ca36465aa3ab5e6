"""Sampling with known waypoints (noise interpolation), at chosen steps, with a chosen sampler."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from numpy import ndarray

from helpers.box_arm import box_arm
from robotdiffuse.collision import CollisionChecker
from robotdiffuse.core.errors import InputError
from robotdiffuse.learning.checkpoint import load_model
from robotdiffuse.learning.clearance_features import link_clearances
from robotdiffuse.learning.denoisers.transformer import TransformerSettings
from robotdiffuse.learning.encoders.point_autoencoder import PointAutoencoderSettings
from robotdiffuse.learning.guidance import CollisionGuidance
from robotdiffuse.learning.motion_model import MotionModel, MotionModelSettings
from robotdiffuse.learning.robot_identity import RobotIdentity
from robotdiffuse.learning.samplers import SAMPLERS
from robotdiffuse.planning.diffusion.diffusion import encode
from robotdiffuse.planning.diffusion.hybrid import RobotDiffuse
from robotdiffuse.robots import load_robot
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import Sphere

ARM = box_arm()
START, GOAL = np.array([-1.0, 0.5, 2.0]), np.array([1.5, -0.5, 0.1])
WAYPOINTS = 16
SETTINGS = MotionModelSettings(
    waypoints=WAYPOINTS,
    encoder_settings=PointAutoencoderSettings(code=8, points=(16, 24), hidden=16, decoded=12),
    denoiser_settings=TransformerSettings(width=16, layers=1, heads=2, hidden=32, patch=4),
)


def small_model(smooth: bool = True, **changes: object) -> MotionModel:
    """Random weights, statistics of random arcs."""
    torch.manual_seed(0)
    model = MotionModel(RobotIdentity.of(ARM), replace(SETTINGS, **changes))
    torch.nn.init.normal_(model.denoiser.out.weight, std=0.2)
    rng, t = np.random.default_rng(0), np.linspace(0, 1, WAYPOINTS)[:, None]
    ends = rng.uniform(-1.0, 1.0, (2, 200, 1, 3))
    bumps = sum(np.sin(np.pi * k * t) * rng.normal(0, 0.5 / k**2, (200, 1, 3)) for k in range(1, 8))
    model.fit_statistics((ends[0] + t * (ends[1] - ends[0]) + bumps).astype(np.float32), smooth)
    return model.for_inference()


def sample(model: MotionModel, seed: int = 0, **arguments: object) -> ndarray:
    """Five trajectories from START to GOAL in free space."""
    rng = np.random.default_rng(seed)

    def far(q: ndarray) -> ndarray:
        return np.full((*q.shape[:2], 3), 0.2, np.float32)

    return model.sample(np.zeros(8, np.float32), START, GOAL, 5, rng, far, **arguments)  # pyright: ignore


def away(start: ndarray, step: ndarray, count: int) -> ndarray:
    return start + np.arange(count)[:, None] * step


PREFIX, SUFFIX = away(START, np.array([0.0, 0.1, -0.1]), 4), away(GOAL, np.array([-0.1, 0.0, 0.1]), 3)[::-1]


@pytest.mark.parametrize("smooth", [True, False])
@pytest.mark.parametrize("target", ["residual", "absolute"])
@pytest.mark.parametrize("objective", ["clean", "noise", "velocity"])
@pytest.mark.parametrize("sampler", SAMPLERS)
def test_known_waypoints_are_in_the_result(smooth: bool, target: str, objective: str, sampler: str) -> None:
    model = small_model(smooth, target=target, objective=objective, sampler=sampler)
    q = sample(model, prefix=PREFIX, suffix=SUFFIX, eta=0.5)
    assert np.isfinite(q).all()
    assert (q[:, :4] == PREFIX).all() and (q[:, -3:] == SUFFIX).all()
    if objective == "clean":  # others are beyond the limits, with random weights
        assert q[:, 4:-3].std(0).max() > 1e-4, "the rest is still drawn"


def test_ends_alone_are_the_default() -> None:
    model = small_model()
    np.testing.assert_array_equal(sample(model), sample(model, prefix=START[None], suffix=GOAL[None]))
    assert (sample(model)[:, 3] != PREFIX[3]).any()


def test_the_network_and_the_guide_meet_known_waypoints() -> None:
    model, told, guided = small_model(), [], []
    rng = np.random.default_rng(0)

    def clearances(q: ndarray) -> ndarray:
        told.append(q)
        return np.full((*q.shape[:2], 3), 0.2, np.float32)

    def guide(q: ndarray, _level: float) -> ndarray:
        guided.append(q)
        return q + 0.1

    code = np.zeros(8, np.float32)
    model.sample(code, START, GOAL, 2, rng, clearances, 4, guide, guided_share=1.0, prefix=PREFIX)
    assert len(told) == len(guided) == 4
    for q in told + guided:
        np.testing.assert_allclose(q[:, :4], np.broadcast_to(PREFIX, (2, 4, 3)), atol=1e-5)


def test_regression_is_that_of_smooth_noise() -> None:
    """Noise that is drawn and conditioned on zeros has none at known waypoints, and less beside them."""
    model = small_model()
    assert model.regression(model.around(PREFIX[:1], SUFFIX[-1:])) is None
    gain = model.regression(model.around(PREFIX, SUFFIX))
    assert gain is not None
    noise = model.draw_noise(4000, np.random.default_rng(0))
    left = noise - gain @ noise
    np.testing.assert_allclose(left[:, [0, 1, 2, 3, -3, -2, -1]], 0.0, atol=1e-4)
    assert left[:, 4].std() < 0.3 * noise[:, 4].std()
    near = model.regression(model.around(PREFIX, SUFFIX), reach=2.0)
    assert near is not None
    assert np.abs(near[8, [1, 2, 3]]).sum() < 0.3 * np.abs(gain[8, [1, 2, 3]]).sum()
    # what is left has nothing to do with what is known
    known, others = noise[:, [1, 2, 3], 0], left[:, 4:-3, 0]
    assert np.abs(np.corrcoef(known.T, others.T)[:3, 3:]).max() < 0.06


def test_white_noise_moves_no_other_row() -> None:
    model = small_model(smooth=False)
    gain = model.regression(model.around(PREFIX, SUFFIX))
    assert gain is not None and np.array_equal(np.flatnonzero(gain.sum(1)), [1, 2, 3, 13, 14])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"prefix": PREFIX[1:]}, "prefix must have the start as waypoint 0"),
        ({"suffix": SUFFIX[:-1]}, "suffix must have the goal as waypoint -1"),
        ({"prefix": PREFIX[:0]}, "prefix must have the start"),
        (
            {"prefix": away(START, np.zeros(3), 13), "suffix": SUFFIX},
            "13 and 3 waypoints; they must leave some of 16",
        ),
        ({"sampler": "heun"}, "unknown sampler 'heun'; known: ddim, ddpm"),
        ({"guided_share": 1.5}, "guided_share is 1.5"),
    ],
)
def test_bad_input_is_refused(arguments: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        sample(small_model(), **arguments)


def test_control_points_know_the_ends_only() -> None:
    model = small_model(parametrization="b_spline", rows=8)
    assert (sample(model)[:, 0] == START).all()
    with pytest.raises(
        InputError, match="prefix and suffix have 4 and 1 waypoints; control points can hold 1 and 1"
    ):
        sample(model, prefix=PREFIX)


@pytest.mark.parametrize(
    ("steps", "share", "guided"),
    [
        (6, 0.5, 3),
        (5, 0.5, 3),
        (1, 0.5, 1),
        (6, 0.0, 0),
        (6, 1.0, 6),
        (10, 0.3, 3),
        (30, 0.1, 3),
        (50, 0.02, 1),
    ],
)
def test_the_last_share_of_the_steps_is_guided(steps: int, share: float, guided: int) -> None:
    model, levels = small_model(), []

    def guide(q: ndarray, level: float) -> ndarray:
        levels.append(level)
        return q

    sample(model, steps=steps, guide=guide, guided_share=share)
    expected = model.schedule.sampling_levels(steps)[:-1] / model.schedule.steps
    np.testing.assert_allclose(levels, expected[steps - guided :])


def test_a_sampler_by_name_is_that_of_a_checkpoint() -> None:
    for name in SAMPLERS:
        np.testing.assert_array_equal(
            sample(small_model(), steps=4, sampler=name), sample(small_model(sampler=name), steps=4)
        )


def test_the_panda_goes_on_from_what_it_is_committed_to() -> None:
    """It moves along one plan, and is given another goal: no jump where the new plan begins."""
    robot, model, rng = load_robot("panda"), load_model("panda"), np.random.default_rng(0)
    assert model is not None
    checker = CollisionChecker(robot, Scene([Sphere([0.5, 0.0, 0.4], 0.15)]))
    start, goal = (np.array([side, 0.3, 0.0, -1.9, 0.0, 2.2, 0.785]) for side in (0.9, -0.9))
    code = encode(model, checker, 320, rng)
    drawn = RobotDiffuse().draw(model, checker, code, start, goal[None], rng)
    moving = next(q for q in drawn if checker.free(q).all())
    prefix = moving[10:18].astype(float)
    guidance = CollisionGuidance(checker)
    q = model.sample(
        code,
        prefix[0],
        goal + np.array([-0.4, 0.3, 0.2, 0.0, 0.3, 0.0, 0.0]),
        16,
        rng,
        link_clearances(checker, model.settings),
        guide=lambda q, _level: guidance(q, 4, prefix=8)[0],
        prefix=prefix,
    )
    assert (q[:, :8] == prefix).all()
    steps = np.linalg.norm(np.diff(q, axis=1), axis=-1)
    others = np.maximum(np.median(steps[:, 8:], axis=1), steps[:, 6])
    assert (steps[:, 7] < 2.5 * others).all()
    directions = np.diff(q, axis=1)[:, 6:8] / steps[:, 6:8, None]
    assert ((directions[:, 0] * directions[:, 1]).sum(-1) > 0).all(), "it goes on, it does not turn back"
    assert checker.free(q[:, 7:].reshape(-1, 7)).reshape(16, -1).all(1).any()
