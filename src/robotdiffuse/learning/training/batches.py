"""What training draws from: planned trajectories with the codes of their scenes, and random scenes."""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from io import BytesIO
from pathlib import Path as FilePath

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int, Int8
from numpy import ndarray
from torch import Tensor

from robotdiffuse.data.shards import SPLITS, check_shard, read_manifest, shard_indices, split_of
from robotdiffuse.errors import InputError
from robotdiffuse.files import write_atomically
from robotdiffuse.learning.checkpoint import fingerprint
from robotdiffuse.learning.encoders import Encoder
from robotdiffuse.learning.motion_model import MotionModel
from robotdiffuse.learning.training.turns import turned, turns_about_vertical
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.packed import BOX, SPHERE
from robotdiffuse.scenes.surface_clouds import surface_clouds


def random_scenes(
    count: int, max_obstacles: int, rng: np.random.Generator
) -> tuple[Int8[ndarray, "n k"], Float32[ndarray, "n k 10"]]:
    """Packed scenes for the encoder, a third each: two large obstacles as in ROP, several of the sizes of
    dense ROP, and any number of boxes and spheres of any size and orientation."""
    family = rng.integers(0, 3, count)
    number = np.where(family == 0, 2, rng.integers(0, max_obstacles + 1, count))
    shape = (count, max_obstacles)
    kinds = np.where(rng.random(shape) < 0.5, SPHERE, BOX).astype(np.int8)
    kinds[np.arange(max_obstacles) >= number[:, None]] = 0
    center = rng.uniform([-1.0, -1.0, 0.1], [1.0, 1.0, 1.0], (*shape, 3))
    center[family == 2] *= rng.uniform([0.5, 0.5, 0.3], [1.0, 1.0, 1.2], (int((family == 2).sum()), 1, 3))
    free = (family == 2)[:, None, None]
    radius = np.where(family == 0, rng.uniform(0.18, 0.27, count), rng.uniform(0.06, 0.2, count))
    radius = np.where(free[..., 0], rng.uniform(0.04, 0.3, shape), radius[:, None])
    edge = np.where(family == 0, 0.2, rng.uniform(0.08, 0.3, count))[:, None, None]
    size = np.where(free, np.exp(rng.uniform(np.log(0.03), np.log(0.9), (*shape, 3))), edge)
    turned = free & (rng.random((*shape, 1)) < 0.5)
    wxyz = np.where(turned, rng.standard_normal((*shape, 4)), np.array([1.0, 0.0, 0.0, 0.0]))
    wxyz /= np.linalg.norm(wxyz, axis=-1, keepdims=True)
    size = np.where((kinds == SPHERE)[..., None], radius[..., None], size)
    params = np.concatenate([center, size, wxyz], -1).astype(np.float32)
    params[kinds == 0] = 0.0
    return kinds, params


@dataclass(frozen=True, eq=False)
class TrajectoryData:
    """Planned trajectories with their scenes, in memory."""

    q: Float[ndarray, "n frames dof"]
    """[rad], float32, evenly spaced along the path."""
    kinds: Int8[ndarray, "n k"]
    params: Float32[ndarray, "n k 10"]
    trivial: Bool[ndarray, "n"]
    """The straight line from start to goal is free too."""
    codes: Float[ndarray, "n code"] | None
    """z of each scene, float16; None where the encoder is trained along."""
    digest: str
    """SHA-256 of the shards, the first 16 digits."""
    validation: int
    """So many rows, the last, are of the split for validation; the others are of that for training."""

    def __len__(self) -> int:
        return len(self.q)

    def split(self, most: int) -> "tuple[TrajectoryData, TrajectoryData]":
        """The rows for training, and at most so many of those for validation."""
        cut = len(self) - self.validation
        return self._rows(slice(None, cut), 0), self._rows(slice(cut, cut + most), min(most, self.validation))

    @cached_property
    def pools(self) -> tuple[Int[ndarray, "m"], Int[ndarray, "k"]]:
        """Rows that are trivial, and rows that are not."""
        return np.flatnonzero(self.trivial), np.flatnonzero(~self.trivial)

    def draw(self, count: int, trivial_share: float, rng: np.random.Generator) -> Int[ndarray, "count"]:
        """Random rows, so large a share of them trivial where the data have both kinds."""
        share = trivial_share if all(map(len, self.pools)) else float(len(self.pools[0]) > 0)
        easy = rng.random(count) < share
        rows = np.empty(count, np.int64)
        for mask, pool in zip((easy, ~easy), self.pools, strict=True):
            rows[mask] = pool[rng.integers(0, max(len(pool), 1), int(mask.sum()))]
        return rows

    def _rows(self, rows: slice, validation: int) -> "TrajectoryData":
        return TrajectoryData(
            self.q[rows],
            self.kinds[rows],
            self.params[rows],
            self.trivial[rows],
            None if self.codes is None else self.codes[rows],
            self.digest,
            validation,
        )


def load_data(
    folder: str,
    robot: Robot,
    encoder: Encoder | None,
    frames: int,
    report: Callable[[str], None],
    turns: int = 0,
) -> TrajectoryData:
    """The rows for training and validation of a data set, at `frames` frames, with the codes of their scenes.

    turns: copies of each row for training that are turned by random angles, see `turns.py`; none if the
        robot's first joint is not vertical.

    Codes are kept beside the shards, in files named by shard and encoder; where the folder cannot be written
    they are made each time. Without an encoder there are none. `report` is told what is being done. Raises
    InputError, naming the file, if there is no data set, a shard is damaged, or the robot is another.
    """
    manifest, indices = read_manifest(folder), shard_indices(folder)
    manifest.check_robot(robot)
    if not indices:
        raise InputError(f"data folder {folder} holds no shard; make some with: robotdiffuse data generate")
    parts: dict[str, list[tuple[ndarray, ...]]] = {"train": [], "validation": []}
    digest, rows = hashlib.sha256(), 0
    if turns and not turns_about_vertical(robot):
        report(f"data: no turned copies, for {robot.joint_names[0]} does not turn about the base's vertical")
        turns = 0
    encoder_print = "" if encoder is None else fingerprint(encoder)
    for i, index in enumerate(indices):
        shard = check_shard(folder, index, manifest)
        digest.update(shard.fingerprint.encode())
        kinds, params = shard["obstacle_kinds"], shard["obstacle_params"]
        split, trivial = split_of(kinds, params), shard["line_free"]
        q = resample_evenly(shard["trajectories"][:], frames)
        key = f"{shard.fingerprint}-{encoder_print}"
        codes = _codes(FilePath(folder), kinds, params, encoder, key)
        for name, found in parts.items():
            of = split == SPLITS.index(name)
            found.append((q[of], kinds[of], params[of], trivial[of], codes[of]))
            rows += int(of.sum())
        train = split == SPLITS.index("train")
        for turn in range(1, turns + 1):
            rng = np.random.default_rng([int(shard.fingerprint, 16), turn])
            # the stored frames: codes are kept for scenes turned by these angles, for any number of frames
            q_turned, params_turned, clear = turned(robot, shard["trajectories"][:], params, rng)
            codes = _codes(FilePath(folder), kinds, params_turned, encoder, f"{key}-turn{turn}")
            of = train & clear
            q_turned = resample_evenly(q_turned[of], frames)
            parts["train"].append((q_turned, kinds[of], params_turned[of], trivial[of], codes[of]))
            rows += int(of.sum())
        report(f"data: {i + 1} of {len(indices)} shards, {rows:,} trajectories")
    ordered = parts["train"] + parts["validation"]
    q, kinds, params, trivial, codes = (np.concatenate(arrays) for arrays in zip(*ordered, strict=True))
    validation = sum(len(part[0]) for part in parts["validation"])
    return TrajectoryData(
        q,
        kinds,
        params,
        trivial,
        None if encoder is None else codes,
        digest.hexdigest()[:16],
        validation,
    )


def resample_evenly(q: Float32[ndarray, "n stored dof"], frames: int) -> Float32[ndarray, "n {frames} dof"]:
    """Each trajectory at `frames` places, evenly spaced in joint-space length; the ends are kept exactly."""
    n, stored = q.shape[:2]
    steps = np.linalg.norm(np.diff(q, axis=1), axis=2).astype(np.float64)
    at = np.concatenate([np.zeros((n, 1)), np.cumsum(steps, axis=1)], axis=1)
    at /= np.maximum(at[:, -1:], np.finfo(np.float64).tiny)
    wanted = np.linspace(0.0, 1.0, frames)
    # rows one after the other, two apart, are one rising list
    row = 2.0 * np.arange(n)[:, None]
    after = np.searchsorted((at + row).reshape(-1), (wanted + row).reshape(-1), side="right")
    after = after.reshape(n, frames)
    after = np.clip(after - np.arange(n)[:, None] * stored, 1, stored - 1)[..., None]
    low, high = (np.take_along_axis(at, i[..., 0], 1) for i in (after - 1, after))
    share = ((wanted - low) / np.maximum(high - low, np.finfo(np.float64).tiny)).clip(0, 1)
    share = share.astype(np.float32)[..., None]
    below, above = (np.take_along_axis(q, i, 1) for i in (after - 1, after))
    even = below + share * (above - below)
    even[:, 0], even[:, -1] = q[:, 0], q[:, -1]
    return even


def _codes(
    folder: FilePath,
    kinds: Int8[ndarray, "n k"],
    params: Float32[ndarray, "n k 10"],
    encoder: Encoder | None,
    key: str,
) -> Float[ndarray, "n code"]:
    """Codes of packed scenes, kept in a file named by `key`; of no numbers where there is no encoder."""
    if encoder is None:
        return np.zeros((len(kinds), 0), np.float16)
    cache = folder / "codes" / f"{key}.npy"
    if cache.is_file():
        try:
            codes = np.load(cache)
            if len(codes) == len(kinds):
                return codes
        except (OSError, ValueError, EOFError):
            pass  # damaged: made again below
    codes = encode_scenes(encoder, kinds, params, np.random.default_rng(int(key[:8], 16)))
    try:
        buffer = BytesIO()
        np.save(buffer, codes)
        write_atomically(cache, buffer.getvalue(), make_folder=True)
    except InputError:
        pass  # a read-only data folder: the codes are made again next time
    return codes


def encode_scenes(
    encoder: Encoder,
    kinds: Int8[ndarray, "n k"],
    params: Float32[ndarray, "n k 10"],
    rng: np.random.Generator,
) -> Float[ndarray, "n code"]:
    """z of each packed scene from a random cloud, as float16."""
    codes = [np.zeros((0, encoder.settings.code), np.float16)]
    for i in range(0, len(kinds), 256):
        part = slice(i, i + 256)
        clouds = scene_clouds(encoder, kinds[part], params[part], rng)
        with torch.inference_mode(), torch.autocast("cpu", torch.bfloat16, enabled=fast_bf16()):
            codes.append(encoder(clouds).numpy().astype(np.float16))
    return np.concatenate(codes)


def scene_clouds(
    encoder: Encoder,
    kinds: Int8[ndarray, "n k"],
    params: Float32[ndarray, "n k 10"],
    rng: np.random.Generator,
    points: int | None = None,
) -> Float32[Tensor, "n points 3"]:
    """A random cloud of each packed scene as the encoder wants them, or of so many points [m]."""
    settings = encoder.settings
    generator = torch.Generator().manual_seed(int(rng.integers(2**63)))
    scenes = torch.from_numpy(kinds), torch.from_numpy(params)
    return surface_clouds(*scenes, points or settings.cloud, generator, region=settings.region)


def fast_bf16() -> bool:
    """Whether this CPU multiplies bf16 matrices fast."""
    return bool(torch.cpu._is_avx512_bf16_supported())


@dataclass(frozen=True, eq=False)
class Batch:
    """Noisy trajectories and their clean ones; float32."""

    features: Float[ndarray, "n rows features"]
    level: Float[ndarray, "n"]
    """t / T"""
    condition: Float[ndarray, "n condition"]
    """With zeros for z where there are clouds."""
    clouds: Float32[Tensor, "n points 3"] | None
    """Of the scenes [m], where the encoder is trained along."""
    clean: Float[ndarray, "n rows dof"]
    noisy: Float[ndarray, "n rows dof"]
    target: Float[ndarray, "n rows dof"]
    """What the network is to output, by the model's objective."""
    weight: Float[ndarray, "n"]
    """Of the squared error of the output, by level."""
    clean_weight: Float[ndarray, "n"]
    """The same of errors of the clean trajectory that the output stands for."""
    base: Float[ndarray, "n rows dof"]
    """What rows are relative to, see `Between`."""
    signal: Float[ndarray, "n 1 1"]
    noise_level: Float[ndarray, "n 1 1"]
    kinds: Int8[ndarray, "n k"]
    params: Float32[ndarray, "n k 10"]


class Batches:
    """Draws training batches: rows of the data, forwards or reversed (as good a path), at random levels."""

    def __init__(
        self,
        data: TrajectoryData,
        model: MotionModel,
        clearances: Callable[[ndarray, ndarray, ndarray], ndarray],
        trivial_share: float,
        weight_limit: float,
    ) -> None:
        """clearances: (kinds [n, k], params [n, k, 10], q [n, rows, dof]) to what ClearanceFn gives."""
        self.data, self.model, self.clearances = data, model, clearances
        self.trivial_share, self.weight_limit = trivial_share, weight_limit

    def draw(self, count: int, rng: np.random.Generator) -> Batch:
        """A random batch."""
        rows = self.data.draw(count, self.trivial_share, rng)
        # One level from each of `count` equal parts of the range: less variance than independent draws.
        parts = (np.arange(count) + rng.random(count)) / count
        levels = 1 + (parts * self.model.schedule.steps).astype(np.int64)
        return self.at(rows, np.minimum(levels, self.model.schedule.steps), rng)

    def at(self, rows: ndarray, levels: ndarray, rng: np.random.Generator) -> Batch:
        """These rows at these noise levels."""
        data, model, schedule = self.data, self.model, self.model.schedule
        kinds, params = data.kinds[rows], data.params[rows]
        if data.codes is None:
            codes = np.zeros((len(rows), model.config.encoder_settings.code), np.float32)
            clouds = scene_clouds(model.encoder, kinds, params, rng)
        else:
            codes, clouds = data.codes[rows].astype(np.float32), None
        q = data.q[rows]
        back = rng.random(len(rows)) < 0.5
        q[back] = q[back, ::-1]
        between = model.between(q[:, 0], q[:, -1])
        clean = model.to_rows(q, between)
        signal, noise_level = (
            a[levels].astype(np.float32)[:, None, None] for a in (schedule.signal, schedule.noise)
        )
        noise = model.draw_noise(len(rows), rng)
        noisy = signal * clean + noise_level * noise
        target = model.objective.target(clean, noise, signal, noise_level)
        weight = model.objective.weight(schedule, levels, self.weight_limit)
        per_output = model.objective.clean_per_output(schedule.signal[levels], schedule.noise[levels])
        held = model.hold(noisy.copy(), between)
        return Batch(
            features=model.features(held, between, lambda at: self.clearances(kinds, params, at)),
            level=(levels / schedule.steps).astype(np.float32),
            condition=model.condition(codes, q[:, 0], q[:, -1]),
            clouds=clouds,
            clean=clean,
            noisy=noisy,
            target=target,
            weight=weight.astype(np.float32),
            clean_weight=(weight / per_output**2).astype(np.float32),
            base=between.base,
            signal=signal,
            noise_level=noise_level,
            kinds=kinds,
            params=params,
        )
