"""Files of trained networks and of settings: round trips, other robots, damage, pipes, weights in other files."""

import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from helpers.box_arm import box_arm
from helpers.changes import later
from helpers.example_robots import planar_arm
from helpers.refusals import refuses
from helpers.small_model import cloud, save_small_model, small_model
from robotdiffuse.learning import checkpoint
from robotdiffuse.learning.exported_model import OnnxNetwork
from robotdiffuse.learning.weight_files import checked_bytes, read_description

pytestmark = pytest.mark.usefixtures("no_export")


def test_checkpoint_round_trip(tmp_path):
    model = small_model()
    model.fit_statistics(np.random.default_rng(0).uniform(-2, 2, (9, 16, 3)).astype(np.float32), True)
    checkpoint.save_network("model", model, tmp_path, {"samples": 3})
    loaded = checkpoint.load_network("model", tmp_path, box_arm())
    assert loaded.settings == model.settings
    torch.testing.assert_close(loaded.noise_factor, model.noise_factor, atol=0, rtol=0)
    read = loaded.denoiser.state_dict()
    for name, weight in model.denoiser.state_dict().items():
        torch.testing.assert_close(read[name].float(), weight, atol=1e-3, rtol=1e-2)
    z = [m.encode(cloud(50)[0].numpy()) for m in (model.requires_grad_(False), loaded)]
    np.testing.assert_allclose(z[1], z[0], atol=5e-3)
    assert checkpoint.fingerprint(checkpoint.load_network("model", tmp_path, box_arm())) == checkpoint.fingerprint(loaded)
    assert checkpoint.fingerprint(loaded) != checkpoint.fingerprint(small_model(1))
    refuses(r"no trained model: encoder\.json", checkpoint.load_encoder, tmp_path / "nothing")


def test_wrong_robot_is_refused(tmp_path):
    """Even a robot with equal joints and dimensions is refused: its clearances would belong to other links."""
    save_small_model(tmp_path)
    arm = box_arm()
    bare = replace(arm, spheres={link: arm.spheres[link] for link in ("l1", "l2")})
    for robot, message in (
        (planar_arm(0.5, 0.5, 0.5), r"model\.json was trained for .* other dimensions"),
        (planar_arm(0.5, 0.4), r"model\.json was trained for .* with joints"),
        (bare, "has spheres on the links l1, l2, not l1, l2, l3"),
    ):
        refuses(message, checkpoint.load_network, "model", tmp_path, robot)


@later
def weights(folder, change):
    (folder / "model.safetensors").write_bytes(change((folder / "model.safetensors").read_bytes()))


@later
def described(folder, change):
    values = json.loads((folder / "model.json").read_text())
    change(values)
    (folder / "model.json").write_text(json.dumps(values))


def setting(**values):
    return described(lambda about: about["settings"]["denoiser_settings"].update(values))


@pytest.mark.parametrize(
    ("damage", "file"),
    [
        (setting(hidden=2**63), "model.json"),  # beyond all memory
        (described(lambda about: about["robot"]["lower"].pop()), "robot.lower has 2 entries for 3 joints"),
        (described(lambda about: about["robot"]["frame_offsets"][0][0].pop()), "not 4 x 4"),
        (weights(lambda data: data[:-100]), "model.safetensors"),
        (weights(lambda data: data[:-50] + bytes([data[-50] ^ 1]) + data[-49:]), "model.safetensors"),
        (lambda folder: (folder / "model.safetensors").unlink(), "model.safetensors"),
        (lambda folder: (folder / "model.json").unlink(), "holds no model"),
        (lambda folder: (folder / "model.json").write_text('{"robot": '), "model.json"),
        (described(lambda about: about["settings"].update(wings=2)), "model.json"),
        (setting(width=32), "model.safetensors"),
    ],
)
def test_damaged_weights_give_one_line(tmp_path, damage, file):
    save_small_model(tmp_path)
    damage(tmp_path)
    refuses(file, checkpoint.load_network, "model", tmp_path, box_arm())


def test_a_pipe_a_link_to_a_device_and_a_nested_description_are_not_read(tmp_path: Path) -> None:
    """Reading the pipe would never begin, reading the device would never end."""
    for make in (os.mkfifo, lambda file: file.symlink_to("/dev/zero")):
        for file in (tmp_path / "model.json", tmp_path / "model.onnx"):
            file.unlink(missing_ok=True)
            make(file)
        refuses("it is a device or a pipe", read_description, tmp_path, "model")
        refuses("it is a device or a pipe", checked_bytes, tmp_path / "model.onnx", "", "model.json")
    (tmp_path / "model.json").unlink()
    (tmp_path / "model.json").write_text("[" * 100_000)
    refuses("nested more than 64 levels deep", read_description, tmp_path, "model")


def test_a_network_reads_no_other_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Regression: ONNX Runtime read weights from a file in the current folder."""
    onnx = pytest.importorskip("onnx")
    weights = onnx.numpy_helper.from_array(np.ones(4, np.float32), "w")
    x, y = (onnx.helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, [4]) for name in "xy")
    graph = onnx.helper.make_graph([onnx.helper.make_node("Add", ["x", "w"], ["y"])], "g", [x], [y], [weights])
    model = onnx.helper.make_model(graph, ir_version=10, opset_imports=[onnx.helper.make_opsetid("", 17)])
    ones = np.ones(4, np.float32)
    np.testing.assert_array_equal(OnnxNetwork(model.SerializeToString(), "inside.onnx")(x=ones), 2 * ones)
    onnx.external_data_helper.set_external_data(model.graph.initializer[0], "w.bin")
    model.graph.initializer[0].ClearField("raw_data")
    (tmp_path / "w.bin").write_bytes(ones.tobytes())
    monkeypatch.chdir(tmp_path)
    refuses(r"outside\.onnx keeps weights in another file", OnnxNetwork, model.SerializeToString(), "outside.onnx")


def test_the_default_type_of_pytorch_changes_no_network_that_is_read(tmp_path):
    """Regression: with float64 as the default, the planners mpnet and mpinets raised a RuntimeError."""
    save_small_model(tmp_path)
    before = checkpoint.fingerprint(checkpoint.load_network("model", tmp_path, box_arm()))
    torch.set_default_dtype(torch.float64)
    try:
        os.utime(tmp_path / "model.json", (0, 0))  # else the network that was read before is used again
        loaded = checkpoint.load_network("model", tmp_path, box_arm())
        assert checkpoint.fingerprint(loaded) == before and loaded.encode(cloud(50)[0].numpy()).dtype == np.float32
    finally:
        torch.set_default_dtype(torch.float32)
