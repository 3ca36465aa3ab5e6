"""Collision checking of the Panda: speed, colliding configurations called free, free ones called colliding.

    python benchmarks/collision.py [--problems FOLDER] [--configurations 1000000] [--each 8]

Prints benchmarks/results/collision.txt, and the table of the kernel in core.txt. FOLDER holds
MotionBenchMaker families (scene and request files). Times are CPU times of one core.
"""

import argparse
import time
from collections.abc import Callable
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
from jaxtyping import Int
from numba import njit
from numpy import ndarray
from numpy.random import Generator

from common import FIRST, draw_hard_cases, header, parse, print_table, progress
from robotdiffuse.collision import CollisionChecker
from robotdiffuse.collision.exact_meshes import ExactCollision
from robotdiffuse.collision.kernels.lane_collision import make_workspace, place_frames
from robotdiffuse.collision.kernels.motions import Space, make_scratch, motion_free
from robotdiffuse.collision.kernels.simd import W, lanes_array
from robotdiffuse.collision.motions import search_space
from robotdiffuse.planning import load_planner
from robotdiffuse.planning.search.rrt import RRTConnectSettings
from robotdiffuse.problems.families import FAMILIES
from robotdiffuse.problems.families.family import base_spheres
from robotdiffuse.problems.families.rop import ROP, ROP_DENSE
from robotdiffuse.problems.files import load_motion_bench_maker
from robotdiffuse.robots import load_robot
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import PointCloud
from robotdiffuse.scenes.surface_points import sample_surface

SEED = 20261121
SCENES = 20
"""Number of scenes over which a speed is averaged."""
EDGES = 500
"""Number of edges of 1 rad in each scene."""
PASSES = 5
"""Number of timed calls, of which the fastest counts."""
# Number of points of a cloud, and their radius [m].
POINTS = 100_000
POINT_RADIUS = 0.01
CONFIGURATIONS_PER_SCENE = 2_000
RESOLUTION = RRTConnectSettings().resolution
"""Resolution of the collision checks of searches [m]."""
PATH_REPEATS = 50
"""How often each path is checked in `along_paths`, in both directions."""

Place = tuple[Robot, Scene]


def rop_places(robot: Robot, dense: bool, count: int) -> list[Place]:
    settings = ROP_DENSE if dense else ROP
    keep_out = base_spheres(robot)
    seeds = [np.random.default_rng([SEED, dense, i]) for i in range(count)]
    return [(robot, settings.scene(rng, keep_out)) for rng in seeds]


def cloud_places(robot: Robot, count: int) -> list[Place]:
    """Dense ROP scenes as point clouds of their surfaces."""
    rng = np.random.default_rng(SEED)
    places = rop_places(robot, True, count)
    return [
        (robot, Scene([PointCloud(sample_surface(scene, POINTS, rng), POINT_RADIUS)])) for _, scene in places
    ]


def family_places(folder: Path) -> list[Place]:
    problems = [entry.problem for entry in load_motion_bench_maker(folder)]
    return [(p.robot, p.scene) for p in problems if p is not None]


@njit
def check_edges(space: Space, starts: ndarray, ends: ndarray) -> ndarray:
    scratch = make_scratch(space, starts)
    free = np.empty(len(starts), np.bool_)
    for i in range(len(starts)):
        free[i] = motion_free(space, starts[i], ends[i], scratch)
    return free


def random_edges(checker: CollisionChecker, rng: Generator) -> tuple[ndarray, ndarray]:
    """Starts and ends of edges of 1 rad from free configurations in random directions, clipped to the
    limits."""
    robot = checker.robot
    starts = np.zeros((0, checker.robot.dof))
    for _ in range(1000):
        q = rng.uniform(robot.lower, robot.upper, (EDGES, robot.dof))
        starts = np.concatenate([starts, q[checker.free(q)]])
        if len(starts) >= EDGES:
            break
    starts = starts[:EDGES]
    step = rng.normal(size=starts.shape)
    ends = starts + step / np.linalg.norm(step, axis=1, keepdims=True)
    return starts.astype(np.float32), np.clip(ends, robot.lower, robot.upper).astype(np.float32)


def checked_configurations(space: Space, starts: ndarray, ends: ndarray) -> Int[ndarray, "n"]:
    """The number of configurations of each edge that are checked if the edge is free."""
    travel = np.abs(ends - starts) @ space.motion_radii
    return W * np.maximum(np.ceil(travel / space.resolution / W), 1).astype(int)


def fastest(call: Callable[[], object]) -> float:
    """CPU time of the fastest of PASSES calls after a first one, which compiles [s]."""
    call()
    times = []
    for _ in range(PASSES):
        start = time.process_time()
        call()
        times.append(time.process_time() - start)
    return min(times)


def kernel_speed(title: str, places: list[Place]) -> list[str]:
    """A row of the table of speeds, averaged over the scenes: along free edges, all edges, random
    configurations; and the time to prepare a scene."""
    rng = np.random.default_rng(SEED)
    along_ns = []
    random_ns = []
    edge_us = []
    free_fractions = []
    build_seconds = []
    for robot, scene in places[:SCENES]:
        start = time.process_time()
        checker = CollisionChecker(robot, scene)
        build_seconds.append(time.process_time() - start)
        space = search_space(checker, RESOLUTION)
        starts, ends = random_edges(checker, rng)
        if len(starts) < EDGES:
            continue
        free = check_edges(space, starts, ends)
        count = checked_configurations(space, starts, ends)
        seconds = fastest(lambda a=starts[free], b=ends[free], s=space: check_edges(s, a, b))
        along_ns.append(1e9 * seconds / count[free].sum())
        edge_us.append(1e6 * fastest(lambda a=starts, b=ends, s=space: check_edges(s, a, b)) / len(starts))
        free_fractions.append(free.mean())
        q = rng.uniform(robot.lower, robot.upper, (4096, robot.dof)).astype(np.float32)
        random_ns.append(1e9 * fastest(lambda c=checker, q=q: c.free(q)) / len(q))
    if not along_ns:
        return [title, *["-"] * 6]
    figures = [
        np.mean(along_ns),
        np.max(along_ns),
        np.mean(edge_us),
        100 * np.mean(free_fractions),
        np.mean(random_ns),
    ]
    return [
        title,
        *(f"{x:.0f}" if x >= 20 else f"{x:.1f}" for x in figures),
        f"{1e3 * np.median(build_seconds):.1f}",
    ]


def without_pairs(robot: Robot) -> Robot:
    """The robot without checks between links."""
    return replace(robot, allowed_collisions=frozenset(map(frozenset, combinations(robot.link_names, 2))))


def soundness(title: str, places: list[Place], configurations: int) -> tuple[ndarray, list[list[str]]]:
    """Compares covering spheres with meshes at random configurations. Returns counts [3, 4] and their table
    rows. The rows of the counts are collisions with the scene, between links, and both; the columns are the
    configurations that are free on meshes, those of them that spheres refuse, those colliding on meshes, and
    those of them that spheres call free."""
    rng = np.random.default_rng(SEED)
    counts = np.zeros((3, 4), int)
    per_scene = min(CONFIGURATIONS_PER_SCENE, -(-configurations // len(places)))
    rounds = -(-configurations // per_scene)
    for i in progress(range(rounds), title):
        robot, scene = places[i % len(places)]
        q = rng.uniform(robot.lower, robot.upper, (per_scene, robot.dof))
        bare = without_pairs(robot)
        meshes = [ExactCollision(bare, scene).collides(q), ExactCollision(robot, Scene()).collides(q)]
        spheres = [~CollisionChecker(bare, scene).free(q), ~CollisionChecker(robot, Scene()).free(q)]
        collides = ~CollisionChecker(robot, scene).free(q)
        assert (collides == (spheres[0] | spheres[1])).all()
        for k, (mesh, sphere) in enumerate(
            zip([*meshes, meshes[0] | meshes[1]], [*spheres, collides], strict=True)
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


@njit
def place_along(space, starts, ends, counts):
    """Computes the forward kinematics of a check of edges. counts: number of configurations of each edge."""
    work = make_workspace(space.robot)
    block = lanes_array(starts.shape[1], 1)
    for i in range(len(starts)):
        for j in range(starts.shape[1]):
            block[j, :] = np.float32(0.5) * (starts[i, j] + ends[i, j])
        for _ in range(counts[i] // W):
            place_frames(space.robot, block, work.frames, work.centers)
    return work.centers[0, 0]


def free_edges(path: ndarray, space: Space) -> tuple[ndarray, ndarray]:
    """The edges of a path that are free in both directions, repeated."""
    starts = np.concatenate([path[:-1], path[1:]])
    ends = np.concatenate([path[1:], path[:-1]])
    free = check_edges(space, starts, ends)
    free &= np.roll(free, len(path) - 1)
    return np.tile(starts[free], (PATH_REPEATS, 1)), np.tile(ends[free], (PATH_REPEATS, 1))


def along_paths(robot: Robot, families: list[str], each: int) -> None:
    """Print the time that the check of a configuration takes along paths of aorrtc, split into its parts."""
    planner = load_planner("aorrtc")
    rows = []
    rng = np.random.default_rng(SEED)
    bare = search_space(CollisionChecker(robot, Scene()), RESOLUTION)
    for family in families:
        spent = np.zeros(4)
        checked = np.zeros(2)
        for case in draw_hard_cases(family, each):
            path = planner.plan(case.problem, 1.0, until=FIRST, clearance=0.0).path
            if path is None:
                continue
            cloud = PointCloud(sample_surface(case.problem.scene, POINTS, rng), POINT_RADIUS)
            for k, scene in enumerate((case.problem.scene, Scene([cloud]))):
                space = search_space(CollisionChecker(robot, scene), RESOLUTION)
                starts, ends = free_edges(path.positions.astype(np.float32), space)
                if not len(starts):
                    continue
                counts = checked_configurations(space, starts, ends)
                checked[k] += counts.sum()
                spent[2 + k] += fastest(lambda a=starts, b=ends, s=space: check_edges(s, a, b))
                if k == 0:
                    spent[0] += fastest(lambda a=starts, b=ends, n=counts: place_along(bare, a, b, n))
                    spent[1] += fastest(lambda a=starts, b=ends: check_edges(bare, a, b))
        kinematics, itself, total = 1e9 * spent[:3] / max(checked[0], 1)
        cloud_total = 1e9 * spent[3] / max(checked[1], 1)
        nanoseconds = (kinematics, itself - kinematics, total - itself, total, cloud_total)
        rows.append((family, *(f"{ns:.0f}" for ns in nanoseconds)))
    columns = ["family", "kinematics", "self", "scene", "total", f"total, cloud of {POINTS:,}"]
    note = f"ns a configuration, the fastest pass; cloud: on the obstacles, {1e3 * POINT_RADIUS:g} mm"
    print_table("Collision check along free edges of paths", columns, rows, (note,))


def main() -> None:
    parser = argparse.ArgumentParser(description="Speed, soundness and tightness of collision checking.")
    parser.add_argument("--problems", type=Path, help="folder with MotionBenchMaker families")
    parser.add_argument(
        "--configurations",
        type=int,
        default=1_000_000,
        help="number of configurations of the soundness check (1000000)",
    )
    parser.add_argument(
        "--scenes", type=int, default=SCENES, help=f"number of scenes for each speed ({SCENES})"
    )
    parser.add_argument(
        "--each", type=int, default=8, help="number of problems of each family whose paths are checked (8)"
    )
    parser.add_argument(
        "--families", nargs="+", default=list(FAMILIES), help="families whose paths are checked (all)"
    )
    arguments = parse(parser, configurations=200, scenes=1, each=1, families=["rop"])
    robot = load_robot("panda")
    count = arguments.scenes
    print(header("numpy", "numba", "coal"))
    sizes = sum(map(len, robot.spheres.values()))
    print(f"Panda: {sizes} spheres, {len(CollisionChecker(robot, Scene()).pairs)} checked pairs of links")

    families = sorted(arguments.problems.iterdir()) if arguments.problems else []
    published = {path.name.removesuffix("_panda"): family_places(path) for path in families if path.is_dir()}
    places = {
        "ROP, 2 obstacles + floor": rop_places(robot, False, count),
        "ROP dense, 3 to 12 + floor": rop_places(robot, True, count),
        **{name: scenes[:count] for name, scenes in published.items()},
        f"ROP dense, cloud of {POINTS:,}": cloud_places(robot, min(5, count)),
    }
    columns = ["", "ns, free edges", "worst scene", "us per edge", "edges free %", "ns, random q", "build ms"]
    print_table(
        f"Kernel, self-collision included, one core; edges of 1 rad checked every {1e3 * RESOLUTION:.0f} mm "
        "(per configuration; per edge: free or not)",
        columns,
        [kernel_speed(title, scenes) for title, scenes in places.items()],
    )
    along_paths(robot, arguments.families, arguments.each)

    sampled = {"ROP": rop_places(robot, False, 500), "ROP dense": rop_places(robot, True, 500), **published}
    total = np.zeros((3, 4), int)
    rows = []
    for title, scenes in sampled.items():
        counts, family = soundness(title, scenes, -(-arguments.configurations // len(sampled)))
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
