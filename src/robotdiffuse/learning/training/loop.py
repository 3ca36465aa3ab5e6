"""The loop of all training runs: optimiser, learning rate, checkpoints, log, bad steps, interruption."""

import csv
import io
import json
import math
import shutil
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import asdict, dataclass
from pathlib import Path as FilePath
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from torch import Tensor, nn

from robotdiffuse.core.errors import InputError
from robotdiffuse.core.output_files import lock_folder, write_atomically
from robotdiffuse.learning.checkpoint import read_tensors, write_tensors
from robotdiffuse.learning.training.config import TrainingSettings
from robotdiffuse.learning.training.processes import Processes

FREE_SETTINGS = ("minutes", "samples", "threads", "checkpoint_seconds", "data", "encoder", "device")
"""Settings that may differ between the parts of one run."""
BAR_WIDTH = 24
"""Of the progress bar [characters]: with its figures it fits into 80; a line that wraps is printed again."""
LOG_EVERY = 50
"""Steps per row of log.csv."""
LOG_COLUMNS = ("step", "samples", "minutes", "learning_rate", "loss", "validation", "success", "skipped")
MAX_ROLLBACKS = 5
"""After so many returns to a checkpoint a run has diverged."""


class Validation(NamedTuple):
    """Figures of a validation."""

    loss: float
    """On held-out data."""
    success: float | None = None
    """Share of held-out problems that the network solves by itself; None: not measured."""


LossFn = Callable[[np.random.Generator], Float[Tensor, ""]]
"""Draws a batch and returns its loss."""


@dataclass
class Position:
    """Progress of a run."""

    step: int = 0
    samples: int = 0
    seconds: float = 0.0
    skipped: int = 0
    rollbacks: int = 0


class TrainingRun:
    """Trains a module's parameters; continues an earlier run in the same folder.

    A resumed run gives the same result as an uninterrupted one: weights, their average, moments of the
    optimiser and the random states come from the checkpoint.

    Several processes, started by torchrun, are one run: each draws its own batches of the settings' size, and
    all step by their mean gradient. The first one validates, shows progress and writes all files; the others
    read the folder too. They stop, skip and roll back together.
    """

    def __init__(
        self,
        module: nn.Module,
        out: str,
        settings: TrainingSettings,
        identity: dict[str, str],
        processes: Processes,
    ) -> None:
        """module: on the device of `processes`. identity: what must be the same when the run is resumed
        besides the settings, for example the robot.
        """
        self.module, self.settings, self.out, self.processes = module, settings, FilePath(out), processes
        self.parameters: dict[str, nn.Parameter] = {
            n: p for n, p in module.named_parameters() if p.requires_grad
        }
        self.average = {name: p.detach().clone() for name, p in self.parameters.items()}
        self.optimizer = torch.optim.AdamW(
            self.parameters.values(),
            lr=0.0,
            betas=(0.9, 0.99),
            weight_decay=settings.weight_decay,
            fused=True,
        )
        # the first process draws what a run with a single process draws
        seed = [settings.seed, processes.index] if processes.index else settings.seed
        self.rng = np.random.default_rng(seed)
        self.at = Position()
        self.identity = identity | ({} if processes.count == 1 else {"processes": str(processes.count)})
        self.rows: list[dict[str, float | int | str]] = []
        self._losses: list[float] = []
        self._bad = 0
        self._file = self.out / "training.safetensors"
        self.resumed = self._file.is_file()
        if self.resumed:
            self._restore(check=True)

    @property
    def fraction(self) -> float:
        """Fraction of the run that is done, 0 to 1."""
        if self.settings.samples is not None:
            return min(1.0, self.at.samples / self.settings.samples)
        return min(1.0, self.at.seconds / (60 * (self.settings.minutes or 1.0)))

    def loop(
        self,
        loss: Callable[[np.random.Generator], Float[Tensor, ""]],
        validate: Callable[[], Validation],
        title: str,
    ) -> None:
        """Train to the end. Ctrl-C stores a checkpoint first, then raises KeyboardInterrupt.

        Raises InputError if another training uses the folder, or if the loss diverges.
        """
        threads = torch.get_num_threads()
        torch.set_num_threads(self.settings.threads)
        try:
            with self._alone(), _stop_requested() as stop, _progress(self.processes.first) as progress:
                task = progress.add_task(title, total=1.0, rate="", loss="")
                last = saved = time.monotonic()
                stopped: float | bool = False
                while self.fraction < 1.0 and not stopped:
                    self.step(loss)
                    now = time.monotonic()
                    due = now - saved > self.settings.checkpoint_seconds
                    elapsed, stopped, due = self.processes.mean(now - last, stop.is_set(), due)
                    self.at.seconds += elapsed
                    rate, last = self._samples_per_step / max(elapsed, 1e-9), now
                    if self.at.step % LOG_EVERY == 0:
                        self._log(self.settings.learning_rate * self._lr(), None)
                        text = f"{self.rows[-1]['loss']:.4f}" if self.rows else ""
                        progress.update(task, completed=self.fraction, rate=f"{rate:,.0f}/s", loss=text)
                    if due:
                        self._checkpoint(validate, progress.console, title)
                        saved = time.monotonic()
                progress.update(task, completed=self.fraction)
                self._checkpoint(validate, progress.console, title)
                if stopped:
                    raise KeyboardInterrupt
        finally:
            torch.set_num_threads(threads)

    def _alone(self) -> AbstractContextManager[None]:
        return lock_folder(self.out) if self.processes.first else nullcontext()

    def step(self, loss: LossFn) -> None:
        """One step of the optimiser, which is skipped if the loss or the gradient is not finite."""
        self.optimizer.param_groups[0]["lr"] = self.settings.learning_rate * self._lr()
        self.optimizer.zero_grad(set_to_none=True)
        value = loss(self.rng)
        value.backward()
        mean = self.processes.average(self.parameters.values(), value.item())
        norm = nn.utils.clip_grad_norm_(self.parameters.values(), self.settings.gradient_norm)
        self.at.step += 1
        self.at.samples += self._samples_per_step
        if not (math.isfinite(mean) and math.isfinite(norm.item())):
            self._skip()
            return
        self._bad = 0
        self.optimizer.step()
        self._losses.append(mean)
        with torch.no_grad():
            decay = min(self.settings.average, self.at.step / (self.at.step + 10))
            for name, p in self.parameters.items():
                self.average[name].lerp_(p, 1 - decay)

    @property
    def _samples_per_step(self) -> int:
        return self.settings.batch * self.processes.count

    def _lr(self) -> float:
        warmup = min(1.0, (self.at.step + 1) / max(1, self.settings.warmup_steps))
        share = self.settings.decay_share
        decay = max(0.0, (self.fraction - 1 + share) / share)
        return warmup * 0.5 * (1 + math.cos(math.pi * decay))

    def _skip(self) -> None:
        self._bad += 1
        self.at.skipped += 1
        if self._bad < self.settings.bad_steps:
            return
        at = self.at
        if at.rollbacks >= MAX_ROLLBACKS or not self._file.is_file():
            raise InputError(f"training in {self.out} diverged: the loss is not finite at step {at.step}")
        random_state = self.rng.bit_generator.state  # kept, so that other batches follow this time
        self._restore(check=False)
        self.rng.bit_generator.state = random_state
        self.at.skipped, self.at.rollbacks, self.at.seconds = at.skipped, at.rollbacks + 1, at.seconds
        self._bad = 0

    @contextmanager
    def averaged(self) -> Iterator[None]:
        """A context in which the module has the moving average of its weights."""
        kept = {name: p.detach().clone() for name, p in self.parameters.items()}
        with torch.no_grad():
            for name, p in self.parameters.items():
                p.copy_(self.average[name])
        try:
            yield
        finally:
            with torch.no_grad():
                for name, p in self.parameters.items():
                    p.copy_(kept[name])

    def _log(self, rate: float, validation: Validation | None) -> None:
        loss = (
            float(np.mean(self._losses)) if self._losses else self.rows[-1]["loss"] if self.rows else math.nan
        )
        self._losses.clear()
        held_out, success = validation or (None, None)
        row = (
            self.at.step,
            self.at.samples,
            round(self.at.seconds / 60, 3),
            f"{rate:.3g}",
            float(f"{loss:.5g}"),
            "" if held_out is None else f"{held_out:.5g}",
            "" if success is None else f"{success:.4g}",
            self.at.skipped,
        )
        self.rows.append(dict(zip(LOG_COLUMNS, row, strict=True)))

    def _checkpoint(self, validate: Callable[[], Validation], console: Console, title: str) -> None:
        validation = None
        if self.processes.first:
            with self.averaged():
                validation = validate()
        self._log(self.settings.learning_rate * self._lr(), validation)
        self.save()
        if validation is None:
            return
        self._plot()
        success = validation.success
        planned = "" if success is None or math.isnan(success) else f"{success:.1%} of samples free, "
        console.print(
            f"{title}: {self.fraction:.1%}, {self.at.samples:,} samples in {self.at.seconds / 60:.1f} min, "
            f"loss {self.rows[-1]['loss']:.4f}, validation {validation.loss:.4f}, {planned}"
            f"{self.at.skipped} steps skipped",
            highlight=False,
            soft_wrap=True,
        )

    def save(self) -> None:
        """Write training.safetensors and log.csv, each whole or not at all.

        All processes return only after the checkpoint is written.
        """
        states = self.processes.gather(self.rng.bit_generator.state)
        if self.processes.first:
            self._write(states)
        self.processes.gather(None)

    def _write(self, random_states: Sequence[Mapping[str, Any]]) -> None:
        moments = self.optimizer.state
        tensors: dict[str, Tensor] = {f"module.{name}": t for name, t in self.module.state_dict().items()}
        tensors |= {f"average.{name}": t for name, t in self.average.items()}
        for name, p in self.parameters.items():
            for key, value in moments.get(p, {}).items():
                tensors[f"optimizer.{key}.{name}"] = value
        notes = {
            "settings": self.settings.to_json(),
            "identity": self.identity,
            "at": asdict(self.at),
            "random": random_states[0],
            "random_elsewhere": random_states[1:],
            "losses": self._losses,
            "rows": self.rows,
        }
        write_tensors(self._file, tensors, notes)
        text = io.StringIO()
        writer: csv.DictWriter[str] = csv.DictWriter(text, LOG_COLUMNS)
        writer.writeheader()
        writer.writerows(self.rows)
        write_atomically(self.out / "log.csv", text.getvalue(), make_folder=True)

    def _plot(self) -> None:
        """Write the log for TensorBoard if that is installed (extra `train`)."""
        try:
            from torch.utils.tensorboard import SummaryWriter
        except ImportError:
            return
        folder = self.out / "tensorboard"
        shutil.rmtree(
            folder, ignore_errors=True
        )  # written anew, so that a resumed run leaves no second curve
        with SummaryWriter(str(folder)) as writer:
            for row in self.rows:
                for name in ("learning_rate", "loss", "validation", "success"):
                    if row.get(name, "") != "":
                        writer.add_scalar(name, float(row[name]), int(row["samples"]))

    def _restore(self, check: bool) -> None:
        tensors, notes = read_tensors(self._file)
        try:
            if check:
                self._check_same(notes)
            state = {k.removeprefix("module."): t for k, t in tensors.items() if k.startswith("module.")}
            self.module.load_state_dict(state)
            device = self.processes.device
            self.average = {name: tensors[f"average.{name}"].to(device) for name in self.parameters}
            self.optimizer.state.clear()
            for name, p in self.parameters.items():
                found = {
                    key: tensors[f"optimizer.{key}.{name}"].to(device)
                    for key in ("step", "exp_avg", "exp_avg_sq")
                    if f"optimizer.{key}.{name}" in tensors
                }
                if found:
                    self.optimizer.state[p] = found
            self.at = Position(**notes["at"])
            states = [notes["random"], *notes.get("random_elsewhere", [])]
            self.rng.bit_generator.state = states[self.processes.index]
            self._losses, self.rows = list(notes["losses"]), list(notes["rows"])
        except (KeyError, TypeError, RuntimeError) as error:
            raise InputError(
                f"{self._file} is no checkpoint of this run: {' '.join(str(error).split())[:200]}"
            ) from None

    def _check_same(self, notes: dict) -> None:
        now, before = json.loads(json.dumps(self.settings.to_json())), notes["settings"]
        alone = {"processes": "1"}
        now, before = now | alone | self.identity, before | alone | notes["identity"]
        for name, value in now.items():
            if name not in FREE_SETTINGS and before.get(name) != value:
                raise InputError(
                    f"{self.out} holds a run with {name} = {before.get(name)!r}, now it is {value!r}; "
                    "use another folder, or the same settings"
                )


@contextmanager
def _stop_requested() -> Iterator[threading.Event]:
    """An event that SIGINT and SIGTERM set, so that the current step is finished first."""
    stop = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return
    before = {s: signal.signal(s, lambda *_: stop.set()) for s in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield stop
    finally:
        for s, handler in before.items():
            signal.signal(s, handler)


@contextmanager
def _progress(shown: bool) -> Iterator[Progress]:
    columns = (
        TextColumn("{task.description}"), BarColumn(BAR_WIDTH), TextColumn("{task.percentage:.1f} %"),
        TextColumn("{task.fields[rate]}"), TextColumn("loss {task.fields[loss]}"), TimeRemainingColumn(),
    )  # fmt: skip
    console = Console(stderr=True)
    with Progress(*columns, console=console, disable=not shown) as progress:
        yield progress
