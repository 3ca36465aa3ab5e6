"""The loop of all training runs: optimizer, learning rate, checkpoints, log, bad steps, interruption."""

import atexit
import copy
import csv
import io
import json
import math
import shutil
import sys
import time
from abc import ABC, abstractmethod
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple, NoReturn, TypeVar

import numpy as np
import torch
from numpy.random import Generator
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from safetensors import safe_open
from safetensors.torch import save
from torch import Tensor, nn
from torch.nn.utils import clip_grad_norm_, parameters_to_vector, vector_to_parameters
from torch.optim.swa_utils import AveragedModel

from robotdiffuse import __version__
from robotdiffuse.core.errors import InputError, counted, needs, reading
from robotdiffuse.core.files import JsonObject, lock_folder, write_atomically
from robotdiffuse.core.interrupts import STOPS, handled
from robotdiffuse.learning import need_packages
from robotdiffuse.learning.checkpoint import save_network
from robotdiffuse.learning.encoders.networks import Encoder
from robotdiffuse.learning.network import EXPORT_PACKAGES, Scalar
from robotdiffuse.learning.training.batches import TrajectoryData, fast_bf16, load_data
from robotdiffuse.learning.training.config import MotionTraining
from robotdiffuse.robots.robot import Robot

Value = TypeVar("Value")
Module = TypeVar("Module", bound=nn.Module)


class Processes:
    """The processes of a training run. Each process has its own object of this class, and all must call its
    methods in the same order."""

    def __init__(self, device: str | None) -> None:
        """device: cpu or cuda (each process then uses its own GPU); None: cuda if present, otherwise cpu.

        Matrices are multiplied in bf16 on devices that do so fast. Raises InputError if Accelerate is not
        installed, the device is missing, this process has trained on another device, or PyTorch's default
        type of numbers is not float32.
        """
        default = torch.get_default_dtype()
        if default != torch.float32:
            raise InputError(
                f"PyTorch's default dtype is {default}; training needs torch.set_default_dtype(torch.float32)"
            )
        cuda = torch.cuda.is_available()
        if device == "cuda" and not cuda:
            raise InputError("device is cuda, but PyTorch finds no CUDA device here; use cpu")
        with needs("accelerate", "train"):
            from accelerate import Accelerator, PartialState
        cpu = device == "cpu" or not cuda
        bf16 = fast_bf16() if cpu else torch.cuda.is_bf16_supported(including_emulation=False)
        device_type = "cpu" if cpu else "cuda"
        # Accelerate keeps one state per interpreter, from its first use
        begun = PartialState().device if PartialState._shared_state else None
        if begun is not None and begun.type != device_type:
            raise InputError(
                f"device is {device_type}, but this process has trained on {begun.type}; start a new process"
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
        """Whether this process validates, logs, prints and writes files; only the first process does."""
        return self.index == 0

    def autocast(self) -> AbstractContextManager[None]:
        """A context in which matrices are multiplied in bf16, on devices that do so fast."""
        return self._accelerator.autocast()

    def average(self, parameters: Iterable[nn.Parameter], loss: float) -> float:
        """Replace the gradients by their means over the processes; returns the mean of the losses.

        With a single process, nothing changes. A gradient or loss that is not finite in one process makes
        the mean in all processes not finite.
        """
        if self.count == 1:
            return loss
        # the same parameters have gradients in all processes, since this does not depend on the batch
        gradients = [p.grad for p in parameters if p.grad is not None]
        mean = self._mean(
            torch.cat([parameters_to_vector(gradients), torch.tensor([loss], device=self.device)])
        )
        vector_to_parameters(mean[:-1], gradients)
        return float(mean[-1])

    def mean(self, *values: float | bool) -> tuple[float, ...]:
        """Means of the values over the processes."""
        return tuple(self._mean(torch.tensor(values, dtype=torch.float32, device=self.device)).tolist())

    def _mean(self, values: Tensor) -> Any:  # Accelerate's types allow more than tensors
        return self._accelerator.reduce(values, "mean")

    def gather(self, value: object) -> list[Any]:
        """The values of all processes, in their order."""
        from accelerate.utils import gather_object

        return gather_object([value])

    def share(self, value: Value | None) -> Value:
        """The value of the first process, in all processes; their own values are ignored."""
        return self.gather(value)[0]

    def first_goes_first(self) -> AbstractContextManager[None]:
        """A context that the first process of each machine enters and leaves before the others enter it, so
        that they can read what it wrote."""
        return self._accelerator.local_main_process_first()


def _leave_group() -> None:
    if torch.distributed.is_initialized():
        torch.distributed.destroy_process_group()


def on_cpu(module: Module) -> Module:
    """The module itself if it is on the CPU, else a copy on the CPU."""
    if all(tensor.device.type == "cpu" for tensor in module.state_dict().values()):
        return module
    return copy.deepcopy(module).cpu()


FREE_SETTINGS = ("minutes", "samples", "threads", "checkpoint_seconds", "data", "encoder", "device")
"""Settings that may be changed when a run is resumed."""
BAR_WIDTH = 24
"""Width of the progress bar [characters]. Bar and figures then fit into 80 columns; a line that wraps would
be printed again at every update."""
LOG_EVERY = 50
"""Number of steps between two rows of log.csv. Each checkpoint adds a row too."""


class Validation(NamedTuple):
    """Figures of a validation."""

    loss: float
    """Loss on held-out data."""
    success: float | None = None
    """Share of collision-free motions among samples for held-out problems; None: not measured, or there is no
    such problem."""


class TrainingTask(ABC):
    """A network in training: its loss, its validation, and the files that are written at the end."""

    settings: Any
    """Settings, of a subclass of `TrainingSettings`."""
    processes: Processes
    title: str
    """Name of the network, in files, progress and messages."""
    module: nn.Module
    """The network, on the device of the processes."""
    identity: dict[str, str]
    """What must be unchanged when a run is resumed, besides the settings: for example the robot."""

    @abstractmethod
    def loss(self, fraction: float, rng: Generator) -> Scalar:
        """The loss of a random batch; `fraction` of the training is done, 0 to 1."""

    @abstractmethod
    def validate(self, fraction: float) -> Validation:
        """Figures on held-out data; every call uses the same data."""

    def finish(self) -> dict[str, float]:
        """The metrics of the trained network, by name."""
        loss, success = self.validate(1.0)
        return {"validation": loss} | ({} if success is None else {"success": success})

    def about(self) -> JsonObject:
        """Further information on the training for the description of the weights."""
        return {}

    def save(self, folder: Path, training: JsonObject) -> None:
        """Write the weights, in files named by the title, and their description."""
        save_network(self.title, self.module, folder, training)


@dataclass
class Position:
    """Progress of a run."""

    step: int = 0
    samples: int = 0
    seconds: float = 0.0
    skipped: int = 0
    """Number of steps that were skipped because loss or gradient was not finite."""
    bad: int = 0
    """Number of steps that were skipped since the last good step."""


class TrainingRun:
    """Trains a module's parameters; continues an earlier run in the same folder.

    If `samples` sets its length, a resumed run gives the same result as an uninterrupted run: weights, their
    average, moments of the optimizer and the random states come from the checkpoint.

    Several processes, started by torchrun, are one run: each draws its own batches of the size in the
    settings, and all step by their mean gradient. The first process validates, shows progress and writes all
    files; all processes read the folder. They stop and skip steps together.
    """

    def __init__(self, task: TrainingTask, out: str) -> None:
        self.task = task
        self.module = task.module
        self.settings = settings = task.settings
        self.processes = processes = task.processes
        self.out = Path(out)
        # safetensors and TensorBoard could not open files there
        if out.encode("utf-8", "replace").decode() != out:
            raise InputError(f"the name of the folder {out} is not UTF-8; name another folder")
        self.parameters = nn.ParameterList(p for p in task.module.parameters() if p.requires_grad)
        self.average = AveragedModel(self.parameters, avg_fn=self._averaged)
        """The moving average of the parameters."""
        self.optimizer = torch.optim.AdamW(
            self.parameters,
            lr=0.0,
            betas=(0.9, 0.99),
            weight_decay=settings.weight_decay,
            fused=True,
        )
        # the first process draws what a run with a single process draws
        seed = [settings.seed, processes.index] if processes.index else settings.seed
        self.rng = np.random.default_rng(seed)
        self.at = Position()
        self.identity = task.identity | ({} if processes.count == 1 else {"processes": str(processes.count)})
        self.rows = list[dict[str, float | int | str]]()
        self._losses = list[float]()
        self._file = self.out / "training.safetensors"
        if self._file.is_file():
            self._restore()

    @property
    def fraction(self) -> float:
        """Fraction of the run that is done, 0 to 1."""
        if self.settings.samples is not None:
            return min(1.0, self.at.samples / self.settings.samples)
        return min(1.0, self.at.seconds / (60 * (self.settings.minutes or 1.0)))

    def loop(self) -> None:
        """Train to the end. After a signal of STOPS, store a checkpoint and raise KeyboardInterrupt.

        Raises InputError if another run uses the folder, or if the loss diverges.
        """
        threads = torch.get_num_threads()
        torch.set_num_threads(self.settings.threads)
        try:
            lock = lock_folder(self.out) if self.processes.first else nullcontext()
            stopped_by = list[int]()  # only noted, so that the current step is finished first
            stopping = handled(lambda number, _: stopped_by.append(number), *STOPS)
            # Attention has weights below 1e-38, with which processors compute slowly: a step of config
            # `paper` took a third longer. The thread of the steps, and those that it starts, take them for 0.
            steps = ThreadPoolExecutor(1, initializer=torch.set_flush_denormal, initargs=(True,))
            with lock, stopping, steps, _progress(self.processes.first) as progress:
                bar = progress.add_task(self.task.title, total=1.0, rate="", loss="")
                last = saved = time.monotonic()
                stopped = 0.0
                while self.fraction < 1.0 and not stopped:
                    steps.submit(self.step).result()
                    now = time.monotonic()
                    due = now - saved > self.settings.checkpoint_seconds
                    # the mean over the processes is above 0 if any one of them got a signal or is due
                    elapsed, stopped, due = self.processes.mean(now - last, bool(stopped_by), due)
                    self.at.seconds += elapsed
                    rate = self._samples_per_step / max(elapsed, 1e-9)
                    last = now
                    if self.at.step % LOG_EVERY == 0:
                        self._log(None)
                        text = f"{self.rows[-1]['loss']:.4f}"
                        progress.update(bar, completed=self.fraction, rate=f"{rate:,.0f}/s", loss=text)
                    if due:
                        self._checkpoint(progress.console)
                        saved = time.monotonic()
                progress.update(bar, completed=self.fraction)
                self._checkpoint(progress.console)
                if stopped:
                    raise KeyboardInterrupt(*stopped_by[:1])
        finally:
            torch.set_num_threads(threads)

    def step(self) -> None:
        """One step of the optimizer, which is skipped if the loss or the gradient is not finite."""
        self.optimizer.param_groups[0]["lr"] = self.settings.learning_rate * self._lr()
        self.optimizer.zero_grad(set_to_none=True)
        value = self.task.loss(self.fraction, self.rng)
        value.backward()
        mean = self.processes.average(self.parameters, value.item())
        norm = clip_grad_norm_(self.parameters, self.settings.gradient_norm)
        self.at.step += 1
        self.at.samples += self._samples_per_step
        if not (math.isfinite(mean) and math.isfinite(norm.item())):
            self.at.bad += 1
            self.at.skipped += 1
            if self.at.bad == self.settings.bad_steps:
                self.diverged()
            return
        self.at.bad = 0
        self.optimizer.step()
        self._losses.append(mean)
        self.average.update_parameters(self.parameters)

    def diverged(self) -> NoReturn:
        raise InputError(
            f"training in {self.out} diverged: the loss or its gradient is not finite at step "
            f"{self.at.step}; use another folder and a lower learning rate"
        )

    def _averaged(self, average: Tensor, parameter: Tensor, _count: Tensor | int) -> Tensor:
        decay = min(self.settings.average, self.at.step / (self.at.step + 10))
        return average.lerp(parameter, 1 - decay)

    @property
    def _samples_per_step(self) -> int:
        return self.settings.batch * self.processes.count

    def _lr(self) -> float:
        """The learning rate, as a fraction of its peak."""
        warmup = min(1.0, (self.at.step + 1) / max(1, self.settings.warmup_steps))
        share = self.settings.decay_share
        decay = max(0.0, (self.fraction - 1 + share) / share)
        return warmup * 0.5 * (1 + math.cos(math.pi * decay))

    @contextmanager
    def averaged(self) -> Iterator[None]:
        """A context in which the module has the moving average of its weights."""
        now = copy.deepcopy(self.parameters.state_dict())
        self.parameters.load_state_dict(self.average.module.state_dict())
        try:
            yield
        finally:
            self.parameters.load_state_dict(now)

    def _log(self, validation: Validation | None) -> None:
        # the mean since the last row; if every step was skipped, that of the last row
        loss = (
            float(np.mean(self._losses)) if self._losses else self.rows[-1]["loss"] if self.rows else math.nan
        )
        self._losses.clear()
        held_out, success = validation or (None, None)
        row = {
            "step": self.at.step,
            "samples": self.at.samples,
            "minutes": round(self.at.seconds / 60, 3),
            "learning_rate": f"{self.settings.learning_rate * self._lr():.3g}",
            "loss": float(f"{loss:.5g}"),
            "validation": "" if held_out is None else f"{held_out:.5g}",
            "success": "" if success is None else f"{success:.4g}",
            "skipped": self.at.skipped,
        }
        self.rows.append(row)

    def _checkpoint(self, console: Console) -> None:
        validation = None
        if self.processes.first:
            with self.averaged():
                validation = self.task.validate(self.fraction)
        self._log(validation)
        self.save()
        if validation is None:
            return
        self._plot()
        success = validation.success
        free_share = "" if success is None else f"{success:.1%} of samples collision-free, "
        console.print(
            f"{self.task.title}: {self.fraction:.1%}, {counted(self.at.samples, 'sample')} in "
            f"{self.at.seconds / 60:.1f} min, loss {self.rows[-1]['loss']:.4f}, "
            f"validation {validation.loss:.4f}, {free_share}"
            f"{counted(self.at.skipped, 'step')} skipped",
            highlight=False,
            soft_wrap=True,
        )

    def save(self) -> None:
        """Write training.safetensors and log.csv, each atomically.

        All processes wait until the checkpoint is written.
        """
        states = self.processes.gather(self.rng.bit_generator.state)
        if self.processes.first:
            self._write(states)
        self.processes.gather(None)

    def _write(self, random_states: Sequence[Mapping[str, Any]]) -> None:
        notes = {
            "settings": self.settings.to_json(),
            "identity": self.identity,
            "at": asdict(self.at),
            "random": random_states,
            "about": self.task.about(),
            "losses": self._losses,
            "rows": self.rows,
        }
        states = {"module": self.module.state_dict(), "average": self.average.state_dict()}
        states |= self.optimizer.state_dict()["state"]  # the moments, by the index of their parameter
        tensors = {
            f"{part}.{name}": tensor.detach().contiguous()
            for part, state in states.items()
            for name, tensor in state.items()
        }
        content = save(tensors, metadata={"notes": json.dumps(notes)})
        write_atomically(self._file, content, make_folder=True)
        text = io.StringIO()
        writer: csv.DictWriter[str] = csv.DictWriter(text, self.rows[0] if self.rows else ())
        writer.writeheader()
        writer.writerows(self.rows)
        write_atomically(self.out / "log.csv", text.getvalue(), make_folder=True)

    def _plot(self) -> None:
        """Write the log for TensorBoard if that is installed (extra `train`)."""
        try:
            from tensorboard.compat.proto.event_pb2 import Event  # type: ignore[attr-defined]
            from tensorboard.compat.proto.summary_pb2 import Summary  # type: ignore[attr-defined]
            from tensorboard.summary.writer.record_writer import RecordWriter
        except ImportError:
            return
        now = time.time()
        # in memory, since on a full disk a thread of PyTorch's SummaryWriter would print a traceback
        content = io.BytesIO()
        writer = RecordWriter(content)
        writer.write(Event(wall_time=now, file_version="brain.Event:2").SerializeToString())
        for row in self.rows:
            for name in ("learning_rate", "loss", "validation", "success"):
                if row[name] != "":
                    summary = Summary(value=[Summary.Value(tag=name, simple_value=float(row[name]))])
                    event = Event(wall_time=now, step=int(row["samples"]), summary=summary)
                    writer.write(event.SerializeToString())
        folder = self.out / "tensorboard"
        # all rows are written again, so that a resumed run leaves no second curve
        shutil.rmtree(folder, ignore_errors=True)
        # errors in writing the plots, as on a full disk, must not end the run
        with suppress(InputError):
            write_atomically(folder / f"events.out.tfevents.{now:.0f}", content.getvalue(), make_folder=True)

    def _restore(self) -> None:
        states = defaultdict[str, dict[str, Tensor]](dict)
        with reading(self._file):
            with safe_open(self._file, "pt") as stored:
                notes = json.loads(stored.metadata()["notes"])
                for key in stored.keys():  # noqa: SIM118
                    part, _, name = key.partition(".")
                    states[part][name] = stored.get_tensor(key)
            self._check_same(notes["settings"] | notes["identity"])
            data = self.task.about().get("data")
            if self.processes.first and notes.get("about", {"data": data}).get("data") != data:
                print(f"{self._file} was trained on other data; the training goes on", file=sys.stderr)
            self.module.load_state_dict(states.pop("module"))
            self.average.load_state_dict(states.pop("average"))
            moments = {int(index): state for index, state in states.items()}
            self.optimizer.load_state_dict(self.optimizer.state_dict() | {"state": moments})
            self.at = Position(**notes["at"])
            self.rng.bit_generator.state = notes["random"][self.processes.index]
            self._losses = notes["losses"]
            self.rows = notes["rows"]

    def _check_same(self, before: JsonObject) -> None:
        default = {"processes": "1"}
        now = default | json.loads(json.dumps(self.settings.to_json())) | self.identity
        before = default | before
        for name, value in now.items():
            if name not in FREE_SETTINGS and before.get(name) != value:
                raise InputError(
                    f"{self._file} belongs to a run with {name} = {before.get(name)!r}, not {value!r}; "
                    "use another folder, or the same settings"
                )


def _progress(shown: bool) -> Progress:
    columns = (
        TextColumn("{task.description}"), BarColumn(BAR_WIDTH), TextColumn("{task.percentage:.1f} %"),
        TextColumn("{task.fields[rate]}"), TextColumn("loss {task.fields[loss]}"), TimeRemainingColumn(),
    )  # fmt: skip
    return Progress(*columns, console=Console(stderr=True), disable=not shown)


def train(task: TrainingTask, out: str) -> dict[str, float]:
    """Train to the end and write the files into the folder `out`; returns the metrics.

    The same call continues a run that was interrupted. If torchrun started several processes, all of them
    call this function and get the same result, see `TrainingRun`. Raises InputError if a package is missing,
    the folder holds a different run, another run uses it, or the loss diverges; and KeyboardInterrupt,
    after a checkpoint, on Ctrl-C or SIGTERM.
    """
    need_packages("training", *EXPORT_PACKAGES)  # checked now, not after hours of training
    run = TrainingRun(task, out)
    run.loop()
    if not task.processes.first:
        return task.processes.share(None)
    with run.averaged():
        # a run of fewer steps than `bad_steps` does not notice that it diverged
        if not math.isfinite(task.loss(1.0, run.rng).item()):
            run.diverged()
        report = task.finish() | {"samples": float(run.at.samples)}
        minutes = round(run.at.seconds / 60, 2)
        about = {"settings": task.settings.to_json(), **task.about(), "minutes": minutes}
        about |= {name: value for name, value in report.items() if math.isfinite(value)}
        today = f"{datetime.now(UTC):%Y-%m-%d}"
        versions = {"robotdiffuse": __version__, "torch": torch.__version__}
        task.save(Path(out), about | versions | {"made": today})
    return task.processes.share(report)


MAX_VALIDATION_TRAJECTORIES = 2000
"""Largest number of trajectories of the validation split that are used."""
VALIDATION_BATCHES = 8
"""Number of batches in a validation."""


class MotionTask(TrainingTask):
    """The training of a network on planned trajectories."""

    def __init__(
        self, settings: MotionTraining, robot: Robot, encoder: Encoder | None, processes: Processes
    ) -> None:
        """encoder: the frozen encoder that computes the embeddings of the scenes, if there is one.

        Raises InputError if the data do not fit the robot, or there are none for training.
        """
        self.settings = settings
        self.robot = robot
        self.processes = processes
        # the first process caches the embeddings of the scenes for the other processes
        with processes.first_goes_first():
            self.data = load_data(
                settings.data, robot, encoder, settings.waypoints, self._report, settings.turned_copies
            )
        self.train_data, self.validation_data = self.data.split(MAX_VALIDATION_TRAJECTORIES)
        if not len(self.train_data):
            raise InputError(f"data folder {settings.data} holds no trajectory for training")

    def _report(self, text: str) -> None:
        if self.processes.first:
            print(text, file=sys.stderr)

    @abstractmethod
    def loss_of(self, data: TrajectoryData, fraction: float, rng: Generator) -> Scalar:
        """The loss of a random batch of these data."""

    def success(self, rng: Generator) -> float | None:
        """As `Validation.success`."""
        return None

    def loss(self, fraction: float, rng: Generator) -> Scalar:
        return self.loss_of(self.train_data, fraction, rng)

    def validate(self, fraction: float) -> Validation:
        if not len(self.validation_data):
            return Validation(float("nan"))
        rng = np.random.default_rng(7)
        with torch.no_grad():
            losses = [
                self.loss_of(self.validation_data, fraction, rng).item() for _ in range(VALIDATION_BATCHES)
            ]
            return Validation(float(np.mean(losses)), self.success(rng))

    def about(self) -> JsonObject:
        return {"data": self.data.digest, "trajectories": len(self.data)}
