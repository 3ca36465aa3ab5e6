"""Files of trained networks and of settings: round trips, other robots, damage."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from helpers.box_arm import box_arm
from helpers.example_robots import planar_arm
from helpers.small_model import cloud, save_small_model, small_model
from robotdiffuse.core.errors import InputError
from robotdiffuse.learning.checkpoint import (
    fingerprint,
    load_encoder,
    load_model,
    save_network,
)

pytestmark = pytest.mark.usefixtures("no_export")


def test_checkpoint_round_trip(tmp_path):
    model = small_model()
    model.fit_statistics(np.random.default_rng(0).uniform(-2, 2, (9, 16, 3)).astype(np.float32), True)
    save_network("model", model, tmp_path, {"samples": 3})
    loaded = load_model(tmp_path, box_arm())
    assert loaded.settings == model.settings
    torch.testing.assert_close(loaded.noise_factor, model.noise_factor, atol=0, rtol=0)
    weights = loaded.denoiser.state_dict()
    kept = model.denoiser.state_dict()
    for name, weight in kept.items():
        torch.testing.assert_close(weights[name].float(), weight, atol=1e-3, rtol=1e-2)
    z = [m.encode(cloud(50)[0].numpy()) for m in (model.requires_grad_(False), loaded)]
    np.testing.assert_allclose(z[1], z[0], atol=5e-3)
    assert fingerprint(load_model(tmp_path)) == fingerprint(loaded)
    assert fingerprint(loaded) != fingerprint(small_model(1))
    with pytest.raises(InputError, match=r"no trained model: encoder\.json"):
        load_encoder(tmp_path / "nothing")


def test_wrong_robot_is_refused(tmp_path):
    save_small_model(tmp_path)
    with pytest.raises(InputError, match=r"model\.json was trained for .* other dimensions"):
        load_model(tmp_path, planar_arm(0.5, 0.5, 0.5))
    with pytest.raises(InputError, match=r"model\.json was trained for .* with joints"):
        load_model(tmp_path, planar_arm(0.5, 0.4))


def test_other_links_with_spheres_are_refused(tmp_path):
    """A robot with the same joints and dimensions: its clearances would belong to other links."""
    arm = box_arm()
    save_small_model(tmp_path)
    bare = replace(arm, spheres={link: arm.spheres[link] for link in ("l1", "l2")})
    with pytest.raises(InputError, match="has spheres on the links l1, l2, not l1, l2, l3"):
        load_model(tmp_path, bare)


def damage(folder, case):
    weights = folder / "model.safetensors"
    about = folder / "model.json"
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
    save_small_model(tmp_path)
    damage(tmp_path, case)
    with pytest.raises(InputError, match=file) as caught:
        load_model(tmp_path)
    assert "\n" not in str(caught.value)
