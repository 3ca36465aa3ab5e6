"""Schedule, objectives, samplers: on Gaussian data, where closed forms are known, and against diffusers."""

from collections.abc import Callable
from unittest.mock import Mock

import numpy as np
import pytest
import torch

import robotdiffuse as rd
from robotdiffuse.learning.checkpoint import load_network
from robotdiffuse.learning.diffusion import OBJECTIVES, SAMPLERS, NoiseSchedule, ScheduleSettings

MEAN = np.array([0.7, -0.3])
MIX = np.array([[1.2, 0.3], [0.4, 0.6]])
COVARIANCE = MIX @ MIX.T


def cosine_schedule(steps: int = 200) -> NoiseSchedule:
    return NoiseSchedule(ScheduleSettings(steps=steps))


def best_predictor(schedule: NoiseSchedule) -> Callable[[np.ndarray, int], np.ndarray]:
    def predict(x, level):
        a = schedule.signal[level]
        s = schedule.noise[level]
        gain = a * COVARIANCE @ np.linalg.inv(a**2 * COVARIANCE + s**2 * np.eye(2))
        return MEAN + (x - a * MEAN) @ gain.T

    return predict


def exact_moments(name: str, schedule: NoiseSchedule, steps: int, eta: float) -> tuple[np.ndarray, np.ndarray]:
    """Mean and covariance of the samples, affine functions of the noises drawn: from none, and from a unit in one component."""
    draws = 0
    impulses = np.zeros((1 + 2 * (steps + 1), steps + 1, 2))
    impulses[1:] = np.eye(2 * (steps + 1)).reshape(-1, steps + 1, 2)

    def draw():
        nonlocal draws
        draws += 1
        return impulses[:, draws - 1]

    x = SAMPLERS.load(name)(best_predictor(schedule), schedule, draw, steps, eta)
    return x[0], (x[1:] - x[0]).T @ (x[1:] - x[0])


@pytest.mark.parametrize("name", SAMPLERS)
def test_stochastic_samples_have_the_data_s_moments(name):
    """If all noise is drawn anew in each step, the error of the covariance is proportional to the step size."""
    schedule = cosine_schedule(1024)
    steps = [32, 64, 128, 256]
    moments = [exact_moments(name, schedule, n, 1.0) for n in steps]
    off = np.array([np.abs(covariance - COVARIANCE).max() for _, covariance in moments])
    assert (np.diff(off) < 0).all() and np.polyfit(np.log(steps), np.log(off), 1)[0] < -0.8 and off[-1] < 0.09
    assert max(np.abs(mean - MEAN).max() for mean, _ in moments) < 2e-4


@pytest.mark.parametrize("name", SAMPLERS)
@pytest.mark.parametrize("steps", [1, 2, 3, 200])
def test_calls_of_the_predictor(name, steps):
    """One call per step, from the last level downwards, and values that are finite for any output; the last is the result."""
    schedule = cosine_schedule()
    rng = np.random.default_rng(0)
    levels = []
    predictions = []

    def predict(x, level):
        levels.append(level)
        predictions.append(rng.uniform(-1, 1, x.shape).astype(np.float32))
        return predictions[-1]

    x = SAMPLERS.load(name)(predict, schedule, lambda: rng.standard_normal((2, 3), dtype=np.float32), steps, 0.5)
    assert x is predictions[-1] and x.dtype == np.float32
    assert levels == schedule.sampling_levels(steps)[:-1].tolist() and np.isfinite(x).all()


def network(x: np.ndarray, level: int) -> np.ndarray:
    return np.tanh(x + np.sin(level)) + 0.1 * x


def draws_for(steps: int) -> list[np.ndarray]:
    """The first noise and that of every step, as a torch.Generator with seed 1 draws them."""
    generator = torch.Generator().manual_seed(1)
    later = [torch.randn(4, 3, generator=generator, dtype=torch.float64).numpy() for _ in range(steps)]
    return [np.random.default_rng(0).standard_normal((4, 3)), *later]


def our_steps(name: str, schedule: NoiseSchedule, steps: int, eta: float) -> np.ndarray:
    predict = Mock(wraps=network)
    sample = SAMPLERS.load(name)(predict, schedule, iter(draws_for(steps)).__next__, steps, eta)
    return np.array([*(call.args[0] for call in predict.call_args_list), sample])


def their_steps(levels: list[int], scheduler, variance_noise: bool, **settings) -> np.ndarray:
    draws = [torch.from_numpy(n) for n in draws_for(len(levels) - 1)]
    x = draws[0]
    found = [draws[0].numpy()]
    for timestep, level, noise in zip(scheduler.timesteps, levels[:-1], draws[1:], strict=True):
        if variance_noise:
            settings["variance_noise"] = noise
        x = scheduler.step(torch.from_numpy(network(x.numpy(), level)), timestep, x, **settings).prev_sample.double()
        found.append(x.numpy())
    return np.array(found)


@pytest.mark.parametrize(
    ("name", "steps", "eta"), [("ddpm", 200, 1.0), ("ddpm", 7, 1.0), ("ddim", 20, 0.0), ("ddim", 20, 1.0), ("ddim", 8, 0.5)]
)
def test_against_diffusers(name, steps, eta):
    diffusers = pytest.importorskip("diffusers")
    schedule = cosine_schedule()
    levels = schedule.sampling_levels(steps).tolist()
    alpha_bar = schedule.signal**2
    betas = 1 - alpha_bar[1:] / alpha_bar[:-1]
    vp = {"num_train_timesteps": schedule.steps, "trained_betas": betas, "prediction_type": "sample"}
    if name == "ddpm":
        scheduler = diffusers.DDPMScheduler(**vp, clip_sample=False)
        scheduler.set_timesteps(timesteps=[level - 1 for level in levels[:-1]])
        settings = {"generator": torch.Generator().manual_seed(1)}
    else:
        trailing = {"timestep_spacing": "trailing", "set_alpha_to_one": True}
        scheduler = diffusers.DDIMScheduler(**vp, clip_sample=False, **trailing)
        scheduler.set_timesteps(steps)
        settings = {"eta": eta}
    scheduler.alphas_cumprod = torch.from_numpy(alpha_bar[1:])  # theirs is in single precision
    theirs = their_steps(levels, scheduler, name == "ddim", **settings)
    np.testing.assert_allclose(our_steps(name, schedule, steps, eta), theirs, atol=1e-5)


def test_the_schedule_which_is_that_of_the_bundled_model():
    schedule = cosine_schedule()
    curve = np.cos((np.arange(201) / 200 + 0.008) / 1.008 * np.pi / 2) ** 2
    np.testing.assert_array_equal(schedule.signal, np.sqrt(np.maximum(curve / curve[0], 1e-4)))
    np.testing.assert_array_equal(load_network("model", "panda", rd.load_robot("panda")).schedule.signal, schedule.signal)
    np.testing.assert_allclose(schedule.signal**2 + schedule.noise**2, 1)
    snr = (schedule.signal[1:] / schedule.noise[1:]) ** 2
    np.testing.assert_allclose(schedule.weight(np.arange(1, 201), 5.0), np.minimum(1 + snr, 5))
    assert schedule.weight(np.arange(1), 5.0)[0] == 5


@pytest.mark.parametrize("as_given", [np.asarray, torch.from_numpy])
@pytest.mark.parametrize("name", OBJECTIVES)
def test_objective_round_trip(name, as_given):
    schedule = cosine_schedule()
    objective = OBJECTIVES[name]
    clean, noise = map(as_given, np.random.default_rng(0).standard_normal((2, 201, 5, 2)))
    a, s = (as_given(v[:, None, None]) for v in (schedule.signal, schedule.noise))
    back = objective.clean(a * clean + s * noise, objective.target(clean, noise), a, s)
    np.testing.assert_allclose(back, clean, atol=1e-9)


@pytest.mark.parametrize("limit", [5.0, 100.0])
@pytest.mark.parametrize("name", OBJECTIVES)
def test_objectives_weigh_levels_alike(name, limit):
    """The weighted error of the output equals that of the clean trajectory wherever the weight is below its limit."""
    schedule = cosine_schedule()
    objective = OBJECTIVES[name]
    t = np.arange(1, 200)
    weight = objective.weight(schedule, t, limit)
    moved = objective.clean(np.zeros(199), np.ones(199), schedule.signal[t], schedule.noise[t])  # by an error of 1, as x_t is 0
    wanted = schedule.weight(t, limit)
    free = weight < limit
    assert free.sum() > 50
    np.testing.assert_allclose(weight[free], (wanted * moved**2)[free])
    assert (weight <= limit).all() and (weight > 0).all()
    if name == "clean":
        np.testing.assert_allclose(weight, wanted)
