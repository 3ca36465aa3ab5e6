"""The bundled networks as ONNX Runtime runs them beside PyTorch; the network's turn in calls of the hybrid.

    python benchmarks/networks.py [--only speed,turn] [--problems 42] [--limits 0.1 1]

Prints benchmarks/results/onnx.txt. Speed is CPU time on one thread. The hybrid plans each problem with its
network and without it, in turn; the clock of both is this process's own, for a machine that others use too.
"""

import argparse
import time
from collections.abc import Callable
from functools import partial

import numpy as np
import torch

from common import CONVERGED, TIME_LIMIT, header, parse, parts_of, print_table, progress, use_processor_time
from robotdiffuse.learning.checkpoint import load_completion, load_network
from robotdiffuse.learning.completion import BITS, exported_completion
from robotdiffuse.learning.exported_model import exported_model
from robotdiffuse.perception.voxel_grid import SHAPE
from robotdiffuse.planning.hybrid import RobotDiffuse, RobotDiffuseSettings
from robotdiffuse.problems.families import FAMILIES
from robotdiffuse.problems.held_out import held_out_problem
from robotdiffuse.robots import load_robot

PARTS = ("speed", "turn")
BATCH = 16
SAME = 1e-3
"""Paths whose lengths differ by a smaller share count as equally long."""


def median_time(call: Callable[[], object], calls: int) -> float:
    """CPU time of a call [ms]: the median, after two that do not count."""
    spent = []
    for _ in range(calls + 2):
        began = time.process_time()
        call()
        spent.append(1e3 * (time.process_time() - began))
    return float(np.median(spent[2:]))


def speed(calls: int) -> None:
    """The networks, run both ways."""
    torch.set_num_threads(1)
    panda = load_robot("panda")
    rng = np.random.default_rng(0)
    rows = []
    for name in ("model", "trajectory_prior"):
        exported = exported_model(name, None, panda)
        network = load_network(name, None, panda)
        features = rng.normal(size=(BATCH, exported.waypoints, exported.feature_count)).astype(np.float32)
        condition = rng.normal(size=(BATCH, exported.condition_count)).astype(np.float32)
        given = features, np.ones(BATCH, np.float32), condition
        pair = [partial(model.denoised, *given) for model in (exported, network)]
        rows.append((f"denoiser of {name}, batch of {BATCH}", *pair))
        if exported.settings.encoder is not None:
            cloud = rng.uniform(-0.6, 0.6, (320, 3)).astype(np.float32)
            pair = [partial(model.code_of, cloud) for model in (exported, network)]
            rows.append(("encoder, 320 points", *pair))
    seen = rng.integers(0, sum(BITS) + 1, SHAPE).astype(np.uint8)
    behind = rng.integers(0, 100, SHAPE).astype(np.uint8)
    tensors = torch.from_numpy(seen)[None], torch.from_numpy(behind)[None]
    network = load_completion()
    exported = exported_completion()

    def probabilities() -> np.ndarray:
        with torch.inference_mode():
            return network.probabilities(*tensors)[0].numpy()

    rows.append(("completion network", lambda: exported(seen, behind), probabilities))
    print_table(
        "CPU time on one thread [ms], and the largest difference relative to the largest output",
        ["network", "ONNX Runtime", "PyTorch, fp32", "difference"],
        [
            [
                name,
                f"{median_time(ours, calls):.1f}",
                f"{median_time(theirs, calls):.1f}",
                f"{np.abs(ours() - theirs()).max() / np.abs(theirs()).max():.1e}",
            ]
            for name, ours, theirs in rows
        ],
    )


def turn(problems: int, limits: list[float]) -> None:
    """The hybrid with its network and without."""
    use_processor_time()
    planners = [RobotDiffuse(RobotDiffuseSettings(network_share=share)) for share in (0.0, 0.25)]
    each = -(-problems // len(FAMILIES))
    cases = [(family, i) for family in FAMILIES for i in range(each)][:problems]
    for planner in planners:
        planner.plan(held_out_problem(*cases[0]), time_limit=10.0)
    rows = []
    for limit in limits:
        for until in (CONVERGED, TIME_LIMIT):
            results = []
            for family, i in progress(cases, f"{limit:g} s, {until}"):
                problem = held_out_problem(family, i)
                results.append([planner.plan(problem, limit, seed=i, until=until) for planner in planners])
            solved = [sum(pair[k].solved for pair in results) for k in (0, 1)]
            lengths = np.array(
                [(a.path_length, b.path_length) for a, b in results if a.solved and b.solved], float
            ).reshape(-1, 2)
            ratio = lengths[:, 1] / lengths[:, 0]
            rows.append(
                [
                    f"{limit:g} s, {until}",
                    f"{solved[0]}, {solved[1]}",
                    f"{ratio.mean():.4f}",
                    f"{(ratio < 1 - SAME).sum()}, {(ratio > 1 + SAME).sum()}",
                    str(sum(b.stage in ("network", "refinement") for _, b in results)),
                ]
            )
    print_table(
        f"The hybrid on {len(cases)} problems of {len(FAMILIES)} families, without its network and with",
        ["limit, until", "solved", "length with / without", "shorter, longer", "the network's path"],
        rows,
        ["Lengths are of problems that both solve. Shorter and longer: by more than a thousandth."],
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", default=",".join(PARTS))
    parser.add_argument("--calls", type=int, default=40, help="of each network (40)")
    parser.add_argument("--problems", type=int, default=42)
    parser.add_argument("--limits", nargs="+", type=float, default=[0.1, 1.0], help="[s] (0.1 1)")
    arguments = parse(parser, calls=1, problems=2, limits=[0.05])
    print(header("numpy", "numba", "onnxruntime", "torch"))
    only = parts_of(arguments.only, PARTS)
    if "speed" in only:
        speed(arguments.calls)
    if "turn" in only:
        turn(arguments.problems, arguments.limits)


if __name__ == "__main__":
    main()
