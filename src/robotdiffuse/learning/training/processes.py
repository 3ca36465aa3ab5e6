"""The device, precision and processes of a training, by Accelerate.

torchrun starts the processes and numbers them in their environment; without it there is one. All hold the
same weights and draw their own batches. Gradients and losses are averaged in one message per step, so that
all processes take the same decisions. The networks are small: sending gradients while others are still being
computed, as PyTorch's DistributedDataParallel does, would gain little.
"""

import atexit
import copy
from collections.abc import Iterable
from contextlib import AbstractContextManager
from typing import Any, TypeVar

import torch
from torch import Tensor, nn

from robotdiffuse.core.errors import InputError
from robotdiffuse.learning.training.batches import fast_bf16

Value = TypeVar("Value")
Module = TypeVar("Module", bound=nn.Module)


class Processes:
    """The processes of a training, as seen by one of them. All call the same methods in the same order."""

    def __init__(self, device: str | None) -> None:
        """device: cpu, or cuda with a device for every process; None: cuda if there is one.

        Matrices are multiplied in bf16 on devices that do so fast. Raises InputError if Accelerate is not
        installed, the device is missing, or this process has trained on another device.
        """
        cuda = torch.cuda.is_available()
        if device == "cuda" and not cuda:
            raise InputError("device is cuda, but PyTorch finds no CUDA device here; use cpu")
        try:
            from accelerate import Accelerator, PartialState
        except ImportError:
            raise InputError('training needs accelerate: pip install "robotdiffuse[train]"') from None
        cpu = device == "cpu" or not cuda
        bf16 = fast_bf16() if cpu else torch.cuda.is_bf16_supported(including_emulation=False)
        wanted = "cpu" if cpu else "cuda"
        # Accelerate keeps one state per interpreter, that of its first use
        begun = PartialState().device if PartialState._shared_state else None
        if begun is not None and begun.type != wanted:
            raise InputError(
                f"device is {wanted}, but this process has trained on {begun.type}; start a new process"
            )
        self._accelerator = Accelerator(cpu=cpu, mixed_precision="bf16" if bf16 else "no")
        self.device: torch.device = self._accelerator.device
        self.count: int = self._accelerator.num_processes
        self.index: int = self._accelerator.process_index
        if self.count > 1:
            # otherwise threads of the process group may outlive the interpreter, which then aborts
            atexit.register(_leave_group)

    @property
    def first(self) -> bool:
        """Whether this process is the one that validates, logs, prints and writes files."""
        return self.index == 0

    def autocast(self) -> AbstractContextManager[None]:
        """A context in which matrices are multiplied in bf16, on devices that do so fast."""
        return self._accelerator.autocast()

    def average(self, parameters: Iterable[nn.Parameter], loss: float) -> float:
        """Replace the gradients by their means over the processes; returns the mean of the losses.

        A single process leaves them unchanged. Values that are not finite in one process are so in all
        afterwards.
        """
        if self.count == 1:
            return loss
        # the parameters that have gradients do not depend on the batch: they are the same in all processes
        gradients = [p.grad for p in parameters if p.grad is not None]
        parts = [g.reshape(-1) for g in gradients]
        mean = self._mean(torch.cat([*parts, torch.tensor([loss], device=self.device)]))
        for gradient, part in zip(gradients, mean[:-1].split([len(p) for p in parts]), strict=True):
            gradient.copy_(part.view_as(gradient))
        return float(mean[-1])

    def mean(self, *values: float | bool) -> tuple[float | bool, ...]:
        """Means of the values over the processes; with a single process the values themselves."""
        if self.count == 1:
            return values
        return tuple(self._mean(torch.tensor(values, dtype=torch.float32, device=self.device)).tolist())

    def _mean(self, values: Tensor) -> Tensor:
        # Accelerate's types allow more than tensors
        found: Any = self._accelerator.reduce(values, "mean")
        return found

    def gather(self, value: Value) -> list[Value]:
        """The values of all processes, in their order."""
        if self.count == 1:
            return [value]
        from accelerate.utils import gather_object

        return gather_object([value])

    def share(self, value: Value | None) -> Value:
        """The first process's value; the values of the others are ignored."""
        from accelerate.utils import broadcast_object_list

        values: list[Any] = [value]
        return broadcast_object_list(values)[0]

    def first_goes_first(self) -> AbstractContextManager[None]:
        """A context that the first process of each machine passes before the others, which read what it
        writes."""
        return self._accelerator.local_main_process_first()


def _leave_group() -> None:
    if torch.distributed.is_initialized():
        torch.distributed.destroy_process_group()


def on_cpu(module: Module) -> Module:
    """The module itself if it is on the CPU, else a copy on the CPU."""
    if all(tensor.device.type == "cpu" for tensor in module.state_dict().values()):
        return module
    return copy.deepcopy(module).cpu()
