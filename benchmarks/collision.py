"""Speed, soundness and tightness of collision checking, for the Panda.

    python benchmarks/collision.py [--problems FOLDER] [--configurations 1000000]

Prints the report that is kept in benchmarks/results/collision.txt. FOLDER holds MotionBenchMaker families
(scene and request files). Times are CPU times of one core, unless said.
"""

import argparse
import os
import time
from collections.abc import Callable
from dataclasses import replace
from itertools import combinations
from pathlib import Path

# Threads that wait must not spin: on a busy machine they would take the time of those that work.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import numpy as np
import torch
from jaxtyping import Int
from numba import njit
from numpy import ndarray
from numpy.random import Generator
from report import header, print_table
from rich.progress import track

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.collision.exact_meshes import ExactCollision
from robotdiffuse.collision.kernels.lane_collision import W, make_workspace
from robotdiffuse.collision.kernels.motions import Space, motion_free
from robotdiffuse.collision.motions import search_space
from robotdiffuse.collision.signed_distance import SignedDistance
from robotdiffuse.planning.search.rrt_connect import RRTConnectSettings
from robotdiffuse.problems.families.family import base_spheres
from robotdiffuse.problems.families.rop import ROP
from robotdiffuse.problems.families.rop_dense import ROP_DENSE
from robotdiffuse.problems.files import load_motion_bench_maker
from robotdiffuse.robots import load_robot
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import PointCloud
from robotdiffuse.scenes.surface_points import sample_surface

SEED = 20261121
SCENES = 20
"""Scenes that a speed is averaged over."""
EDGES = 500
"""Edges of 1 rad in each of them."""
REPEATS = 5
"""The fastest pass counts."""
POINTS = 100_000
PER_SCENE = 2_000
"""Configurations per scene of the soundness check."""

Place = tuple[Robot, Scene]


def rop_places(robot: Robot, dense: bool, count: int) -> list[Place]:
    settings, keep_out = (ROP_DENSE if dense else ROP), base_spheres(robot)
    seeds = [np.random.default_rng([SEED, dense, i]) for i in range(count)]
    return [(robot, settings.scene(rng, keep_out)) for rng in seeds]


def cloud_places(robot: Robot, count: int) -> list[Place]:
    """Dense ROP scenes as point clouds of their surfaces."""
    rng = np.random.default_rng(SEED)
    places = rop_places(robot, True, count)
    return [(robot, Scene([PointCloud(sample_surface(scene, POINTS, rng), 0.01)])) for _, scene in places]


def family_places(folder: Path) -> list[Place]:
    problems = [entry.problem for entry in load_motion_bench_maker(folder)]
    return [(p.robot, p.scene) for p in problems if p is not None]


# -- speed of the kernel -------------------------------------------------------------------------------------


@njit
def check_edges(space: Space, starts: ndarray, ends: ndarray) -> ndarray:
    work, block = make_workspace(space.robot, space.scene), np.empty((starts.shape[1], W), np.float32)
    free = np.empty(len(starts), np.bool_)
    for i in range(len(starts)):
        free[i] = motion_free(space, starts[i], ends[i], block, work)
    return free


def random_edges(checker: CollisionChecker, rng: Generator) -> tuple[ndarray, ndarray]:
    """Edges of 1 rad from free configurations in random directions, within the limits."""
    robot, found = checker.robot, np.zeros((0, checker.robot.dof))
    for _ in range(1000):
        q = rng.uniform(robot.lower, robot.upper, (EDGES, robot.dof))
        found = np.concatenate([found, q[checker.free(q)]])
        if len(found) >= EDGES:
            break
    found = found[:EDGES]
    step = rng.normal(size=found.shape)
    ends = found + step / np.linalg.norm(step, axis=1, keepdims=True)
    return found.astype(np.float32), np.clip(ends, robot.lower, robot.upper).astype(np.float32)


def checked_configurations(space: Space, starts: ndarray, ends: ndarray) -> Int[ndarray, "n"]:
    """Configurations of each edge if it is checked in full."""
    travel = np.abs(ends - starts) @ space.motion_radii
    return W * np.maximum(np.ceil(travel / space.resolution / W), 1).astype(int)


def fastest(call: Callable[[], object]) -> float:
    """CPU time of the fastest of some calls, the first not counted [s]."""
    call()
    times = []
    for _ in range(REPEATS):
        start = time.process_time()
        call()
        times.append(time.process_time() - start)
    return min(times)


def kernel_speed(title: str, places: list[Place]) -> list[str]:
    """One row: mean times over some scenes."""
    rng, resolution = np.random.default_rng(SEED), RRTConnectSettings().resolution
    along, every, edge, share, build = [], [], [], [], []
    for robot, scene in places[:SCENES]:
        start = time.process_time()
        checker = CollisionChecker(robot, scene)
        build.append(time.process_time() - start)
        space = search_space(checker, resolution)
        starts, ends = random_edges(checker, rng)
        if len(starts) < EDGES:
            continue
        free = check_edges(space, starts, ends)
        count = checked_configurations(space, starts, ends)
        seconds = fastest(lambda a=starts[free], b=ends[free], s=space: check_edges(s, a, b))
        along.append(1e9 * seconds / count[free].sum())
        edge.append(1e6 * fastest(lambda a=starts, b=ends, s=space: check_edges(s, a, b)) / len(starts))
        share.append(free.mean())
        q = rng.uniform(robot.lower, robot.upper, (4096, robot.dof)).astype(np.float32)
        every.append(1e9 * fastest(lambda c=checker, q=q: c.free(q)) / len(q))
    figures = [np.mean(along), np.max(along), np.mean(edge), 100 * np.mean(share), np.mean(every)]
    return [title, *(f"{x:.0f}" if x >= 20 else f"{x:.1f}" for x in figures), f"{1e3 * np.median(build):.1f}"]


# -- signed distance in PyTorch ------------------------------------------------------------------------------


def torch_speed(title: str, places: list[Place]) -> list[str]:
    """Wall time of distances and gradient for 64 x 32 configurations [ms], one and two threads."""
    row = [title]
    for own in (False, True):
        for threads in (1, 2):
            torch.set_num_threads(threads)
            times = []
            for robot, scene in places[:3]:
                distance = SignedDistance(robot, scene)
                rng = np.random.default_rng(SEED)
                q = torch.tensor(
                    rng.uniform(robot.lower, robot.upper, (64, 32, robot.dof)), dtype=torch.float32
                )
                q.requires_grad_()
                for _ in range(8):
                    start = time.perf_counter()
                    cost = torch.relu(0.04 - distance(q)).square().sum()
                    if own:
                        cost = cost + torch.relu(0.01 - distance.self_distance(q)).square().sum()
                    torch.autograd.grad(cost, q)
                    times.append(time.perf_counter() - start)
            row.append(f"{1e3 * np.median(times):.1f}")
    return row


# -- soundness and tightness ---------------------------------------------------------------------------------


def without_pairs(robot: Robot) -> Robot:
    """The robot with no links checked against each other."""
    return replace(robot, allowed_collisions=frozenset(map(frozenset, combinations(robot.link_names, 2))))


def soundness(title: str, places: list[Place], configurations: int) -> tuple[ndarray, list[list[str]]]:
    """Counts [scene, self, both; mesh free, refused of these, mesh colliding, called free of these]."""
    rng, counts = np.random.default_rng(SEED), np.zeros((3, 4), int)
    per_scene = min(PER_SCENE, -(-configurations // len(places)))
    rounds = -(-configurations // per_scene)
    for i in track(range(rounds), title, transient=True):
        robot, scene = places[i % len(places)]
        q = rng.uniform(robot.lower, robot.upper, (per_scene, robot.dof))
        bare = without_pairs(robot)
        meshes = [ExactCollision(bare, scene).collides(q), ExactCollision(robot, Scene()).collides(q)]
        spheres = [~CollisionChecker(bare, scene).free(q), ~CollisionChecker(robot, Scene()).free(q)]
        both = ~CollisionChecker(robot, scene).free(q)
        assert (both == (spheres[0] | spheres[1])).all()
        for k, (mesh, sphere) in enumerate(
            zip([*meshes, meshes[0] | meshes[1]], [*spheres, both], strict=True)
        ):
            counts[k] += [(~mesh).sum(), (~mesh & sphere).sum(), mesh.sum(), (mesh & ~sphere).sum()]
    return counts, [count_row(f"{title}, {what}", counts[k]) for k, what in enumerate(WHAT)]


WHAT = ("scene", "self", "both")


def count_row(title: str, counts: Int[ndarray, "4"]) -> list[str]:
    free, refused, hit, missed = counts.tolist()
    return [
        title,
        f"{free + hit:,}",
        f"{hit / (free + hit):.1%}",
        f"{missed}",
        f"{refused / max(free, 1):.2%}",
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description="Speed, soundness and tightness of collision checking.")
    parser.add_argument("--problems", type=Path, help="folder with MotionBenchMaker families")
    parser.add_argument(
        "--configurations", type=int, default=1_000_000, help="of the soundness check, in all"
    )
    arguments = parser.parse_args()
    robot = load_robot("panda")
    print(header("numpy", "numba", "torch", "coal"))
    sizes = sum(map(len, robot.spheres.values()))
    print(f"Panda: {sizes} spheres, {len(CollisionChecker(robot, Scene()).pairs)} checked pairs of links")

    families = sorted(arguments.problems.iterdir()) if arguments.problems else []
    published = {path.name.removesuffix("_panda"): family_places(path) for path in families if path.is_dir()}
    solid = {
        "ROP, 2 obstacles + floor": rop_places(robot, False, SCENES),
        "ROP dense, 3 to 12 + floor": rop_places(robot, True, SCENES),
        **published,
    }
    clouds = {f"ROP dense, cloud of {POINTS:,}": cloud_places(robot, 5)}
    columns = ["", "ns, free edges", "worst scene", "us per edge", "edges free %", "ns, random q", "build ms"]
    rows = [kernel_speed(title, places) for title, places in (solid | clouds).items()]
    resolution = RRTConnectSettings().resolution
    print_table(
        f"Kernel, self-collision included, one core; edges of 1 rad checked every {1e3 * resolution:.0f} mm "
        "(per configuration; per edge: free or not)",
        columns,
        rows,
    )

    columns = ["", "scene, 1 thread", "2 threads", "and self, 1 thread", "2 threads"]
    rows = [torch_speed(title, places) for title, places in (solid | clouds).items()]
    print_table("PyTorch signed distance and gradient, 64 x 32 configurations, median ms", columns, rows)

    if arguments.configurations > 0:
        sampled = {
            "ROP": rop_places(robot, False, 500),
            "ROP dense": rop_places(robot, True, 500),
            **published,
        }
        total, rows = np.zeros((3, 4), int), []
        for title, places in sampled.items():
            counts, family = soundness(title, places, -(-arguments.configurations // len(sampled)))
            total += counts
            rows += family
        rows += [count_row(f"all, {what}", total[k]) for k, what in enumerate(WHAT)]
        columns = [
            "random configurations",
            "number",
            "collide by mesh",
            "called free of these",
            "refused of free",
        ]
        print_table("Covering spheres against exact meshes (Coal)", columns, rows)


if __name__ == "__main__":
    main()
