"""What encoders keep of a scene: the paper's auto-encoder, the one that ships, and the completing one.

    python benchmarks/encoders.py [--cae FOLDER] [--scenes 70]

FOLDER: of `robotdiffuse train encoder --encoder compression_autoencoder`; without it the paper's is left out.
Prints the report that is kept in benchmarks/results/encoders.txt. Scenes are held out: of all families, and
boxes and spheres as auto-encoders learn from. Each is told to an encoder as a cloud of its surfaces, or as
one camera sees it. Validated is what lies within the arm's reach and above the floor.

- decoded: what its own decoder makes of it, as points. The paper's decodes 1,400, the one that ships 192; of
  the completing one these are the centres of voxels of 2 cm at the border of what it finds likelier occupied
  than not. Its decoder is told more than z: what goes around the bottleneck. `points as told` are the points
  themselves, with no network. Chamfer: mean distance to the nearest point of the other side, of both sides;
  near: share of the decoded points within 4 cm of the true surfaces; found: share of the true ones within
  4 cm of a decoded one.
- read from z: what a linear map makes of z alone, the same yardstick for all: fitted by least squares to the
  occupancy of voxels of 4 cm in other scenes. IoU of voxels; the threshold is the best one. And the distances
  of 48 places around the arm, as `train encoder` reports it (`linear_readout`).
"""

import argparse
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy import ndarray
from report import header, print_table, progress
from scipy.spatial import KDTree

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.learning.checkpoint import load_encoder, load_model
from robotdiffuse.learning.completion.network import REACH, SHOULDER, reachable
from robotdiffuse.learning.completion.samples import (
    FINE,
    camera_view,
    pack,
    pack_fine,
    random_configuration,
    true_voxels,
)
from robotdiffuse.learning.encoders.base import Encoder
from robotdiffuse.learning.encoders.completing_autoencoder import CompletingAutoencoder
from robotdiffuse.learning.encoders.compression_autoencoder import CompressionAutoencoder
from robotdiffuse.learning.encoders.point_autoencoder import PointAutoencoder
from robotdiffuse.learning.training.batches import random_scenes
from robotdiffuse.learning.training.config import EncoderTraining
from robotdiffuse.learning.training.encoder import linear_readout
from robotdiffuse.perception.observed_volume import LOW, ObservedVolume, observe
from robotdiffuse.perception.seen_points import seen_points
from robotdiffuse.problems.families import FAMILIES, load_family
from robotdiffuse.problems.families.family import base_spheres
from robotdiffuse.robots import load_robot
from robotdiffuse.scenes.surface_points import PANDA_REGION, sample_surface

SEED = 20261123
ROBOT = load_robot("panda")
NEAR = 0.04
"""[m]"""
POINTS = 2048
"""Of clouds, and of the true surfaces that are compared with."""
RIDGE = 1e-2
"""Of the variance of a code's numbers."""
THRESHOLDS = np.arange(0.05, 0.6, 0.05)


class Told(NamedTuple):
    """A scene, and what is told of it."""

    surface: Float[ndarray, "n 3"]
    """Points of the true surfaces, others than the cloud's."""
    filled: Bool[ndarray, "m"]
    """Which voxels of 4 cm within reach hold obstacles."""
    cloud: Float[ndarray, "k 3"]
    seen: Float[ndarray, "k 3"]
    """By one camera."""
    volume: ObservedVolume


def draw(kind: str, count: int, seed: int) -> Iterator[Told]:
    rng = np.random.default_rng([SEED, seed])
    packed = random_scenes(count, 12, rng)
    for i in progress(range(count), kind):
        if kind == "families":
            family = load_family(list(FAMILIES)[i % len(FAMILIES)])
            scene = family.scene(rng, base_spheres(ROBOT))
        else:
            scene = packed.scene(i)
        q = random_configuration(CollisionChecker(ROBOT, scene), ROBOT, rng)
        view = camera_view(scene, ROBOT, q, rng)
        surface, cloud = (sample_surface(scene, POINTS, rng, PANDA_REGION) for _ in range(2))
        seen = seen_points([view], ROBOT, q)
        yield Told(
            surface,
            (pack_fine(true_voxels(scene)) > 0)[FILLABLE],
            cloud,
            seen[PANDA_REGION.holds(seen)],
            observe([view], ROBOT, q),
        )


FILLABLE = reachable()
FILLABLE[:, :, : int((PANDA_REGION.floor - LOW[2]) / (2 * FINE)) + 1] = False  # the floor's voxels


def validated(points: Float[ndarray, "n 3"]) -> Float[ndarray, "m 3"]:
    """Those within the arm's reach and above the floor."""
    near = np.linalg.norm(points - SHOULDER, axis=-1) < REACH
    return points[near & (points[:, 2] > PANDA_REGION.floor)]


def decode_points(encoder: Encoder, cloud: Float[ndarray, "n 3"]) -> Float[ndarray, "m 3"]:
    assert isinstance(encoder, CompressionAutoencoder | PointAutoencoder)
    with torch.inference_mode():
        return encoder.decode(encoder.encode(_tensor(cloud)))[0].numpy()


def complete(
    encoder: CompletingAutoencoder, seen: torch.Tensor, behind: torch.Tensor
) -> Float[ndarray, "m 3"]:
    """Centres of voxels of 2 cm at the border of what is likelier occupied than not."""
    with torch.inference_mode():
        occupied = encoder.network.probabilities(seen, behind)[0].numpy() > 0.5
    inner = occupied.copy()
    for axis in range(3):
        inner &= np.roll(occupied, 1, axis) & np.roll(occupied, -1, axis)
    return (np.argwhere(occupied & ~inner) + 0.5) * FINE + LOW


def _tensor(cloud: Float[ndarray, "n 3"]) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(cloud, np.float32))[None]


def figures(truth: Float[ndarray, "n 3"], found: Float[ndarray, "m 3"]) -> tuple[float, float, float]:
    """Chamfer distance [m], share near and share found; of nothing found, 1 m and zeros."""
    truth, found = validated(truth), validated(found)
    if not len(found) or not len(truth):
        return (1.0, 0.0, 0.0) if len(truth) else (np.nan, np.nan, np.nan)
    there, back = KDTree(truth).query(found)[0], KDTree(found).query(truth)[0]
    return (there.mean() + back.mean()) / 2, (there < NEAR).mean(), (back < NEAR).mean()


def read_out(z: Float[ndarray, "n code"], filled: Bool[ndarray, "n m"], fitted: int) -> tuple[float, float]:
    """IoU of voxels read from z in the scenes after the first `fitted`, and of a constant guess."""
    mean, middle = filled[:fitted].mean(axis=0), z[:fitted].mean(axis=0)
    z = (z - middle) / z[:fitted].std(axis=0).clip(1e-6)
    gram = z[:fitted].T @ z[:fitted]
    ridge = RIDGE * np.trace(gram) / len(gram) * np.eye(len(gram))
    weights = np.linalg.solve(gram + ridge, z[:fitted].T @ (filled[:fitted] - mean))
    guess, truth = mean + z[fitted:] @ weights, filled[fitted:]
    best = max(_iou(guess > threshold, truth) for threshold in THRESHOLDS)
    return best, max(_iou(mean > threshold, truth) for threshold in THRESHOLDS)


def _iou(guess: Bool[ndarray, "*m"], truth: Bool[ndarray, "n m"]) -> float:
    return float((guess & truth).sum() / max(1, (guess | truth).sum()))


def codes(encode: Callable[[Told], torch.Tensor], scenes: list[Told]) -> Float[ndarray, "n code"]:
    with torch.inference_mode():
        return np.stack([encode(scene).numpy() for scene in scenes]).astype(np.float64)


def distances(encoders: dict[str, Encoder]) -> None:
    rows = []
    for name, encoder in encoders.items():
        found = linear_readout(encoder, EncoderTraining.max_obstacles, np.random.default_rng(SEED))
        rows.append((name, f"{100 * found['readout']:.1f}", f"{100 * found['readout_of_constant']:.1f}"))
    print_table("distances read from z: boxes and spheres", ["encoder", "error, cm", "of a constant"], rows)


def main() -> None:
    parser = argparse.ArgumentParser(description="What encoders keep of a scene.")
    parser.add_argument("--cae", metavar="FOLDER", help="the paper's encoder, trained")
    parser.add_argument("--scenes", type=int, default=70, help="that are validated, of each kind (70)")
    parser.add_argument("--fitted", type=int, default=700, help="that read-outs are fitted to (700)")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    completing, shipped = load_encoder("completing_autoencoder"), load_model("panda").encoder
    assert isinstance(completing, CompletingAutoencoder) and shipped is not None
    points = {} if arguments.cae is None else {"the paper's, 60 numbers": load_encoder(arguments.cae)}
    points["the one that ships, 96"] = shipped

    def told_cloud(scene: Told) -> tuple[torch.Tensor, torch.Tensor]:
        seen = completing.volume(_tensor(scene.cloud))
        return seen, torch.zeros_like(seen)

    def told_view(scene: Told) -> tuple[torch.Tensor, torch.Tensor]:
        seen, behind = (torch.from_numpy(a)[None] for a in pack(scene.volume))
        return seen, behind

    decoders: dict[tuple[str, str], Callable[[Told], ndarray]] = {
        ("points as told", "cloud"): lambda scene: scene.cloud,
        **{(name, "cloud"): lambda s, of=of: decode_points(of, s.cloud) for name, of in points.items()},
        ("completing", "cloud"): lambda scene: complete(completing, *told_cloud(scene)),
        ("points as told", "view"): lambda scene: scene.seen,
        **{(name, "view"): lambda s, of=of: decode_points(of, s.seen) for name, of in points.items()},
        ("completing", "view"): lambda scene: complete(completing, *told_view(scene)),
    }
    encoders: dict[tuple[str, str], Callable[[Told], torch.Tensor]] = {
        **{(name, "cloud"): lambda s, of=of: of(_tensor(s.cloud))[0] for name, of in points.items()},
        ("completing, 96", "cloud"): lambda scene: completing.of_volumes(*told_cloud(scene))[0],
        **{(name, "view"): lambda s, of=of: of(_tensor(s.seen))[0] for name, of in points.items()},
        ("completing, 96", "view"): lambda scene: completing.of_volumes(*told_view(scene))[0],
    }
    print(header("numpy", "torch"))
    distances(points | {"completing, 96": completing})
    for kind in ("boxes and spheres", "families"):
        scenes = [*draw(kind, arguments.fitted, 1), *draw(kind, arguments.scenes, 2)]
        rows = []
        for (name, told), decode in decoders.items():
            found = [figures(scene.surface, decode(scene)) for scene in scenes[arguments.fitted :]]
            chamfer, near, back = np.nanmean(found, axis=0)
            rows.append((name, told, f"{100 * chamfer:.1f}", f"{100 * near:.0f}", f"{100 * back:.0f}"))
        print_table(
            f"decoded: {arguments.scenes} scenes, {kind}",
            ["encoder", "told", "Chamfer, cm", "near, %", "found, %"],
            rows,
        )
        filled = np.stack([scene.filled for scene in scenes])
        rows = []
        for (name, told), encode in encoders.items():
            iou, constant = read_out(codes(encode, scenes), filled, arguments.fitted)
            rows.append((name, told, f"{100 * iou:.1f}", f"{100 * constant:.1f}"))
        print_table(
            f"read from z: {arguments.scenes} scenes, {kind}",
            ["encoder", "told", "IoU, %", "of a constant, %"],
            rows,
        )


if __name__ == "__main__":
    main()
