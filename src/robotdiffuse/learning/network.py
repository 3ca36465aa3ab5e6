"""The base classes of trained networks, which share a checkpoint format, and the export of networks to ONNX,
the format in which planning runs them.
"""

import logging
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from robotdiffuse.learning import need_packages
from robotdiffuse.learning.weight_files import RobotIdentity
from robotdiffuse.robots.kinematic_tree import JointNormalizer

if TYPE_CHECKING:
    from onnx import GraphProto

Scalar = Float[Tensor, ""]
Joints = Float[Tensor, "*batch dof"]
EXPORT_PACKAGES = ("onnx", "onnxscript")
"""Packages that PyTorch's exporter needs."""
LEAST_STORED_IN_HALF = 1024
"""Tensors of weights with at least this many numbers are stored in fp16 if that changes none of them."""


class SavedModule(nn.Module):
    """A network that is saved in files, see `checkpoint`."""

    def exports(self) -> dict[str, bytes]:
        """The contents of the ONNX files that planning runs, with what follows the network's name in the
        file name as keys; empty for a network that planning runs with PyTorch."""
        return {}


class Network(SavedModule):
    """A network for one robot, made from a `RobotIdentity` and settings. `weight_files.NETWORKS` names the
    class of the settings."""

    robot: RobotIdentity
    settings: Any
    normalizer: JointNormalizer

    def to_unit(self, q: Joints) -> Joints:
        """`JointNormalizer.to_unit` of a tensor, differentiable."""
        return (q - q.new_tensor(self.normalizer.middle)) / q.new_tensor(self.normalizer.half_range)

    def from_unit(self, x: Joints) -> Joints:
        """`JointNormalizer.from_unit` of a tensor, differentiable."""
        return x * x.new_tensor(self.normalizer.half_range) + x.new_tensor(self.normalizer.middle)


class _Call(nn.Module):
    """A function of a module, for export."""

    def __init__(self, module: nn.Module, call: Callable[..., Tensor]) -> None:
        super().__init__()
        self.module = module
        self.call = call

    def forward(self, *inputs: Tensor) -> Tensor:
        return self.call(*inputs)


def exported(
    module: nn.Module,
    call: Callable[..., Tensor],
    inputs: Mapping[str, Tensor],
    dynamic: Mapping[str, Mapping[int, str]],
) -> bytes:
    """A function of a module as the contents of an ONNX file. Freezes the module.

    call: the function; it is called with the inputs by position.
    inputs: an example of each input, by the name that the input gets in the file.
    dynamic: names of the axes whose sizes may differ from the examples, by input and axis.

    Raises InputError if the packages for the export are not installed.
    """
    need_packages("saving a network", *EXPORT_PACKAGES)
    import onnx

    dims = {name: torch.export.Dim(name) for axes in dynamic.values() for name in axes.values()}
    shapes = tuple({axis: dims[name] for axis, name in dynamic.get(key, {}).items()} for key in inputs)
    with _quietly(), torch.no_grad():
        program = torch.onnx.export(
            _Call(module, call).requires_grad_(False).eval(),
            tuple(inputs.values()),
            input_names=list(inputs),
            output_names=["output"],
            dynamic_shapes=(shapes,),
            dynamo=True,
            verbose=False,
        )
    assert program is not None
    model = program.model_proto
    _store_in_half(model.graph)
    for node in model.graph.node:
        del node.metadata_props[:]  # stack traces with paths of this machine
        node.doc_string = ""
    del model.metadata_props[:], model.graph.metadata_props[:]
    onnx.checker.check_model(model)
    return model.SerializeToString()


def _store_in_half(graph: "GraphProto") -> None:
    """Store large weights in fp16 if that is exact, as it is for weights from a checkpoint. This halves the
    file.

    ONNX Runtime converts them back when it loads the file, so it computes in fp32.
    """
    from onnx import TensorProto, helper, numpy_helper

    for tensor in graph.initializer:
        values = numpy_helper.to_array(tensor)
        if values.dtype != np.float32 or values.size < LEAST_STORED_IN_HALF:
            continue
        with np.errstate(over="ignore"):
            half = values.astype(np.float16)
        if np.array_equal(half.astype(np.float32), values):
            name = tensor.name
            tensor.CopyFrom(numpy_helper.from_array(half, f"{name}.half"))
            cast = helper.make_node("Cast", [f"{name}.half"], [name], to=TensorProto.FLOAT)
            graph.node.insert(0, cast)


@contextmanager
def _quietly() -> Iterator[None]:
    """A context without the exporter's warnings, about packages that it does not need and about its own
    deprecated functions."""
    logger = logging.getLogger("torch.onnx")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings(action="ignore"):
            yield
    finally:
        logger.setLevel(level)
