"""Training data: planned trajectories with the embeddings of their scenes, random scenes, and batches
drawn from both."""

import hashlib
import math
import timeit
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import cache, cached_property
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Float32, Int
from numpy import ndarray
from numpy.random import Generator
from torch import Tensor

from robotdiffuse.core.errors import InputError, counted
from robotdiffuse.core.files import write_atomically
from robotdiffuse.core.types import Mask, Values, frozen_dataclass
from robotdiffuse.datasets.shards import SPLITS, read_manifest, read_rows, turns_about_vertical
from robotdiffuse.datasets.surface_clouds import surface_clouds
from robotdiffuse.learning.checkpoint import fingerprint
from robotdiffuse.learning.encoders.networks import Encoder
from robotdiffuse.learning.motion_model import PackedClearanceFn
from robotdiffuse.learning.motion_network import MotionNetwork
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.packed_scenes import BOX, NONE, SPHERE, PackedScenes

Trajectories = Float[ndarray, "n waypoints dof"]


def random_scenes(count: int, max_obstacles: int, rng: Generator, rop: bool = False) -> PackedScenes:
    """Random scenes for training an encoder.

    Each scene is of one of three kinds, with equal probability: two large obstacles as in ROP; up to
    `max_obstacles` obstacles about as large as in dense ROP; or up to `max_obstacles` boxes and spheres of
    very different sizes, half of them turned. rop: only scenes of the first kind.
    """
    group = rng.integers(0, 1 if rop else 3, count)  # of each scene
    number = np.where(group == 0, 2, rng.integers(0, max_obstacles + 1, count))
    shape = (count, max_obstacles)
    kinds = np.where(rng.random(shape) < 0.5, SPHERE, BOX).astype(np.int8)
    kinds[np.arange(max_obstacles) >= number[:, None]] = NONE
    center = rng.uniform([-1.0, -1.0, 0.1], [1.0, 1.0, 1.0], (*shape, 3))
    center[group == 2] *= rng.uniform([0.5, 0.5, 0.3], [1.0, 1.0, 1.2], (int((group == 2).sum()), 1, 3))
    any_size = (group == 2)[:, None, None]
    radius = np.where(group == 0, rng.uniform(0.18, 0.27, count), rng.uniform(0.06, 0.2, count))
    radius = np.where(any_size[..., 0], rng.uniform(0.04, 0.3, shape), radius[:, None])
    edge = np.where(group == 0, 0.2, rng.uniform(0.08, 0.3, count))[:, None, None]
    size = np.where(any_size, np.exp(rng.uniform(np.log(0.03), np.log(0.9), (*shape, 3))), edge)
    turned = any_size & (rng.random((*shape, 1)) < 0.5)
    wxyz = np.where(turned, rng.standard_normal((*shape, 4)), np.array([1.0, 0.0, 0.0, 0.0]))
    wxyz /= np.linalg.norm(wxyz, axis=-1, keepdims=True)
    size = np.where((kinds == SPHERE)[..., None], radius[..., None], size)
    params = np.concatenate([center, size, wxyz], -1).astype(np.float32)
    params[kinds == NONE] = 0.0
    return PackedScenes(kinds, params)


@frozen_dataclass
class TrajectoryData:
    """Planned trajectories with their scenes, in memory."""

    q: Trajectories
    """Joint values of the waypoints [rad], float32, evenly spaced along the path."""
    scenes: PackedScenes
    trivial: Mask
    """Whether the straight line from start to goal is free."""
    embeddings: Float[ndarray, "n embedding"] | None
    """Embedding z of each scene, float16; None if there is no frozen encoder."""
    digest: str
    """The first 16 digits of the SHA-256 of the shards' fingerprints."""
    validation: int
    """Number of rows of the validation split. In the data of `load_data` they come last, after those of the
    training split. The two parts that `split` returns keep the number unchanged."""

    def __len__(self) -> int:
        return len(self.q)

    def split(self, most: int) -> "tuple[TrajectoryData, TrajectoryData]":
        """The rows for training, and at most `most` rows for validation."""
        cut = len(self) - self.validation
        return self._rows(slice(None, cut)), self._rows(slice(cut, cut + most))

    @cached_property
    def pools(self) -> tuple[Int[ndarray, "m"], Int[ndarray, "k"]]:
        """Indices of the trivial rows, and of the rows that are not trivial."""
        return np.flatnonzero(self.trivial), np.flatnonzero(~self.trivial)

    def draw(self, count: int, trivial_share: float, rng: Generator) -> Int[ndarray, "count"]:
        """Indices of random rows. If the data have trivial and other rows, each drawn row is trivial with the
        probability `trivial_share`."""
        share = trivial_share if all(map(len, self.pools)) else float(len(self.pools[0]) > 0)
        trivial = rng.random(count) < share
        rows = np.empty(count, np.int64)
        for mask, pool in zip((trivial, ~trivial), self.pools, strict=True):
            rows[mask] = pool[rng.integers(0, max(len(pool), 1), int(mask.sum()))]
        return rows

    def _rows(self, rows: slice) -> "TrajectoryData":
        embeddings = None if self.embeddings is None else self.embeddings[rows]
        return replace(
            self, q=self.q[rows], scenes=self.scenes[rows], trivial=self.trivial[rows], embeddings=embeddings
        )


# Trajectories, their scenes, whether each trajectory is trivial, and the embeddings of the scenes
_Part = tuple[ndarray, PackedScenes, ndarray, ndarray]


def load_data(
    folder: str,
    robot: Robot,
    encoder: Encoder | None,
    waypoints: int,
    report: Callable[[str], None],
    turned_copies: int = 0,
) -> TrajectoryData:
    """The rows of a data set for training and validation, resampled to `waypoints`, with embeddings of their
    scenes.

    encoder: computes the embeddings; None: there are no embeddings.
    turned_copies: number of copies of each training row, turned by random angles, see
        `datasets.shards.turned`; no copies are made if the robot's first joint does not rotate about the
        vertical.
    report: called with messages about the progress.

    Embeddings are cached in the data folder, in files named by shard, encoder and turn; if the folder cannot
    be written, they are computed at every call. Raises InputError, naming the file, if there is no data set,
    a shard is damaged, or the data are of another robot.
    """
    if turned_copies and not turns_about_vertical(robot):
        report(f"data: no turned copies, as {robot.joint_names[0]} does not turn about the base's vertical")
        turned_copies = 0
    parts: dict[str, list[_Part]] = {"train": [], "validation": []}
    encoder_fingerprint = "" if encoder is None else fingerprint(encoder)
    fingerprints = list[str]()
    count = 0
    manifest = read_manifest(folder)
    shards = math.ceil(manifest.trajectories / manifest.shard)
    for rows in read_rows(folder, robot, waypoints, turned_copies):
        fingerprints += [rows.shard.fingerprint] * (rows.turn == 0)
        key = f"{rows.shard.fingerprint}-{encoder_fingerprint}" + (f"-turn{rows.turn}" if rows.turn else "")
        embeddings = _embeddings(Path(folder), rows.scenes, encoder, key)
        for name, collected in parts.items():
            chosen = rows.split == SPLITS.index(name)
            collected.append(
                (rows.q[chosen], rows.scenes[chosen], rows.shard["line_free"][chosen], embeddings[chosen])
            )
            count += int(chosen.sum())
        if rows.turn == turned_copies:
            report(
                f"data: {len(fingerprints)} of {shards} shards, "
                f"{counted(count, 'trajectory', 'trajectories')}"
            )
    q, scenes, trivial, embeddings = zip(*parts["train"], *parts["validation"], strict=True)
    return TrajectoryData(
        np.concatenate(q),
        PackedScenes.joined(scenes),
        np.concatenate(trivial),
        None if encoder is None else np.concatenate(embeddings),
        hashlib.sha256("".join(fingerprints).encode()).hexdigest()[:16],
        sum(len(part[0]) for part in parts["validation"]),
    )


def _embeddings(
    folder: Path,
    scenes: PackedScenes,
    encoder: Encoder | None,
    key: str,
) -> Float[ndarray, "n embedding"]:
    """Embeddings of scenes, cached in a file named by `key`; of size 0 if there is no encoder."""
    if encoder is None:
        return np.zeros((len(scenes), 0), np.float16)
    cache = folder / "codes" / f"{key}.npy"
    with suppress(OSError, ValueError, EOFError):  # missing or damaged
        embeddings = np.load(cache)
        if len(embeddings) == len(scenes):
            return embeddings
    embeddings = encode_scenes(encoder, scenes, np.random.default_rng(int(key[:8], 16)))
    with suppress(InputError):  # in a read-only data folder, the embeddings are computed again next time
        write_atomically(cache, lambda stream: np.save(stream, embeddings), make_folder=True)
    return embeddings


def encode_scenes(encoder: Encoder, scenes: PackedScenes, rng: Generator) -> Float[ndarray, "n embedding"]:
    """The embedding z of each scene, from a random cloud; float16."""
    embeddings = [np.zeros((0, encoder.settings.code), np.float16)]
    for i in range(0, len(scenes), 256):
        clouds = scene_clouds(encoder, scenes[i : i + 256], rng)
        with torch.inference_mode(), fast_autocast():
            embeddings.append(encoder(clouds).numpy().astype(np.float16))
    return np.concatenate(embeddings)


def scene_clouds(
    encoder: Encoder, scenes: PackedScenes, rng: Generator, points: int | None = None
) -> Float32[Tensor, "n points 3"]:
    """A random cloud of each scene [m], of `points` points; None: of the encoder's `cloud` points."""
    settings = encoder.settings
    return surface_clouds(scenes, points or settings.cloud, torch_generator(rng), region=settings.region)


def torch_generator(rng: Generator) -> torch.Generator:
    """A PyTorch generator, seeded with the next number of a NumPy generator."""
    return torch.Generator().manual_seed(int(rng.integers(2**63)))


@cache
def fast_bf16() -> bool:
    """Whether this CPU multiplies bf16 matrices faster than fp32 matrices.

    It is measured, since Intel's processors without AMX have instructions for it that take twice as long.
    """

    def seconds(kind: torch.dtype) -> float:
        matrix = torch.ones(512, 512, dtype=kind)
        return min(timeit.repeat(lambda: matrix @ matrix, number=1, repeat=5))

    # clearly faster, so that every process and every run finds the same
    return seconds(torch.bfloat16) < 0.8 * seconds(torch.float32)


def fast_autocast() -> torch.autocast:
    """A context in which this CPU multiplies matrices in bf16, if it does so fast."""
    return torch.autocast("cpu", torch.bfloat16, enabled=fast_bf16())


@frozen_dataclass
class Batch:
    """Noisy trajectories and the clean trajectories from which they were made; float32."""

    features: Float[ndarray, "n waypoints features"]
    level: Values
    """Noise level t / T."""
    condition: Float[ndarray, "n condition"]
    """Condition C = [z, start, goal]; z is zero if `clouds` are given."""
    clouds: Float32[Tensor, "n points 3"] | None
    """Clouds of the scenes [m], for an encoder that is trained jointly."""
    clean: Trajectories
    noisy: Trajectories
    target: Trajectories
    """The output that the network should have, by the model's objective."""
    weight: Values
    """Weight of the squared error of the output, by level."""
    clean_weight: Values
    """Weight of the squared error of the clean trajectory that follows from the output."""
    base: Trajectories
    """`Reference.base` of the trajectories."""
    signal: Float[ndarray, "n 1 1"]
    """Factor of the clean trajectory in `noisy`."""
    noise_level: Float[ndarray, "n 1 1"]
    """Factor of the noise in `noisy`."""
    scenes: PackedScenes


@frozen_dataclass
class Batches:
    """Draws training batches: rows of the data at random noise levels. Half of the trajectories are reversed,
    since the reverse of a valid trajectory is valid too."""

    data: TrajectoryData
    model: MotionNetwork
    clearances: PackedClearanceFn
    trivial_share: float
    weight_limit: float | None

    def draw(self, count: int, rng: Generator) -> Batch:
        """A random batch."""
        rows = self.data.draw(count, self.trivial_share, rng)
        # stratified: one level from each of `count` equal parts of the range
        parts = (np.arange(count) + rng.random(count)) / count
        levels = 1 + (parts * self.model.schedule.steps).astype(np.int64)
        return self.at(rows, np.minimum(levels, self.model.schedule.steps), rng)

    def at(self, rows: ndarray, levels: ndarray, rng: Generator) -> Batch:
        """The batch of these rows at these noise levels."""
        data = self.data
        model = self.model
        schedule = self.model.schedule
        scenes = data.scenes[rows]
        embeddings = np.zeros((len(rows), model.settings.code), np.float32)
        clouds = None
        if data.embeddings is not None:
            embeddings = data.embeddings[rows].astype(np.float32)
        elif model.encoder is not None:
            clouds = scene_clouds(model.encoder, scenes, rng)
        q = data.q[rows]
        back = rng.random(len(rows)) < 0.5
        q[back] = q[back, ::-1]
        reference = model.reference(q[:, 0], q[:, -1])
        clean = model.normalize(q, reference)
        signal, noise_level = (
            a[levels].astype(np.float32)[:, None, None] for a in (schedule.signal, schedule.noise)
        )
        noise = model.draw_noise(len(rows), rng)
        noisy = signal * clean + noise_level * noise
        target = model.objective.target(clean, noise)
        weight = model.objective.weight(schedule, levels, self.weight_limit)
        per_output = model.objective.clean_per_output(schedule.signal[levels], schedule.noise[levels])
        clamped = model.hold_ends(noisy.copy(), reference)
        return Batch(
            features=model.features(clamped, reference, lambda joints: self.clearances(scenes, joints)),
            level=(levels / schedule.steps).astype(np.float32),
            condition=model.condition(embeddings, q[:, 0], q[:, -1]),
            clouds=clouds,
            clean=clean,
            noisy=noisy,
            target=target,
            weight=weight.astype(np.float32),
            clean_weight=(weight / per_output**2).astype(np.float32),
            base=reference.base,
            signal=signal,
            noise_level=noise_level,
            scenes=scenes,
        )
