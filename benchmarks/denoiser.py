"""Where the time of a batch goes: encoder, denoiser by operation, clearances, guidance; and what bounds it.

    python benchmarks/denoiser.py [--problems 5] [--repeats 20] [--weights FOLDER]

Prints the report that is kept in benchmarks/results/denoiser.txt. 16 samples in 5 steps, guided, on held-out
ROP problems that the straight line does not solve. Wall time is what a user waits for, but other work on the
machine adds to it, and makes two threads wait for each other; CPU time is of all threads together.
"""

import argparse
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from typing import NamedTuple
from unittest.mock import patch

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from report import header, print_table
from torch import nn
from torch.nn import functional
from torch.profiler import ProfilerActivity, profile
from torch.utils.flop_counter import FlopCounterMode

from problems import PANDA, SEED, draw_cases, goal_of
from robotdiffuse.collision import CollisionChecker
from robotdiffuse.evaluation.methods import NETWORK_ALONE
from robotdiffuse.learning import motion_model
from robotdiffuse.learning.clearance_features import link_clearances
from robotdiffuse.learning.guidance import CollisionGuidance
from robotdiffuse.learning.motion_model import MotionModel
from robotdiffuse.learning.sampling import SamplingSettings
from robotdiffuse.planning.diffusion.diffusion import encode
from robotdiffuse.planning.diffusion.hybrid import RobotDiffuse
from robotdiffuse.problems.problem import Problem

SAMPLES = 16
STEPS = 5
TARGET = 0.06
"""Time of a batch that we want to stay below on two cores [s]."""
BATCHES = (16, 64, 256, 1024)
PATIENCE = 3.0
"""Two threads that wait for each other on a busy machine take a hundred times as long [s]."""


class Times(NamedTuple):
    """Of some calls [s]."""

    wall: Float[ndarray, "n"]
    cpu: Float[ndarray, "n"]

    @property
    def row(self) -> list[str]:
        values = (self.wall.min(), np.median(self.wall), self.cpu.min(), np.median(self.cpu))
        return [f"{1e3 * value:.1f}" for value in values]


def timed(call: Callable[[], object], repeats: int) -> Times:
    """After one call that is not counted; fewer calls where they take longer than PATIENCE."""
    call()
    wall, cpu = [], []
    while len(wall) < repeats and sum(wall) < PATIENCE:
        began = time.perf_counter(), time.process_time()
        call()
        wall.append(time.perf_counter() - began[0])
        cpu.append(time.process_time() - began[1])
    return Times(np.array(wall), np.array(cpu))


@contextmanager
def threads(count: int) -> Iterator[None]:
    """PyTorch on so many threads, inside the model too, which otherwise takes one."""

    @contextmanager
    def several() -> Iterator[None]:
        yield

    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        with patch.object(motion_model, "one_thread", several):
            yield
    finally:
        torch.set_num_threads(before)


class Batch:
    """Sampling for one problem, as RobotDiffuse does it."""

    def __init__(self, planner: RobotDiffuse, problem: Problem) -> None:
        model = planner.model(problem.robot)
        assert model is not None
        self.model: MotionModel = model
        self.problem, self.settings = problem, planner.settings
        self.checker = CollisionChecker(problem.robot, problem.scene)
        self.clearances = link_clearances(self.checker, model.settings)
        self.guidance = CollisionGuidance(self.checker, self.settings.guidance)
        self.code = self.encode()

    def encode(self) -> Float[ndarray, "code"]:
        return encode(self.model, self.checker, self.settings.points, np.random.default_rng(SEED))

    def guide(self, q: ndarray, _level: float) -> ndarray:
        return self.guidance(q, self.settings.guidance_steps)[0]

    def sample(self, guided: bool = True, count: int = SAMPLES, code: ndarray | None = None) -> ndarray:
        return self.model.sample(
            self.problem.start,
            goal_of(self.problem),
            self.code if code is None else code,
            self.clearances,
            np.random.default_rng(SEED),
            SamplingSettings(samples=count, sampling_steps=STEPS),
            self.guide if guided else None,
        )


def waiting(batches: list[Batch], repeats: int) -> None:
    rows, batch_time = [], np.inf
    for count in (1, 2):
        for title, call in (
            ("denoiser and clearances, no guidance", lambda batch: batch.sample(guided=False)),
            ("with guidance", lambda batch: batch.sample()),
            ("with guidance and encoder", lambda batch: batch.sample(code=batch.encode())),
        ):
            with threads(count):
                parts = [timed(lambda batch=batch, call=call: call(batch), repeats) for batch in batches]
            times = Times(*(np.concatenate(values) for values in zip(*parts, strict=True)))
            if count == 1:
                batch_time = float(np.median(times.cpu))  # of the last row, with all that belongs to it
            rows.append([title, f"{count}", *times.row])
    columns = ["", "threads", "wall ms, least", "median", "CPU ms, least", "median"]
    print_table(f"{SAMPLES} samples in {STEPS} steps", columns, rows)
    verdict = "met" if batch_time <= TARGET else "missed"
    print(
        f"target of {1e3 * TARGET:.0f} ms for a batch with guidance and encoder: {verdict} by the median "
        "CPU time of one thread, which is the wall time on a core of its own"
    )


class Meter:
    """CPU time spent in some functions."""

    def __init__(self) -> None:
        self.spent: dict[str, float] = {}

    def of(self, name: str, function: Callable) -> Callable:
        def measured(*args: object) -> object:
            began = time.process_time()
            result = function(*args)
            self.spent[name] = self.spent.get(name, 0.0) + time.process_time() - began
            return result

        return measured


def split(batches: list[Batch], repeats: int) -> None:
    meter = Meter()
    whole = meter.of("all", lambda batch: batch.sample())
    encoding = meter.of("encoder, once a problem", lambda batch: batch.encode())
    for batch in batches:
        with (
            patch.object(batch, "clearances", meter.of("clearances", batch.clearances)),
            patch.object(batch, "guidance", meter.of("guidance", batch.guidance)),
            patch.object(batch.model.denoiser, "forward", meter.of("denoiser", batch.model.denoiser.forward)),
        ):
            for _ in range(repeats):
                whole(batch)
                encoding(batch)
    calls = repeats * len(batches)
    ms = {name: 1e3 * seconds / calls for name, seconds in meter.spent.items()}
    ms["the rest: sampler, features, ends"] = 2 * ms["all"] - sum(ms.values()) + ms["encoder, once a problem"]
    order = ["denoiser", "clearances", "guidance", "the rest: sampler, features, ends"]
    parts = {name: ms.get(name, 0.0) for name in [*order, "all"]}  # weights may see no clearances
    rows = [[name, f"{part:.1f}", f"{part / ms['all']:.0%}"] for name, part in parts.items()]
    rows.append(["encoder, once a problem", f"{ms['encoder, once a problem']:.1f}", ""])
    print_table("CPU time of a guided batch, one thread, mean", ["", "ms", "share"], rows)


Inputs = tuple[torch.Tensor, torch.Tensor, torch.Tensor]


def inputs(model: MotionModel) -> Inputs:
    """Of one pass of the denoiser, by its own shapes."""
    settings, generator = model.settings, torch.Generator().manual_seed(SEED)
    features = model.dof * (2 + settings.clearance_gradients)
    features += settings.clearance_features * len(model.robot.links)
    condition = settings.code + 2 * model.dof
    shapes = ((SAMPLES, model.waypoints, features), (SAMPLES,), (SAMPLES, condition))
    first, level, last = (torch.rand(shape, generator=generator) for shape in shapes)
    return first, level, last


def operations(model: MotionModel, repeats: int) -> None:
    """The profiler's top rows of a pass of the denoiser: the quickest of some, as its clock is the wall's."""
    given, best = inputs(model), None
    with torch.inference_mode(), threads(1):
        model.denoise(*given)
        for _ in range(repeats):
            with profile(activities=[ProfilerActivity.CPU]) as profiler:
                model.denoise(*given)
            events = profiler.key_averages()
            total = sum(event.self_cpu_time_total for event in events)
            if best is None or total < best[0]:
                best = total, sorted(events, key=lambda event: -event.self_cpu_time_total)
    assert best is not None
    total, events = best
    rows = [
        [
            event.key,
            f"{event.count}",
            f"{event.self_cpu_time_total / 1e3:.2f}",
            f"{event.self_cpu_time_total / total:.0%}",
        ]
        for event in events[:8]
    ]
    rows.append(["all, under the profiler", "", f"{total / 1e3:.2f}", ""])
    print_table(f"One pass of the denoiser, batch of {SAMPLES}", ["", "calls", "ms", "share"], rows)


def bound(model: MotionModel, repeats: int) -> None:
    """What the products would take alone, at the rate that this machine reaches at their sizes."""
    given, linear = inputs(model), []

    def seen(module: nn.Module, args: tuple[torch.Tensor, ...], _output: torch.Tensor) -> None:
        linear.append((module, args[0]))

    layers = [module for module in model.denoiser.modules() if isinstance(module, nn.Linear)]
    with torch.inference_mode(), threads(1):
        hooks = [layer.register_forward_hook(seen) for layer in layers]
        with FlopCounterMode(display=False) as counter:
            model.denoise(*given)
        for hook in hooks:
            hook.remove()
        whole = timed(lambda: model.denoise(*given), repeats).cpu.min()
        sizes: dict[tuple[int, int, int], list[tuple[nn.Linear, torch.Tensor]]] = {}
        for module, x in linear:
            rows = x.numel() // module.in_features
            sizes.setdefault((rows, module.in_features, module.out_features), []).append((module, x))
        table, products, flops = [], 0.0, 0
        for (rows, a, b), uses in sizes.items():
            module, x = uses[0]
            product = partial(functional.linear, x.to(module.weight.dtype), module.weight, module.bias)
            flop, each = 2 * rows * a * b, float(timed(product, 5 * repeats).wall.min())
            products += each * len(uses)
            flops += flop * len(uses)
            table.append(
                [f"{rows} x {a} x {b}", f"{len(uses)}", f"{1e3 * each:.3f}", f"{flop / each / 1e9:.0f}"]
            )
        n = 2048
        square = torch.ones((n, n), dtype=model.denoiser.condition[0].weight.dtype) / n  # pyright: ignore
        peak = 2 * n**3 / timed(lambda: square @ square, 3).cpu.min()
    total = counter.get_total_flops()
    print_table(
        "Linear layers by size, one thread", ["tokens x in x out", "uses", "ms each", "GFLOP/s"], table
    )
    kind = str(square.dtype).removeprefix("torch.")
    parameters = sum(parameter.numel() for parameter in model.denoiser.parameters())
    print(
        f"{parameters / 1e6:.2f} million parameters; a pass takes {total / 1e9:.2f} GFLOP, {flops / 1e9:.2f} "
        f"of them in linear layers, the others in attention\n"
        f"a pass: {1e3 * whole:.1f} ms ({total / whole / 1e9:.0f} GFLOP/s); its linear layers alone "
        f"{1e3 * products:.1f} ms ({flops / products / 1e9:.0f} GFLOP/s);\na product of {n} x {n} in {kind} "
        f"reaches {peak / 1e9:.0f} GFLOP/s, at which a pass would take {1e3 * total / peak:.1f} ms"
    )
    share = products / whole
    what = "the linear layers" if share > 0.5 else "what is between the linear layers, see the profile"
    print(f"linear layers, from a warm cache, are {share:.0%} of a pass: it is bound by {what}")


def throughput(batch: Batch) -> None:
    rows = []
    for count in BATCHES:
        repeats = 1 if count > 256 else 3
        for guided in (False, True):
            least = timed(partial(batch.sample, guided, count), repeats).cpu.min()
            rows.append([f"{count}", "yes" if guided else "no", f"{1e3 * least:.0f}", f"{count / least:.0f}"])
    columns = ["batch", "guided", "CPU ms", "motions/s on a core"]
    print_table(f"Large batches for one problem, {STEPS} steps, one thread, least", columns, rows)


def main() -> None:
    parser = argparse.ArgumentParser(description="Where the time of a batch goes.")
    parser.add_argument("--problems", type=int, default=5, help="that times are taken over (5)")
    parser.add_argument("--repeats", type=int, default=20, help="calls for each time (20)")
    parser.add_argument("--weights", help="folder of a trained model; default: the bundled one")
    arguments = parser.parse_args()
    print(header("numpy", "numba", "torch"))
    planner = RobotDiffuse(replace(NETWORK_ALONE, weights=arguments.weights))
    model = planner.model(PANDA)
    assert model is not None
    settings = model.settings
    print(f"weights: {arguments.weights or 'the bundled ones'}")
    print(f"{settings.denoiser}, {settings.denoiser_settings}")
    batches = [Batch(planner, case.problem) for case in draw_cases("rop", arguments.problems).hard]
    waiting(batches, arguments.repeats)
    split(batches, arguments.repeats)
    operations(model, arguments.repeats)
    bound(model, arguments.repeats)
    throughput(batches[0])


if __name__ == "__main__":
    main()
