"""Weight files that are pipes or links to devices, or that refer to other files."""

import os
from pathlib import Path

import numpy as np
import pytest

from helpers.refusals import refuses
from robotdiffuse.learning.exported_model import OnnxNetwork
from robotdiffuse.learning.weight_files import checked_bytes, read_description


@pytest.mark.parametrize("name", ["pipe", "endless"])
def test_a_pipe_and_a_link_to_a_device_are_not_read(name: str, tmp_path: Path) -> None:
    """Reading the pipe would never begin, reading the device would never end."""
    for file in ("model.json", "model.onnx"):
        if name == "pipe":
            os.mkfifo(tmp_path / file)
        else:
            (tmp_path / file).symlink_to("/dev/zero")
    for read in (lambda: read_description(tmp_path, "model"), lambda: checked_bytes(tmp_path / "model.onnx", "", "model.json")):
        refuses("it is a device or a pipe", read)


def test_a_nested_description_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "model.json").write_text("[" * 100_000)
    refuses("nested more than 64 levels deep", read_description, tmp_path, "model")


def test_a_network_reads_no_other_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Regression: ONNX Runtime read weights from a file in the current folder."""
    onnx = pytest.importorskip("onnx")
    number = onnx.TensorProto.FLOAT
    weights = onnx.numpy_helper.from_array(np.ones(4, np.float32), "w")
    x, y = (onnx.helper.make_tensor_value_info(name, number, [4]) for name in "xy")
    graph = onnx.helper.make_graph([onnx.helper.make_node("Add", ["x", "w"], ["y"])], "g", [x], [y], [weights])
    model = onnx.helper.make_model(graph, ir_version=10, opset_imports=[onnx.helper.make_opsetid("", 17)])
    ones = np.ones(4, np.float32)
    np.testing.assert_array_equal(OnnxNetwork(model.SerializeToString(), "inside.onnx")(x=ones), 2 * ones)
    onnx.external_data_helper.set_external_data(model.graph.initializer[0], "w.bin")
    model.graph.initializer[0].ClearField("raw_data")
    (tmp_path / "w.bin").write_bytes(ones.tobytes())
    monkeypatch.chdir(tmp_path)
    refuses(r"outside\.onnx keeps weights in another file", OnnxNetwork, model.SerializeToString(), "outside.onnx")
