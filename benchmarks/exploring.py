"""Explorer: an arm with a camera at its tip goes to goals through simulated scenes.

    python benchmarks/exploring.py [--problems 28] [--images real] [--walls] [--methods strict ...]
        --records FILE
    python benchmarks/exploring.py --families FOLDER ... --records FILE
    python benchmarks/exploring.py --report --records FILE

Prints benchmarks/results/exploring.txt. Problems are those of benchmarks/cameras.py in whose scene the arm's
pose "ready" is free. A run has two legs: from "ready" to the problem's start, and on to the problem's goal;
the map is kept between them. Settings and the stated confidence were chosen on the first 12 problems of each
of seven families (not `cabinet`); --skip 12 leaves these out.

--images and --walls: see benchmarks/cameras.py. The camera on the arm and the camera beside it have different
pose errors.

A camera beside the arm takes one image at first and one after each motion. The camera on the arm (320 x 240
pixels, 70 x 55 degrees, 0.15 to 2 m) takes one image every 0.25 s of a motion, at most eight. The validator
checks every executed motion in the true scene, and the run ends at a collision. Looks (motions to a
viewpoint) and times are reported per leg; times are CPU times of the Explorer alone.

Baselines: plans from the first image and one at the start of each leg, with unknown space taken as free, or
with predicted occupancy; an Explorer without the network, without the box that is declared free, without the
camera beside the arm, and one whose looks aim at the frontier of known space.
"""

import argparse
import time
from dataclasses import dataclass, replace
from itertools import islice, product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from jaxtyping import Bool
from numpy import ndarray
from numpy.typing import ArrayLike
from scipy.ndimage import binary_dilation

from cameras import (
    IMAGES,
    PLANNER,
    Images,
    add_options,
    is_free,
    known_scene,
    problems,
    unknown_scene,
    views,
    with_walls,
)
from common import header, parse, print_table, progress, use_processor_time
from robotdiffuse.collision import CollisionChecker
from robotdiffuse.collision.exact_meshes import ExactCollision
from robotdiffuse.core.files import JsonLines
from robotdiffuse.core.types import FIRST
from robotdiffuse.core.types import Path as JointPath
from robotdiffuse.evaluation.bench_comparisons import wilson_interval
from robotdiffuse.perception.depth_view import DepthView
from robotdiffuse.perception.occupancy_map import Corners
from robotdiffuse.perception.ray_caster import ray_cast, voxels_within
from robotdiffuse.perception.voxel_grid import FINE, FINE_VOXEL_SIZE, LOW
from robotdiffuse.planning.context import PlanRequest
from robotdiffuse.planning.exploration.explorer import Explorer
from robotdiffuse.planning.exploration.simulated import Event, explore, measured, taken, wrist_camera
from robotdiffuse.planning.exploration.steps import (
    DONE,
    LOOK,
    PROBABILISTIC,
    STRICT,
    STRICT_THEN_PROBABILISTIC,
    ExplorerSettings,
    Step,
)
from robotdiffuse.planning.pipeline.unknown_space import plan_with_unknown_space
from robotdiffuse.problems.families import FAMILIES
from robotdiffuse.problems.problem import OPTIMISTIC, PREDICTED, JointGoal, Problem

Row = dict[str, Any]
TIME_LIMIT = 0.5
"""CPU time of each search [s]."""
ZONE_SIDES = np.arange(0.12, 0.37, 0.04)
"""Candidate distances from the base's axis to the sides of the box that is declared free [m]."""
ZONE_HEIGHT = 0.7
"""Height of this box above the base [m]."""
ONCE = {"unknown is free, once": OPTIMISTIC, "predicted, once": PREDICTED}


@dataclass(frozen=True)
class Method:
    """Settings of an Explorer, and what it knows and sees."""

    policy: str
    predict: bool = True
    free_zone: bool = True
    standing: bool = True
    """Whether a camera stands beside the arm."""
    frontier: bool = False
    """Whether looks aim at the frontier of known space instead of the unknown space that a motion sweeps."""
    see_goal: bool = False
    """Whether cameras must have seen that the goal is free."""


METHODS = {
    "strict": Method(STRICT),
    "strict, goal seen": Method(STRICT, see_goal=True),
    "probabilistic": Method(PROBABILISTIC),
    "strict, then probabilistic": Method(STRICT_THEN_PROBABILISTIC),
    "strict, no network": Method(STRICT, predict=False),
    "probabilistic, no network": Method(PROBABILISTIC, predict=False),
    "strict, frontier looks": Method(STRICT, frontier=True),
    "probabilistic, frontier looks": Method(PROBABILISTIC, frontier=True),
    "strict, no free zone": Method(STRICT, free_zone=False),
    "probabilistic, no free zone": Method(PROBABILISTIC, free_zone=False),
    "strict, no standing camera": Method(STRICT, standing=False),
    "probabilistic, no standing camera": Method(PROBABILISTIC, standing=False),
}
MAX_PROBLEMS = 10_000
"""Largest number of problems of a family that are tried."""
HOME = "ready"
"""Name of the pose that the arm begins in."""


class TimedExplorer(Explorer):
    """Measures the CPU time of the Explorer, without simulating images and validating motions."""

    spent = 0.0
    """CPU time so far [s]."""
    images = Images()
    """Errors that the observed views get."""
    number = 0
    """Number of the problem, which seeds these errors."""

    def observe(self, view: DepthView, stamp: float = 0.0) -> None:
        view = self.images.stated(view, self.number)
        began = time.process_time()
        super().observe(view, stamp)
        self.spent += time.process_time() - began

    def next(self, configuration: ArrayLike) -> Step:
        began = time.process_time()
        step = super().next(configuration)
        self.spent += time.process_time() - began
        return step


class FrontierExplorer(TimedExplorer):
    """Looks at unknown voxels beside free ones, instead of the unknown voxels that a motion sweeps."""

    def wanted(self, path: JointPath) -> Bool[ndarray, "nx ny nz"]:
        return self.map.unknown & binary_dilation(self.map.free)


def play(problem: Problem, family: str, number: int, method: str, images: Images) -> Row:
    """A record of a run of one method on one problem: from the arm's pose "ready" to the start, and on to the
    goal."""
    noise = images.noise
    rng = np.random.default_rng([number, 16])
    camera = wrist_camera(problem.robot)
    known = known_scene(problem)
    legs = [replace(problem, start=HOME, goal=JointGoal(problem.start[None])), problem]
    [beside] = views(legs[0], family, number, 1, None)
    images_so_far = [measured(beside, np.inf, noise, rng)]
    reason = violation = ""
    reached = collided = False
    chosen_method = METHODS.get(method, METHODS["strict"])
    settings = ExplorerSettings(
        policy=chosen_method.policy,
        time_limit=TIME_LIMIT,
        predict=chosen_method.predict,
        see_goal=chosen_method.see_goal,
    )
    zone = free_zone(problem) if chosen_method.free_zone else None
    kind = FrontierExplorer if chosen_method.frontier else TimedExplorer
    explorer = kind(problem.robot, [camera], known, zone, settings)
    explorer.images = images
    explorer.number = number
    spent = list[float]()
    looks = list[int]()
    if method not in ONCE and chosen_method.standing:
        explorer.observe(images_so_far[0])
    for leg in legs:
        explorer.spent = 0.0
        if method in ONCE:
            images_so_far.append(taken(leg, camera, leg.start, noise, rng))
            began = time.process_time()
            stated = [images.stated(view, number) for view in images_so_far]
            partial = Problem(leg.robot, known, leg.start, leg.goal, views=stated, unknown=ONCE[method])
            result = plan_with_unknown_space(PLANNER, partial, PlanRequest(TIME_LIMIT, until=FIRST))
            explorer.spent = time.process_time() - began
            reached = is_free(leg, result)
            reason = result.reason
            collided = result.solved and not reached
            looks.append(0)
        else:
            events = list[Event]()
            for event in explore(leg, explorer, noise, number):
                events.append(event)
                # after each motion, the arm hides another part of the scene from the standing camera
                if chosen_method.standing and event.step.motion is not None:
                    camera_beside = beside.T_base_camera, beside.intrinsics, beside.depth.shape[::-1]
                    seen = ray_cast(leg.scene, *camera_beside, leg.robot, event.configuration)
                    explorer.observe(measured(seen, np.inf, noise, rng))
            reached = events[-1].step.kind == DONE
            collided = not all(event.free for event in events)
            looks.append(sum(event.step.kind == LOOK for event in events))
            reason = events[-1].step.reason
            violation = events[-1].violation
        spent.append(explorer.spent)
        if not reached:
            break
    row: Row = {"reached": reached, "collided": collided, "looks": looks, "times": spent}
    return row | {"reason": reason, "violation": violation}


def free_zone(problem: Problem) -> Corners | None:
    """The largest box around the base without obstacles, as a user who knows the work cell would declare it;
    None if there is none."""
    layers = round((ZONE_HEIGHT - LOW[2]) / FINE_VOXEL_SIZE)
    filled = voxels_within(unknown_scene(problem), FINE)[:, :, :layers]
    columns = np.asarray(filled.any(axis=2))

    def has_obstacle(low: tuple[float, float], high: tuple[float, float]) -> bool:
        first, end = (np.rint((np.array(at) - LOW[:2]) / FINE_VOXEL_SIZE).astype(int) for at in (low, high))
        return bool(columns[first[0] : end[0], first[1] : end[1]].any())

    boxes = [((-a, -c), (b, d)) for a, b, c, d in product(ZONE_SIDES.tolist(), repeat=4)]
    boxes.sort(key=lambda box: -float(np.prod(np.subtract(box[1], box[0]))))
    for low, high in boxes:
        if not has_obstacle(low, high):
            return (*low, 0.0), (*high, ZONE_HEIGHT)
    return None


def usable(problem: Problem, clearance: float) -> bool:
    """Whether the arm's pose "ready" is free in the scene, and the start and all goals have at least this
    clearance to obstacles [m]."""
    home = replace(problem, start=HOME).start
    assert isinstance(problem.goal, JointGoal)
    if not CollisionChecker(problem.robot, problem.scene).free(home[None])[0]:
        return False
    exact = ExactCollision(problem.robot, problem.scene)
    ends = (problem.start, *problem.goal.positions)
    distances = [d for q in ends for d in exact.distances(q) if d.other not in problem.robot.link_names]
    return all(link.distance >= clearance for link in distances)


def run(arguments: argparse.Namespace) -> None:
    """Make the records that are missing."""
    records = JsonLines(Path(arguments.records))
    images = IMAGES[arguments.images]
    place = {"images": arguments.images, "walls": arguments.walls}
    done = {
        (row["family"], row["number"], row["method"]) for row in records.rows if place.items() <= row.items()
    }
    warm = False
    for family in arguments.families:
        drawn = problems(family, MAX_PROBLEMS, set())
        usable_problems = ((number, problem) for number, problem in drawn if usable(problem, arguments.clear))
        end = arguments.skip + arguments.problems // len(arguments.families)
        chosen = list(islice(usable_problems, arguments.skip, end))
        for number, problem in progress(chosen, family):
            for method in arguments.methods:
                if (family, number, method) in done:
                    continue
                problem = with_walls(problem) if arguments.walls else problem
                if not warm:
                    play(problem, family, number, PROBABILISTIC, images)
                    warm = True
                row = play(problem, family, number, method, images)
                records.append({"family": family, "number": number, "method": method, **place, **row})


def report(rows: list[Row]) -> None:
    """Print reached goals, collisions, looks and times of the methods, in a table for each source of problems
    and each kind of image."""
    places = dict.fromkeys((row["images"], row["walls"]) for row in rows)
    for own, (images, walls) in product((True, False), places):
        lines = []
        of_place = [
            row
            for row in rows
            if (row["family"] in FAMILIES, row["images"], row["walls"]) == (own, images, walls)
        ]
        for method in (*ONCE, *METHODS):
            of_method = [row for row in of_place if row["method"] == method]
            if of_method:
                lines.append(line(method, of_method))
        if lines:
            columns = ["method", "problems", "reached, %", "collisions", "looks per leg, mean / p90"]
            source = "Families" if own else "Other problems"
            title = f"{source}, images: {images}, {'a room' if walls else 'no walls'}"
            print_table(title, [*columns, "CPU s per leg, median / p90"], lines)
    print("CPU time is the Explorer's (observe and next), without simulated images and the validation.")


def line(method: str, rows: list[Row]) -> tuple[str | int, ...]:
    """A method's line of the table."""
    reached, collided = (sum(row[name] for row in rows) for name in ("reached", "collided"))
    low, high = wilson_interval(reached, len(rows))
    looks, spent = (np.concatenate([row[name] for row in rows]) for name in ("looks", "times"))
    return (
        method,
        len(rows),
        f"{100 * reached / len(rows):.0f} ({100 * low:.0f} to {100 * high:.0f})",
        collided,
        f"{looks.mean():.2f} / {np.percentile(looks, 90):.0f}",
        f"{np.median(spent):.2f} / {np.percentile(spent, 90):.2f}",
    )


def main() -> None:
    parser = argparse.ArgumentParser(description="An arm explores simulated scenes.")
    add_options(parser, 28, [*ONCE, *METHODS], "exploring.jsonl")
    parser.add_argument(
        "--skip", type=int, default=0, help="number of first problems of each family that are left out (0)"
    )
    parser.add_argument(
        "--clear", type=float, default=0.0, help="smallest clearance of start and goal [m] (0)"
    )
    arguments = parse(parser, problems=1, families=["rop"], methods=["strict"])
    use_processor_time()
    with TemporaryDirectory() as folder:
        if arguments.smoke:
            arguments.records = f"{folder}/records.jsonl"
        if not arguments.report:
            run(arguments)
        print(header("numba", "numpy", "onnxruntime"))
        report(JsonLines(Path(arguments.records)).rows)


if __name__ == "__main__":
    main()
