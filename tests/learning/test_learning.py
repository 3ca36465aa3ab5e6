"""The parts of the learned planner: encoder, noise, sampler, assembled model and its files."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from helpers.box_arm import box_arm
from helpers.example_robots import planar_arm
from helpers.small_model import SMALL_ENCODER, small_model
from robotdiffuse.core.errors import InputError
from robotdiffuse.learning.checkpoint import (
    fingerprint,
    load_encoder,
    load_model,
    save_encoder,
    save_network,
)
from robotdiffuse.learning.diffusion import NoiseSchedule, ScheduleSettings, noise_factor
from robotdiffuse.learning.encoders.point_autoencoder import (
    PointAutoencoder,
    chamfer,
    nearest,
)
from robotdiffuse.learning.motion_model import MotionModelSettings
from robotdiffuse.learning.samplers import SAMPLERS
from robotdiffuse.learning.training.config import EncoderTraining, PlannerTraining
from robotdiffuse.robots.normalizer import JointNormalizer
from robotdiffuse.scenes.surface_points import PANDA_REGION


def cloud(n: int, seed: int = 0) -> torch.Tensor:
    points = np.random.default_rng(seed).uniform([-0.5, -0.5, 0.1], [0.5, 0.5, 0.8], (1, n, 3))
    return torch.from_numpy(points.astype(np.float32))


def test_encoder_leaves_out_points_out_of_the_region():
    encoder = PointAutoencoder(SMALL_ENCODER)
    points = cloud(20)
    out = torch.tensor([[[3.0, 0.0, 0.5], [0.3, 0.0, -0.2]]])
    torch.testing.assert_close(encoder(torch.cat([points, out], 1)), encoder(points))
    torch.testing.assert_close(encoder(out), encoder(torch.zeros(1, 0, 3)))
    assert not torch.allclose(encoder(points), encoder(torch.zeros(1, 0, 3)))
    both = np.concatenate([points.numpy(), out.numpy()], 1)
    np.testing.assert_array_equal(encoder.near(torch.from_numpy(both)).numpy(), PANDA_REGION.holds(both))


def test_encoder_takes_any_number_of_points():
    model = small_model().for_inference()
    for n in (0, 1, 5000):
        z = model.encode(cloud(n)[0].numpy().astype(np.float64))
        assert z.shape == (8,)
        assert np.isfinite(z).all()


def test_standardized_codes():
    encoder = PointAutoencoder(SMALL_ENCODER)
    clouds = torch.cat([cloud(30, seed) for seed in range(40)])
    with torch.no_grad():
        encoder.standardize(encoder.encode(clouds))
        z = encoder(clouds)
    torch.testing.assert_close(z.mean(0), torch.zeros(8), atol=1e-3, rtol=0)
    torch.testing.assert_close(z.std(0), torch.ones(8), atol=1e-3, rtol=0)


def test_nearest_and_chamfer_against_all_pairs():
    a, b = cloud(7, 1), cloud(11, 2)
    allowed = torch.arange(11)[None] < 9
    distance = (a[0, :, None] - b[0, None]).norm(dim=-1)
    forth, back = nearest(a, b, allowed)
    assert torch.equal(forth[0], distance[:, :9].argmin(1))
    assert torch.equal(back[0, :9], distance[:, :9].argmin(0))
    rms = [distance[:, :9].min(i).values.square().mean().sqrt() for i in (0, 1)]
    torch.testing.assert_close(chamfer(a, b, allowed), sum(rms), atol=1e-4, rtol=1e-4)


def test_normalizer():
    normalizer = JointNormalizer(np.array([-1.0, 0.0]), np.array([3.0, 0.5]))
    q = np.array([[-1.0, 0.0], [3.0, 0.5], [1.0, 0.25]])
    np.testing.assert_allclose(normalizer.to_unit(q), [[-1, -1], [1, 1], [0, 0]], atol=1e-7)
    np.testing.assert_allclose(normalizer.from_unit(normalizer.to_unit(q)), q, atol=1e-7)
    with pytest.raises(InputError, match="joint 1"):
        JointNormalizer(np.array([0.0, 1.0]), np.array([1.0, 1.0]))


def test_schedule():
    schedule = NoiseSchedule(ScheduleSettings())
    np.testing.assert_allclose(schedule.signal**2 + schedule.noise**2, 1.0)
    assert (np.diff(schedule.signal) <= 0).all()
    assert schedule.noise[0] == 0
    assert schedule.signal[-1] ** 2 <= 1.1e-4
    weight = schedule.weight(np.arange(201), 5.0)
    assert weight.max() == 5.0
    assert weight.min() >= 1.0
    with pytest.raises(InputError, match="sampling steps"):
        schedule.sampling_levels(0)


@pytest.mark.parametrize("smooth", [False, True])
def test_noise_is_zero_at_the_ends_and_has_the_data_s_covariance(smooth):
    s = np.linspace(0, np.pi, 16)[:, None]
    residuals = np.random.default_rng(0).standard_normal((500, 1, 2)) * np.sin(s)
    factor = noise_factor(residuals, smooth)
    covariance = factor @ factor.T
    assert not covariance[[0, -1]].any()
    assert np.trace(covariance) / 14 == pytest.approx(1.0, abs=1e-3)
    shape = (np.sin(s) @ np.sin(s).T)[1:-1, 1:-1]
    wanted = shape / (np.trace(shape) / 14) if smooth else np.eye(14)
    np.testing.assert_allclose(covariance[1:-1, 1:-1], wanted, atol=2e-3)


@pytest.mark.parametrize("name", SAMPLERS)
@pytest.mark.parametrize("eta", [0.0, 1.0])
def test_sampler_recovers_a_gaussian(name, eta):
    """For Gaussian data the best denoiser has a closed form; samples have their mean and deviation."""
    mean, std, n = 0.7, 0.3, 40_000
    schedule = NoiseSchedule(ScheduleSettings())
    rng = np.random.default_rng(1)

    def predict(x, level):
        a, s = schedule.signal[level], schedule.noise[level]
        return mean + a * std**2 / (a**2 * std**2 + s**2) * (x - a * mean)

    def deviations(steps):
        x = SAMPLERS.load(name)(predict, schedule, lambda: rng.standard_normal(n), steps, eta)
        return abs(x.mean() - mean), abs(x.std() - std)

    few, many = deviations(10), deviations(200)
    # the standard error is 0.0015 of the mean; of many steps, the discretisation leaves less than 0.005
    assert max(few[0], many[0]) < 0.008
    assert many[1] < 0.01
    assert many[1] < few[1]


@pytest.mark.parametrize("guided", [False, True])
def test_samples_hold_start_and_goal(guided):
    model = small_model().for_inference()
    model.residual_scale.fill_(0.3)
    start, goal = np.array([-1.0, 0.5, 2.0]), np.array([1.5, -0.5, 0.1])
    levels = []

    def guide(q, level):
        levels.append(level)
        return q + 0.1

    def sample(seed):
        return model.sample(
            np.zeros(8, np.float32),
            start,
            goal,
            count=5,
            rng=np.random.default_rng(seed),
            clearances=lambda q: np.full((*q.shape[:2], 3), 0.2, np.float32),
            steps=6,
            guide=guide if guided else None,
            eta=0.5,
        )

    q = sample(0)
    assert q.shape == (5, 16, 3)
    assert (q[:, 0] == start).all()
    assert (q[:, -1] == goal).all()
    assert (q >= box_arm().lower).all()
    assert (q <= box_arm().upper).all()
    assert np.abs(q[0] - q[1]).max() > 1e-3
    assert len(levels) == (3 if guided else 0)
    assert sorted(levels, reverse=True) == levels
    np.testing.assert_array_equal(sample(0), q)


def test_denoiser_sees_the_clearances():
    model = small_model()
    between = model.between(np.zeros((2, 3)), np.ones((2, 3)))
    x = np.zeros((2, 16, 3), np.float32)
    features = model.features(x, between, lambda q: np.stack([q[..., 0] * 0 + d for d in (-5, 0.15, 9)], -1))
    assert features.shape == (2, 16, 9)
    np.testing.assert_allclose(features[0, 0, 6:], [-1, 0, 1], atol=1e-6)


def test_residual_and_joints_are_inverse():
    model = small_model()
    q = np.random.default_rng(0).uniform(-2, 2, (4, 16, 3)).astype(np.float32)
    model.fit_statistics(q, smooth_noise=True)
    between = model.between(q[:, 0], q[:, -1])
    rows = model.to_rows(q, between)
    np.testing.assert_allclose(model.joints(rows, between), q, atol=1e-5)
    assert np.sqrt((rows[:, 1:-1] ** 2).mean((0, 1))) == pytest.approx([1, 1, 1], abs=1e-4)


def test_checkpoint_round_trip(tmp_path):
    model = small_model()
    model.fit_statistics(np.random.default_rng(0).uniform(-2, 2, (9, 16, 3)).astype(np.float32), True)
    save_network("model", model, tmp_path, {"samples": 3})
    loaded = load_model(tmp_path, box_arm())
    assert loaded.settings == model.settings
    torch.testing.assert_close(loaded.noise_factor, model.noise_factor, atol=0, rtol=0)
    weights, kept = loaded.denoiser.state_dict(), model.denoiser.state_dict()
    for name, weight in kept.items():
        torch.testing.assert_close(weights[name].float(), weight, atol=1e-3, rtol=1e-2)
    z = [m.encode(cloud(50)[0].numpy()) for m in (model.requires_grad_(False), loaded)]
    np.testing.assert_allclose(z[1], z[0], atol=5e-3)
    assert fingerprint(load_model(tmp_path)) == fingerprint(loaded)
    assert fingerprint(loaded) != fingerprint(small_model(1))


def test_wrong_robot_is_refused(tmp_path):
    save_network("model", small_model(), tmp_path, {})
    with pytest.raises(InputError, match=r"model\.json was trained for .* other dimensions"):
        load_model(tmp_path, planar_arm(0.5, 0.5, 0.5))
    with pytest.raises(InputError, match=r"model\.json was trained for .* with joints"):
        load_model(tmp_path, planar_arm(0.5, 0.4))


def test_other_links_with_spheres_are_refused(tmp_path):
    """Of the same joints and measures; the model was once asked about clearances that mean other links."""
    arm = box_arm()
    save_network("model", small_model(), tmp_path, {})
    bare = replace(arm, spheres={link: arm.spheres[link] for link in ("l1", "l2")})
    with pytest.raises(InputError, match="has spheres on the links l1, l2, not l1, l2, l3"):
        load_model(tmp_path, bare)


def test_files_of_format_1_are_read(tmp_path):
    model = small_model()
    save_network("model", model, tmp_path, {})
    file = tmp_path / "model.json"
    about = json.loads(file.read_text())
    robot = about.pop("robot")
    about["model"] = about.pop("settings") | robot | {"robot": robot.pop("source")}
    del about["network"], about["model"]["source"]
    file.write_text(json.dumps(about | {"format": 1}))
    loaded = load_model(tmp_path, box_arm())
    assert loaded.settings == model.settings and loaded.robot == model.robot


def damage(folder, case):
    weights, about = folder / "model.safetensors", folder / "model.json"
    if case == "truncated":
        weights.write_bytes(weights.read_bytes()[:-100])
    elif case == "bit":
        data = bytearray(weights.read_bytes())
        data[-50] ^= 1
        weights.write_bytes(data)
    elif case == "no weights":
        weights.unlink()
    elif case == "no description":
        about.unlink()
    elif case == "broken description":
        about.write_text(about.read_text()[:-30])
    elif case == "unknown setting":
        values = json.loads(about.read_text())
        values["settings"]["wings"] = 2
        about.write_text(json.dumps(values))
    elif case == "other size":
        values = json.loads(about.read_text())
        values["settings"]["denoiser_settings"]["width"] = 32
        about.write_text(json.dumps(values))
    elif case == "beyond all memory":
        values = json.loads(about.read_text())
        values["settings"]["denoiser_settings"]["hidden"] = 2**63
        about.write_text(json.dumps(values))
    elif case in ("joint too few", "ragged frames"):
        values = json.loads(about.read_text())
        rows = values["robot"]["lower" if case == "joint too few" else "frame_offsets"]
        (rows if case == "joint too few" else rows[0][0]).pop()
        about.write_text(json.dumps(values))


@pytest.mark.parametrize(
    ("case", "file"),
    [
        ("beyond all memory", "model.json"),
        ("joint too few", "robot.lower has 2 entries for 3 joints"),
        ("ragged frames", "not 4 x 4"),
        ("truncated", "model.safetensors"),
        ("bit", "model.safetensors"),
        ("no weights", "model.safetensors"),
        ("no description", "model.json"),
        ("broken description", "model.json"),
        ("unknown setting", "model.json"),
        ("other size", "model.safetensors"),
    ],
)
def test_damaged_weights_give_one_line(tmp_path, case, file):
    save_network("model", small_model(), tmp_path, {})
    damage(tmp_path, case)
    with pytest.raises(InputError, match=file) as caught:
        load_model(tmp_path)
    assert "\n" not in str(caught.value)


def test_numbers_of_waypoints_are_bounded():
    """Matrices of 10**25 rows were asked for; found by fuzzing."""
    for field in ("waypoints", "rows"):
        with pytest.raises(InputError, match=rf"{field} is 1000+; it must be between . and 4096"):
            MotionModelSettings.from_json({field: 10**25}, "model")
    with pytest.raises(InputError, match=r"waypoints is 1000+; it must be between 3 and 4096"):
        PlannerTraining.from_json({"data": "d", "encoder": "e", "waypoints": 10**25}, "training")


def test_encoder_files(tmp_path):
    encoder = PointAutoencoder(SMALL_ENCODER)
    save_encoder(encoder, tmp_path, {})
    loaded = load_encoder(tmp_path)
    torch.testing.assert_close(loaded(cloud(9)), encoder(cloud(9)), atol=5e-3, rtol=0)
    with pytest.raises(InputError, match=r"no trained model: encoder\.json"):
        load_encoder(tmp_path / "nothing")


def test_settings_as_json():
    settings = EncoderTraining(seed=3, encoder=SMALL_ENCODER)
    text = json.dumps(settings.to_json())
    assert EncoderTraining.from_json(json.loads(text), "x") == settings
    for bad, message in [
        ({"seeed": 1}, "x.seeed"),
        ({"seed": 1.5}, "x.seed"),
        ({"encoder": {"code": "a"}}, "code"),
    ]:
        with pytest.raises(InputError, match=message):
            EncoderTraining.from_json(bad, "x")
