"""The bundled networks run by ONNX Runtime, compared with PyTorch.

    python benchmarks/networks.py [--calls 40]

Prints the first table of benchmarks/results/onnx.txt. Times are CPU times on one thread.
"""

import argparse
import time
from collections.abc import Callable
from functools import partial

import numpy as np
import torch

from common import header, parse, print_table
from robotdiffuse.learning.checkpoint import load_completion, load_network
from robotdiffuse.learning.completion import BITS, exported_completion
from robotdiffuse.learning.exported_model import exported_model
from robotdiffuse.perception.voxel_grid import SHAPE
from robotdiffuse.robots import load_robot

BATCH = 16


def median_time(call: Callable[[], object], calls: int) -> float:
    """CPU time of a call [ms]: the median, after two calls that are not counted."""
    spent = []
    for _ in range(calls + 2):
        began = time.process_time()
        call()
        spent.append(1e3 * (time.process_time() - began))
    return float(np.median(spent[2:]))


def speed(calls: int) -> None:
    """Print the time of each network by ONNX Runtime and by PyTorch, and how far their outputs differ."""
    torch.set_num_threads(1)
    panda = load_robot("panda")
    rng = np.random.default_rng(0)
    rows = []
    for name in ("model", "trajectory_prior"):
        exported = exported_model(name, None, panda)
        network = load_network(name, None, panda)
        features = rng.normal(size=(BATCH, exported.waypoints, exported.feature_count)).astype(np.float32)
        condition = rng.normal(size=(BATCH, exported.condition_count)).astype(np.float32)
        inputs = features, np.ones(BATCH, np.float32), condition
        pair = [partial(model.denoised, *inputs) for model in (exported, network)]
        rows.append((f"denoiser of {name}, batch of {BATCH}", *pair))
        if exported.settings.encoder is not None:
            cloud = rng.uniform(-0.6, 0.6, (320, 3)).astype(np.float32)
            pair = [partial(model.embedding_of, cloud) for model in (exported, network)]
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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--calls", type=int, default=40, help="number of timed calls of each network (40)")
    arguments = parse(parser, calls=1)
    print(header("numpy", "numba", "onnxruntime", "torch"))
    speed(arguments.calls)


if __name__ == "__main__":
    main()
