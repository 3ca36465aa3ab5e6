"""Schedules, objectives, samplers: on Gaussian data, where all is known exactly, and against diffusers."""

from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest
import torch

from robotdiffuse.core.errors import InputError
from robotdiffuse.learning.checkpoint import load_model
from robotdiffuse.learning.diffusion import SCHEDULES, NoiseSchedule, ScheduleSettings
from robotdiffuse.learning.objectives import OBJECTIVES, objective_for
from robotdiffuse.learning.samplers import SAMPLERS
from robotdiffuse.learning.samplers.ddim import ddim
from robotdiffuse.learning.samplers.ddpm import ddpm

ORDERS = {"ddim": 1, "euler": 1, "dpm_solver": 2}
"""Of the deterministic samplers."""
MEAN = np.array([0.7, -0.3])
MIX = np.array([[1.2, 0.3], [0.4, 0.6]])
COVARIANCE = MIX @ MIX.T


def schedule_of(kind: str, steps: int = 200) -> NoiseSchedule:
    return NoiseSchedule(ScheduleSettings(steps=steps, kind=kind))


@pytest.fixture
def log_snr_schedule(monkeypatch) -> NoiseSchedule:
    """Levels even in log-SNR, so that all steps in it shrink but the last, from hardly any noise."""
    half = np.concatenate([[np.inf], np.linspace(8, -4, 4096)])
    signal, noise = 1 / np.sqrt(1 + np.exp(-2 * half)), 1 / np.sqrt(1 + np.exp(2 * half))
    monkeypatch.setitem(SCHEDULES, "log_snr", lambda settings: (signal, noise))
    return schedule_of("log_snr", 4096)


def best_predictor(schedule: NoiseSchedule) -> Callable[[np.ndarray, int], np.ndarray]:
    """E[x_0 | x_t] for Gaussian data and white noise."""

    def predict(x, level):
        a, s = schedule.signal[level], schedule.noise[level]
        gain = a * COVARIANCE @ np.linalg.inv(a**2 * COVARIANCE + s**2 * np.eye(2))
        return MEAN + (x - a * MEAN) @ gain.T

    return predict


def exact_flow(schedule: NoiseSchedule, x: np.ndarray) -> np.ndarray:
    """Where the probability flow takes x from the last level: deviations along each principal axis scale."""
    a, s = schedule.signal[-1], schedule.noise[-1]
    values, axes = np.linalg.eigh(COVARIANCE)
    scale = np.sqrt(values / (a**2 * values + s**2))
    return MEAN + (x - a * MEAN) @ (axes * scale) @ axes.T


def flow_errors(name: str, schedule: NoiseSchedule, steps: list[int]) -> np.ndarray:
    """RMS distance of samples from where the exact flow takes the same noise."""
    noise = np.random.default_rng(0).standard_normal((64, 2))
    exact, predict = exact_flow(schedule, noise), best_predictor(schedule)
    samples = [SAMPLERS.load(name)(predict, schedule, lambda: noise, n, 0.0) for n in steps]
    return np.array([np.sqrt(((x - exact) ** 2).mean()) for x in samples])


def exact_moments(
    name: str, schedule: NoiseSchedule, steps: int, eta: float
) -> tuple[np.ndarray, np.ndarray]:
    """Mean and covariance of the samples, without chance: a sample is affine in the noises that are drawn, so
    one sample without noise and one with a unit of each component of each draw tell all."""
    draws = 0
    impulses = np.zeros((1 + 2 * (steps + 1), steps + 1, 2))
    impulses[1:] = np.eye(2 * (steps + 1)).reshape(-1, steps + 1, 2)

    def draw():
        nonlocal draws
        draws += 1
        return impulses[:, draws - 1]

    x = SAMPLERS.load(name)(best_predictor(schedule), schedule, draw, steps, eta)
    return x[0], (x[1:] - x[0]).T @ (x[1:] - x[0])


def slope(steps: list[int], errors: np.ndarray) -> float:
    """Order of convergence, fitted on logarithms."""
    return -np.polyfit(np.log(steps), np.log(errors), 1)[0]


def test_every_sampler_is_tested():
    assert {*ORDERS, "ddpm"} == {*SAMPLERS}


@pytest.mark.parametrize("name", ORDERS)
def test_order(name, log_snr_schedule):
    steps = [32, 64, 128, 256]
    errors = flow_errors(name, log_snr_schedule, steps)
    assert (np.diff(errors) < 0).all()
    assert slope(steps, errors) == pytest.approx(ORDERS[name], abs=0.1)


@pytest.mark.parametrize("kind", ["cosine", "linear", "flow"])
@pytest.mark.parametrize("name", ORDERS)
def test_order_on_the_schedules(name, kind):
    """Levels evenly spaced in t: at the ends of a schedule the steps in log-SNR do not shrink, and the last
    one, of first order, starts from more noise. Both cost a little of the second order."""
    steps = [32, 64, 128, 256]
    errors = flow_errors(name, schedule_of(kind, 8192), steps)
    assert (np.diff(errors) < 0).all()
    assert slope(steps, errors) > {1: 0.95, 2: 1.6}[ORDERS[name]]


@pytest.mark.parametrize("kind", ["cosine", "linear", "flow"])
@pytest.mark.parametrize("name", SAMPLERS)
def test_stochastic_samples_have_the_data_s_moments(name, kind):
    """With all noise drawn afresh, the covariance converges: at first order, by the solver faster."""
    schedule, steps = schedule_of(kind, 1024), [32, 64, 128, 256]
    moments = [exact_moments(name, schedule, n, 1.0) for n in steps]
    off = np.array([np.abs(covariance - COVARIANCE).max() for _, covariance in moments])
    assert (np.diff(off) < 0).all()
    assert slope(steps, off) > (1.5 if name == "dpm_solver" else 0.8)
    assert off[-1] < (0.003 if name == "dpm_solver" else 0.09)
    assert max(np.abs(mean - MEAN).max() for mean, _ in moments) < 2e-4


def test_ddpm_samples():
    """Mean and covariance within four standard errors of what 200 steps must give, near the data's."""
    schedule, count, rng = schedule_of("cosine"), 20_000, np.random.default_rng(1)
    x = ddpm(best_predictor(schedule), schedule, lambda: rng.standard_normal((count, 2)))
    mean, covariance = exact_moments("ddpm", schedule, 200, 1.0)
    variance = np.diag(COVARIANCE)
    error = np.sqrt(variance / count)
    assert (np.abs(x.mean(0) - mean) < 4 * error).all()
    error = np.sqrt((np.outer(variance, variance) + COVARIANCE**2) / count)
    assert (np.abs(np.cov(x.T) - covariance) < 4 * error).all()
    assert np.abs(covariance - COVARIANCE).max() < 0.035
    assert np.abs(mean - MEAN).max() < 2e-4


@pytest.mark.parametrize("kind", SCHEDULES)
@pytest.mark.parametrize("steps", [1, 7, 50])
def test_ddpm_is_ddim_with_all_noise_afresh(kind, steps):
    schedule = schedule_of(kind)
    draws = [np.random.default_rng(i).standard_normal((3, 2)) for i in range(steps)]
    x = [
        sampler(best_predictor(schedule), schedule, iter(draws).__next__, steps, 1.0)
        for sampler in (ddpm, ddim)
    ]
    np.testing.assert_allclose(x[0], x[1], atol=1e-12)


def test_euler_is_euler_s_method_for_the_velocity():
    schedule, predict = schedule_of("flow"), best_predictor(schedule_of("flow"))
    noise = np.random.default_rng(0).standard_normal((5, 2))
    x, t = noise, 1.0
    for i in range(20):
        velocity = (x - predict(x, 200 - 10 * i)) / t
        x, t = x - velocity / 20, t - 1 / 20
    np.testing.assert_allclose(SAMPLERS.load("euler")(predict, schedule, lambda: noise, 20), x, atol=1e-12)


@pytest.mark.parametrize("name", SAMPLERS)
@pytest.mark.parametrize("kind", SCHEDULES)
@pytest.mark.parametrize("steps", [1, 2, 3, 199, 200])
def test_calls_of_the_predictor(name, kind, steps):
    """One call per step, from the last level downwards; all finite, also where levels are of equal noise, and
    whatever the predictor says; the result is its last word."""
    schedule, rng, levels, said = schedule_of(kind), np.random.default_rng(0), [], []

    def predict(x, level):
        levels.append(level)
        said.append(rng.uniform(-1, 1, x.shape).astype(np.float32))
        return said[-1]

    x = SAMPLERS.load(name)(
        predict, schedule, lambda: rng.standard_normal((2, 3), dtype=np.float32), steps, 0.5
    )
    assert x is said[-1]
    assert x.dtype == np.float32
    assert levels == schedule.sampling_levels(steps)[:-1].tolist()
    assert np.isfinite(x).all()


@pytest.mark.parametrize("name", SAMPLERS)
def test_refused_steps_and_shares(name):
    schedule, predict = schedule_of("cosine"), best_predictor(schedule_of("cosine"))
    for steps in (-1, 0, 201):
        with pytest.raises(InputError, match=f"sampling steps is {steps}; it must be between 1 and 200"):
            SAMPLERS.load(name)(predict, schedule, lambda: np.zeros((1, 2)), steps, 0.0)
    for eta in (-0.1, 1.5, float("nan")):
        with pytest.raises(InputError, match=f"eta is {eta}; it must be between 0 and 1"):
            SAMPLERS.load(name)(predict, schedule, lambda: np.zeros((1, 2)), 5, eta)


def network(x: np.ndarray, level: int) -> np.ndarray:
    """Not linear, and another function at every level, as a network is."""
    return np.tanh(x + np.sin(level)) + 0.1 * x


def draws_for(steps: int) -> list[np.ndarray]:
    """The first noise, and that of every step, as a torch.Generator of seed 1 gives them."""
    generator = torch.Generator().manual_seed(1)
    first = np.random.default_rng(0).standard_normal((4, 3))
    return [
        first,
        *(torch.randn(4, 3, generator=generator, dtype=torch.float64).numpy() for _ in range(steps)),
    ]


def our_steps(name: str, schedule: NoiseSchedule, steps: int, eta: float) -> np.ndarray:
    """x at each level, from the noise to the sample."""
    found, draws = [], iter(draws_for(steps))

    def predict(x, level):
        found.append(x)
        return network(x, level)

    sample = SAMPLERS.load(name)(predict, schedule, draws.__next__, steps, eta)
    return np.array([*found, sample])


def their_steps(levels: list[int], scheduler, outputs, variance_noise: bool, **settings) -> np.ndarray:
    """The same by a scheduler of diffusers. `outputs`: of the network, from x, x_0 and the level."""
    draws = [torch.from_numpy(n) for n in draws_for(len(levels) - 1)]
    x, found = draws[0], [draws[0].numpy()]
    for timestep, level, noise in zip(scheduler.timesteps, levels[:-1], draws[1:], strict=True):
        if variance_noise:
            settings["variance_noise"] = noise
        output = outputs(x.numpy(), network(x.numpy(), level), level)
        x = scheduler.step(torch.from_numpy(output), timestep, x, **settings).prev_sample.double()
        found.append(x.numpy())
    return np.array(found)


def vp_settings(schedule: NoiseSchedule) -> dict:
    alpha_bar = schedule.signal**2
    return {
        "num_train_timesteps": schedule.steps,
        "trained_betas": 1 - alpha_bar[1:] / alpha_bar[:-1],
        "prediction_type": "sample",
    }


@pytest.mark.parametrize("kind", ["cosine", "linear"])
@pytest.mark.parametrize("steps", [200, 20, 7])
def test_ddpm_against_diffusers(kind, steps):
    diffusers = pytest.importorskip("diffusers")
    schedule = schedule_of(kind)
    levels = schedule.sampling_levels(steps).tolist()
    scheduler = diffusers.DDPMScheduler(**vp_settings(schedule), clip_sample=False)
    scheduler.set_timesteps(timesteps=[level - 1 for level in levels[:-1]])
    scheduler.alphas_cumprod = torch.from_numpy(schedule.signal[1:] ** 2)  # theirs is in single precision
    generator = torch.Generator().manual_seed(1)
    theirs = their_steps(levels, scheduler, lambda x, clean, level: clean, False, generator=generator)
    np.testing.assert_allclose(our_steps("ddpm", schedule, steps, 1.0), theirs, atol=1e-5)


@pytest.mark.parametrize(("kind", "steps"), [("linear", 200), ("linear", 8), ("cosine", 20), ("cosine", 8)])
@pytest.mark.parametrize("eta", [0.0, 0.5, 1.0])
def test_ddim_against_diffusers(kind, eta, steps):
    diffusers = pytest.importorskip("diffusers")
    schedule = schedule_of(kind)
    levels = schedule.sampling_levels(steps).tolist()
    scheduler = diffusers.DDIMScheduler(
        **vp_settings(schedule), clip_sample=False, timestep_spacing="trailing", set_alpha_to_one=True
    )
    scheduler.set_timesteps(steps)
    scheduler.alphas_cumprod = torch.from_numpy(schedule.signal[1:] ** 2)  # theirs is in single precision
    theirs = their_steps(levels, scheduler, lambda x, clean, level: clean, True, eta=eta)
    np.testing.assert_allclose(our_steps("ddim", schedule, steps, eta), theirs, atol=1e-5)


@pytest.mark.parametrize(("kind", "steps"), [("linear", 200), ("linear", 20), ("cosine", 20), ("cosine", 7)])
@pytest.mark.parametrize("eta", [0.0, 1.0])
def test_dpm_solver_against_diffusers(kind, steps, eta):
    diffusers = pytest.importorskip("diffusers")
    schedule = schedule_of(kind)
    levels = schedule.sampling_levels(steps).tolist()
    scheduler = diffusers.DPMSolverMultistepScheduler(
        **vp_settings(schedule),
        solver_order=2,
        algorithm_type="sde-dpmsolver++" if eta else "dpmsolver++",
        final_sigmas_type="zero",
    )
    scheduler.set_timesteps(timesteps=[level - 1 for level in levels[:-1]])
    scheduler.sigmas = torch.from_numpy((schedule.noise / schedule.signal)[levels])  # as above
    theirs = their_steps(levels, scheduler, lambda x, clean, level: clean, True)
    np.testing.assert_allclose(our_steps("dpm_solver", schedule, steps, eta), theirs, atol=1e-5)


@pytest.mark.parametrize("name", ["euler", "ddim"])
@pytest.mark.parametrize("steps", [200, 20, 7])
def test_euler_against_diffusers(name, steps):
    diffusers = pytest.importorskip("diffusers")
    schedule = schedule_of("flow")
    levels = schedule.sampling_levels(steps).tolist()
    scheduler = diffusers.FlowMatchEulerDiscreteScheduler(num_train_timesteps=200)
    scheduler.set_timesteps(sigmas=[level / 200 for level in levels[:-1]])
    theirs = their_steps(levels, scheduler, lambda x, clean, level: (x - clean) / (level / 200), False)
    np.testing.assert_allclose(our_steps(name, schedule, steps, 0.0), theirs, atol=1e-5)


@pytest.mark.parametrize("kind", SCHEDULES)
def test_schedules(kind):
    schedule = schedule_of(kind)
    assert (schedule.signal[0], schedule.noise[0]) == (1, 0)
    assert (np.diff(schedule.signal) <= 0).all()
    assert (np.diff(schedule.noise) >= 0).all()
    assert schedule.signal[-1] < 0.011
    assert schedule.noise[-1] > 0.999
    if kind == "flow":
        np.testing.assert_allclose(schedule.signal + schedule.noise, 1)
        np.testing.assert_allclose(schedule.noise, np.arange(201) / 200)
    else:
        np.testing.assert_allclose(schedule.signal**2 + schedule.noise**2, 1)
    snr = (schedule.signal[1:] / schedule.noise[1:]) ** 2
    np.testing.assert_allclose(schedule.weight(np.arange(1, 201), 5.0), np.minimum(1 + snr, 5))
    assert schedule.weight(np.arange(1), 5.0)[0] == 5


def test_linear_schedule_is_ddpm_s():
    np.testing.assert_allclose(
        schedule_of("linear", 1000).signal[1:] ** 2, np.cumprod(1 - np.linspace(1e-4, 0.02, 1000))
    )
    ends = [schedule_of("linear", steps).half_log_snr[-1] for steps in (100, 200, 1000)]
    np.testing.assert_allclose(ends, ends[-1], atol=0.4)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"kind": "sigmoid"}, "unknown schedule.kind 'sigmoid'; known: cosine, flow, linear"),
        ({"steps": 1}, "schedule.steps is 1; it must be between 2 and 100000"),
        ({"steps": 20, "kind": "linear"}, "schedule.steps is 20; the linear schedule needs more than 20"),
        ({"offset": -0.1}, "schedule.offset is -0.1"),
        ({"floor": 0.0}, "schedule.floor is 0.0; it must be above 0 and below 1"),
    ],
)
def test_refused_schedules(settings, message):
    with pytest.raises(InputError, match=message):
        ScheduleSettings(**settings)


@pytest.mark.parametrize("tensors", [False, True])
@pytest.mark.parametrize("kind", SCHEDULES)
@pytest.mark.parametrize("name", OBJECTIVES)
def test_objective_round_trip(name, kind, tensors):
    """x_t and the target give the clean trajectory back, at all levels but where the noise is all of x_t."""
    schedule, objective = schedule_of(kind), OBJECTIVES.make(name)
    last = 199 if (name, kind) == ("noise", "flow") else 200
    clean, noise = np.random.default_rng(0).standard_normal((2, last + 1, 5, 2))
    a, s = (v[: last + 1, None, None] for v in (schedule.signal, schedule.noise))
    if tensors:
        x, n, a, s = (torch.from_numpy(v) for v in (clean, noise, a, s))
        back = objective.clean(a * x + s * n, objective.target(x, n, a, s), a, s).numpy()
    else:
        back = objective.clean(a * clean + s * noise, objective.target(clean, noise, a, s), a, s)
    np.testing.assert_allclose(back, clean, atol=1e-9)


@pytest.mark.parametrize("limit", [5.0, 100.0])
@pytest.mark.parametrize("kind", SCHEDULES)
@pytest.mark.parametrize("name", OBJECTIVES)
def test_objectives_weigh_levels_alike(name, kind, limit):
    """The weighted error of the output is that of the clean trajectory, but where the limit cuts it."""
    schedule, objective = schedule_of(kind), OBJECTIVES.make(name)
    t = np.arange(1, 200)
    a, s = schedule.signal[t], schedule.noise[t]
    weight = objective.weight(schedule, t, limit)
    moved = objective.clean(np.zeros(199), np.ones(199), a, s)  # by an error of 1, as x_t is 0
    wanted = schedule.weight(t, limit)
    free = weight < limit
    assert free.sum() > 50
    np.testing.assert_allclose(weight[free], (wanted * moved**2)[free])
    assert (weight <= limit).all()
    assert (weight > 0).all()
    if name == "clean":
        np.testing.assert_allclose(weight, wanted)
    if name == "velocity" and kind == "flow":
        np.testing.assert_allclose(weight[s**2 * limit > 1], (a**2 + s**2)[s**2 * limit > 1])


def test_objectives_refused():
    with pytest.raises(InputError, match="unknown objective 'v'; known: clean, noise, velocity"):
        objective_for("v", schedule_of("flow"))
    with pytest.raises(InputError, match=r"objective is 'noise' and schedule\.kind is 'flow'"):
        objective_for("noise", schedule_of("flow"))
    assert type(objective_for("noise", schedule_of("linear"))) is OBJECTIVES.load("noise")


def test_bundled_model_samples_as_when_it_was_published():
    """Bit for bit: its description, which names no kind of schedule, and DDIM as written then."""
    about = {"steps": 200, "offset": 0.008, "floor": 0.0001}
    model = load_model("panda")
    assert model.settings.schedule == ScheduleSettings.from_json(about, "schedule")
    t = np.arange(201) / 200
    curve = np.cos((t + 0.008) / 1.008 * np.pi / 2) ** 2
    alpha_bar = np.maximum(curve / curve[0], 1e-4)
    signal, noise = np.sqrt(alpha_bar), np.sqrt(1 - alpha_bar)
    np.testing.assert_array_equal(model.schedule.signal, signal)
    np.testing.assert_array_equal(model.schedule.noise, noise)
    rng = np.random.default_rng(0)
    start, goal = rng.uniform(model.robot.lower, model.robot.upper, (2, model.dof))
    z = model.encode(rng.uniform([0.2, -0.5, 0.1], [0.7, 0.5, 0.8], (100, 3)))

    def clearances(q):
        return np.repeat(0.2 + 0.1 * np.sin(q.sum(-1, keepdims=True)), len(model.robot.links), -1)

    def as_it_was(predict, schedule, draw_noise, steps, eta):
        a, s = signal.tolist(), noise.tolist()
        levels = np.linspace(200, 0, steps + 1).round().astype(np.int64).tolist()
        x = draw_noise()
        for level, lower in pairwise(levels[:-1]):
            clean = predict(x, level)
            seen = (x - a[level] * clean) / s[level]
            step = max(1.0 - (a[level] / a[lower]) ** 2, 0.0) ** 0.5
            fresh = eta * s[lower] / s[level] * step
            x = a[lower] * clean + (s[lower] ** 2 - fresh**2) ** 0.5 * seen
            if fresh > 0:
                x = x + fresh * draw_noise()
        return predict(x, levels[-2])

    def sample(eta):
        return model.sample(z, start, goal, 2, np.random.default_rng(1), clearances, 6, None, eta)

    for eta in (0.0, 0.5):
        now = sample(eta)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("robotdiffuse.learning.samplers.ddim.ddim", as_it_was)
            np.testing.assert_array_equal(sample(eta), now)
