"""Training data: random problems, solved with a safety distance to the obstacles, in shards on disk."""

import json
import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.errors import InputError
from robotdiffuse.planners import rrt_connect_kernel as kernel
from robotdiffuse.planners.rrt_connect import random_state, search_space
from robotdiffuse.problem import JointGoal
from robotdiffuse.robots import load_robot
from robotdiffuse.robots.robot import Robot
from robotdiffuse.rop_problems import sample_problem
from robotdiffuse.scenes.rop import ROP, ROP_DENSE, RopSettings, pack_scene
from robotdiffuse.scenes.scene import Scene

REACH = 1.5
RESOLUTION = 0.04
CAPACITY = 8_000


@dataclass(frozen=True)
class GenerationSettings:
    """What a data set is made of. The same settings give the same data, whatever the number of workers."""

    robot: str = "panda"
    """Bundled name, or path to a URDF."""
    problems: int = 400_000
    """Problems drawn; trivial ones are thinned and unsolved ones left out, so fewer trajectories result."""
    seed: int = 0
    dense_share: float = 0.15
    """Share of problems from the dense variant of ROP; the others are ROP with two obstacles."""
    trivial_share: float = 0.1
    """Share that is kept of the problems that the straight line solves."""
    clearances: tuple[float, ...] = (0.06, 0.04, 0.02, 0.01, 0.0)
    """Safety distances to try, in this order [m] (the paper's node security defence), as far as start and
    goal allow them."""
    iterations: int = 3_000
    """Iterations of RRT-Connect before the next safety distance is tried."""
    attempts: int = 3
    """Searches per problem; the shortest path is kept."""
    shortcuts: int = 80
    frames: int = 48
    """Frames per trajectory, even in joint-space length."""
    shard: int = 2_000
    """Problems per shard."""

    def __post_init__(self) -> None:
        for name in ("problems", "iterations", "attempts", "shard"):
            if getattr(self, name) < 1:
                raise InputError(f"{name} is {getattr(self, name)}; it must be at least 1")
        for name in ("dense_share", "trivial_share"):
            if not 0 <= getattr(self, name) <= 1:
                raise InputError(f"{name} is {getattr(self, name)}; it must be between 0 and 1")
        if self.frames < 2:
            raise InputError(f"frames is {self.frames}; it must be at least 2")


def generate(
    settings: GenerationSettings,
    out: Path,
    workers: int,
    progress: Callable[[int, int], None] | None = None,
) -> int:
    """Make the shards that are missing in the folder; returns the number of trajectories in all.

    Interrupted at any moment, a second call goes on; a folder made with other settings is refused with
    InputError. `progress` is called with the numbers of finished shards and of all shards.
    """
    if workers < 1:
        raise InputError(f"workers is {workers}; it must be at least 1")
    _claim(settings, out)
    total = -(-settings.problems // settings.shard)
    missing = [i for i in range(total) if not _shard_file(out, i).exists()]
    done = total - len(missing)
    if progress:
        progress(done, total)
    if missing:
        # fresh interpreters: forked ones could inherit locks of running threads
        context = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(workers, context, initializer=_ignore_interrupt) as pool:
            jobs = [pool.submit(_make_shard, settings, out, i) for i in missing]
            try:
                for job in as_completed(jobs):
                    job.result()
                    done += 1
                    if progress:
                        progress(done, total)
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)
                raise
    return sum(len(np.load(_shard_file(out, i))["trivial"]) for i in range(total))


def _ignore_interrupt() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _claim(settings: GenerationSettings, out: Path) -> None:
    file, wanted = out / "settings.json", json.dumps(asdict(settings), indent=1)
    try:
        out.mkdir(parents=True, exist_ok=True)
        if file.exists():
            if json.loads(file.read_text()) != json.loads(wanted):
                raise InputError(f"{file} holds other settings; use them, or another folder")
        else:
            _write(file, lambda stream: stream.write(wanted.encode()))
    except (OSError, json.JSONDecodeError) as error:
        raise InputError(f"cannot use the data folder {out}: {error}") from None


def _shard_file(out: Path, index: int) -> Path:
    return out / f"shard_{index:05d}.npz"


def _write(file: Path, write: Callable) -> None:
    partial = file.with_suffix(f".{os.getpid()}.part")
    with open(partial, "wb") as stream:
        write(stream)
    partial.replace(file)


def _make_shard(settings: GenerationSettings, out: Path, index: int) -> None:
    robot = load_robot(settings.robot)
    first = index * settings.shard
    rows = list(_solved(settings, robot, range(first, min(first + settings.shard, settings.problems))))
    slots = max(ROP.obstacles[1], ROP_DENSE.obstacles[1])
    packed = [pack_scene(scene, slots) for scene, _, _, _ in rows]
    arrays = {
        "q": np.array([q for _, q, _, _ in rows], np.float32).reshape(-1, settings.frames, robot.dof),
        "kinds": np.array([kinds for kinds, _ in packed], np.int8).reshape(-1, slots),
        "params": np.array([params for _, params in packed], np.float32).reshape(-1, slots, 10),
        "trivial": np.array([trivial for _, _, trivial, _ in rows], bool),
        "clearance": np.array([clearance for _, _, _, clearance in rows], np.float32),
    }
    _write(_shard_file(out, index), lambda stream: np.savez(stream, **arrays))


def _solved(
    settings: GenerationSettings, robot: Robot, indices: range
) -> Iterator[tuple[Scene, ndarray, bool, float]]:
    """Obstacles without the floor, frames, whether the straight line is free, safety distance kept."""
    for index in indices:
        rng = np.random.default_rng([settings.seed, index])
        family = ROP_DENSE if rng.random() < settings.dense_share else ROP
        problem = sample_problem(robot, family, rng)
        assert isinstance(problem.goal, JointGoal)
        checker = CollisionChecker(robot, problem.scene)
        ends = np.stack([problem.start, problem.goal.positions[0]]).astype(np.float32)
        line = _line_is_free(checker, ends)
        if line and rng.random() >= settings.trivial_share:
            continue
        found = solve_with_clearance(settings, checker, ends, random_state(settings.seed, index))
        if found is not None:
            path, clearance = found
            yield _obstacles(problem.scene, family), resample(path, settings.frames), line, clearance


def _obstacles(scene: Scene, family: RopSettings) -> Scene:
    return Scene(scene.shapes[1:]) if family.floor else scene


def _line_is_free(checker: CollisionChecker, ends: Float[ndarray, "2 dof"]) -> bool:
    return bool(kernel.motions_free(search_space(checker, RESOLUTION), ends).all())


def solve_with_clearance(
    settings: GenerationSettings, checker: CollisionChecker, ends: Float[ndarray, "2 dof"], state: ndarray
) -> tuple[Float[ndarray, "n dof"], float] | None:
    """The shortest of some paths at the greatest safety distance that has one, and that distance [m]."""
    margin = float(checker.link_clearances(ends).min(initial=1.0))
    for clearance in settings.clearances:
        if clearance > 0 and clearance >= margin:
            continue
        space = search_space(checker, RESOLUTION, padding=clearance)
        best: ndarray | None = None
        for _ in range(settings.attempts):
            trees = kernel.make_trees(ends[0], ends[1:], CAPACITY)
            path = kernel.search(space, trees, np.float32(REACH), settings.iterations, state)
            if not len(path):
                break
            path = kernel.shortcut(space, path, settings.shortcuts, state)
            if best is None or kernel.path_length(path) < kernel.path_length(best):
                best = path
            if len(best) == 2:
                break
        if best is not None:
            return best, clearance
    return None


def resample(path: Float[ndarray, "n dof"], frames: int) -> Float[ndarray, "frames dof"]:
    """The path at `frames` places evenly spaced in joint-space length, both ends included."""
    steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
    at = np.concatenate([[0.0], np.cumsum(steps, dtype=np.float64)])
    wanted = np.linspace(0.0, at[-1], frames)
    rows = [np.interp(wanted, at, path[:, j]) for j in range(path.shape[1])]
    return np.stack(rows, axis=1).astype(path.dtype)
