"""Exported networks, run by ONNX Runtime on one thread.

For batches this small a second thread gains little, and where other processes keep the cores busy its waiting
costs more than the network.
"""

import numpy as np
import onnxruntime
from numpy import ndarray

from robotdiffuse.core.errors import InputError

EXTERNAL_DATA = b"\x0a\x08location"
"""How ONNX writes that a tensor is in another file: the key of an entry of `external_data`.
ONNX Runtime would look for the file in the current folder."""


class OnnxNetwork:
    """An exported network with one output."""

    def __init__(self, data: bytes, name: str) -> None:
        """data: of an .onnx file. name: of the file. Raises InputError if ONNX Runtime cannot run it."""
        if EXTERNAL_DATA in data:
            raise InputError(
                f"{name} keeps weights in another file, which is not read; export it in one file"
            )
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.log_severity_level = 3  # errors only
        try:
            self._session = onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])
        except Exception as error:  # ONNX Runtime's own classes of errors have no common base
            reason = " ".join(str(error).split())[:200]
            raise InputError(f"{name} is no network that ONNX Runtime can run: {reason}") from None
        self.inputs = tuple(node.name for node in self._session.get_inputs())
        """Names of the inputs."""

    def __call__(self, **inputs: ndarray) -> ndarray:
        """The output for these inputs."""
        output = self._session.run(None, inputs)[0]
        assert isinstance(output, np.ndarray)
        return output
