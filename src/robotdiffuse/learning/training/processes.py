"""Where a training runs: its device, its precision, and the processes that share it, by Accelerate.

torchrun starts the processes and says in the environment which each is; without it there is one. All hold the
same weights and draw batches of their own; gradients are averaged in one message a step, losses with them, so
that every process takes the same decisions. The networks are small: to send gradients while others are still
being computed, as PyTorch's DistributedDataParallel does, would gain little.
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
    """The processes of a training, seen from one of them; all call the same methods in the same order."""

    def __init__(self, device: str | None) -> None:
        """`device`: cpu or cuda, for every process one of its own; None: cuda if there is one.

        Matrices are multiplied in bf16 where the device does so fast. Raises InputError if Accelerate is not
        installed, the device is missing, or this process has trained on another.
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
        # Accelerate keeps one state for each interpreter, that of its first use
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
            # else threads of the process group may still run when the interpreter is gone, which aborts it
            atexit.register(_leave_group)

    @property
    def first(self) -> bool:
        """Whether this is the process that validates, logs, prints and writes files."""
        return self.index == 0

    def autocast(self) -> AbstractContextManager[None]:
        """Within, matrices are multiplied in bf16 where the device does so fast."""
        return self._accelerator.autocast()

    def average(self, parameters: Iterable[nn.Parameter], loss: float) -> float:
        """Replace the gradients by their means over the processes; returns the mean of the losses.

        One process leaves them as they are. What is not finite in one process is so in all afterwards.
        """
        if self.count == 1:
            return loss
        # which parameters a loss reaches does not depend on the batch: it is the same in all processes
        gradients = [p.grad for p in parameters if p.grad is not None]
        parts = [g.reshape(-1) for g in gradients]
        mean = self._mean(torch.cat([*parts, torch.tensor([loss], device=self.device)]))
        for gradient, part in zip(gradients, mean[:-1].split([len(p) for p in parts]), strict=True):
            gradient.copy_(part.view_as(gradient))
        return float(mean[-1])

    def mean(self, *values: float | bool) -> tuple[float | bool, ...]:
        """Means over the processes; of one process the values themselves."""
        if self.count == 1:
            return values
        return tuple(self._mean(torch.tensor(values, dtype=torch.float32, device=self.device)).tolist())

    def _mean(self, values: Tensor) -> Tensor:
        # not all of what Accelerate's types allow
        found: Any = self._accelerator.reduce(values, "mean")
        return found

    def gather(self, value: Value) -> list[Value]:
        """Everybody's value, in the order of the processes."""
        if self.count == 1:
            return [value]
        from accelerate.utils import gather_object

        return gather_object([value])

    def share(self, value: Value | None) -> Value:
        """The first process's value; that of the others does not matter."""
        from accelerate.utils import broadcast_object_list

        values: list[Any] = [value]
        return broadcast_object_list(values)[0]

    def first_goes_first(self) -> AbstractContextManager[None]:
        """Within, the first process of each machine comes before the others: they read what it writes."""
        return self._accelerator.local_main_process_first()


def _leave_group() -> None:
    if torch.distributed.is_initialized():
        torch.distributed.destroy_process_group()


def on_cpu(module: Module) -> Module:
    """The module itself if it is on the CPU, else a copy that is."""
    if all(tensor.device.type == "cpu" for tensor in module.state_dict().values()):
        return module
    return copy.deepcopy(module).cpu()
