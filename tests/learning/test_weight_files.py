"""Weight files that are pipes or links to devices, or that refer to other files."""

import os
from pathlib import Path

import numpy as np
import pytest

from helpers.refusals import refuses
from robotdiffuse.learning.exported_model import OnnxNetwork
from robotdiffuse.learning.weight_files import checked_bytes, read_description


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
