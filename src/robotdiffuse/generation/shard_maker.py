"""Making one shard: draws and solves problems until it is full. It depends on the settings and its number
alone."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float32
from numpy import ndarray

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.collision.kernels.compiled import random_state
from robotdiffuse.collision.kernels.motions import motions_free
from robotdiffuse.collision.motions import search_space
from robotdiffuse.core.errors import InputError
from robotdiffuse.core.types import Path
from robotdiffuse.datasets.motion_rows import Row, row_of
from robotdiffuse.datasets.rows import resample
from robotdiffuse.generation.aorrtc_solver import AORRTCSearch
from robotdiffuse.generation.settings import GenerationSettings
from robotdiffuse.generation.solvers import SEARCHES
from robotdiffuse.planning.search.shared_tree import SharedTreeSearch
from robotdiffuse.problems.families.family import SampledProblem
from robotdiffuse.robots import load_robot
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene_arrays import PackedScenes
from robotdiffuse.trajectories.timing import time_parameterize
from robotdiffuse.validation.validator import Verifier, VerifySettings

MAX_PROBLEMS_PER_ROW, EXTRA_PROBLEMS = 50, 1_000
"""A shard is given up after so many problems for each row, and as many extra ones."""
PROBLEMS_PER_SHARD = 2**32
"""Problem numbers reserved for each shard, so that shards share none."""

Arrays = dict[str, ndarray]
Counts = dict[str, int]


def make_shard(settings: GenerationSettings, index: int) -> tuple[Arrays, Counts]:
    """Arrays and counts of a shard in the form of `datasets.shards`.

    Counts are of problems: `tried` of all; `solved` are in the shard; `thinned` are trivial and left out; for
    `unsolved` the search found no path; the validator rejected the motions of `refused`. Raises InputError if
    hardly any problem can be solved.
    """
    robot, rows = load_robot(settings.robot), settings.rows(index)
    kept: list[Row] = []
    counts: Counts = dict.fromkeys(("tried", "solved", "thinned", "unsolved", "refused"), 0)
    while len(kept) < rows:
        if counts["tried"] >= MAX_PROBLEMS_PER_ROW * rows + EXTRA_PROBLEMS:
            raise InputError(
                f"only {len(kept)} of {counts['tried']} problems were solved for {robot.name}; a smaller "
                f"safety_distance than {settings.search.safety_distance} m or other scenes may help"
            )
        number = index * PROBLEMS_PER_SHARD + counts["tried"]
        counts["tried"] += 1
        row = solve(settings, robot, number)
        if isinstance(row, str):
            counts[row] += 1
        else:
            kept.append(row)
            counts["solved"] += 1
    return {name: np.stack([row[name] for row in kept]) for name in kept[0]}, counts


def solve(settings: GenerationSettings, robot: Robot, number: int) -> Row | str:
    """Solve the problem of a number: its row, or thinned, unsolved or refused."""
    rng = np.random.default_rng([settings.seed, number])
    family, drawn = draw(settings, robot, rng)
    drawn = with_near_goals(robot, drawn)
    checker = CollisionChecker(robot, drawn.scene)
    lines_free = [_line_is_free(settings, checker, drawn.start, goal) for goal in drawn.goals]
    thinned = rng.random() >= settings.trivial_share
    if thinned and all(lines_free):
        return "thinned"  # for whichever goal a search chooses
    search: SharedTreeSearch | AORRTCSearch = SEARCHES.load(settings.planner)(
        checker, drawn.start, drawn.goals, settings.search, random_state(settings.seed, number)
    )
    search.run()
    path = search.path()
    if path is None:
        return "unsolved"
    goal, line_free = search.goals[search.best_goal], lines_free[search.best_goal]
    if thinned and line_free:
        return "thinned"
    validator = Verifier(drawn.problem(robot), VerifySettings())
    motion = _resampled(settings, robot, path, validator)
    if motion is None:
        return "refused"
    times, q = motion
    q[0], q[-1] = drawn.start, goal
    if not validator.path(Path(robot.joint_names, q.astype(np.float64))).valid:
        return "refused"
    floor = list(settings.families.values())[family].floor
    return row_of(
        PackedScenes.pack([drawn.scene], settings.slots, floor is not None),
        q,
        checker.link_clearances(q).min(axis=1),
        search.goals,
        search.goal_costs,
        search.best_goal,
        drawn.T_base_tip,
        family,
        search.cost,
        search.safety_distance,
        line_free,
        number,
        settings.goals,
        times if settings.timing == "time" else None,
    )


def draw(settings: GenerationSettings, robot: Robot, rng: np.random.Generator) -> tuple[int, SampledProblem]:
    """A random problem and the number of its family in the mix; it depends on the state of `rng` alone."""
    shares = np.array(list(settings.mix.values()))
    number = int(rng.choice(len(shares), p=shares / shares.sum()))
    family = list(settings.families.values())[number]
    return number, family.draw(robot, rng, settings.goals, settings.target)


def with_near_goals(robot: Robot, drawn: SampledProblem) -> SampledProblem:
    """The problem with the goals of continuous joints moved by whole turns as near to the start as
    possible."""
    return replace(
        drawn, goals=np.stack([robot.equivalent_configurations(q, drawn.start)[0] for q in drawn.goals])
    )


def _line_is_free(
    settings: GenerationSettings, checker: CollisionChecker, start: ndarray, goal: ndarray
) -> bool:
    space = search_space(checker, settings.search.resolution)
    return bool(motions_free(space, np.stack([start, goal]))[0])


def _resampled(
    settings: GenerationSettings, robot: Robot, path: Float32[ndarray, "n dof"], validator: Verifier
) -> tuple[ndarray, Float32[ndarray, "waypoints dof"]] | None:
    """Times and joint values of the waypoints; None if the validator rejects the timed motion."""
    if settings.timing == "arc":
        return np.zeros(0), resample(path[None], settings.waypoints, exact=True)[0]
    waypoints = Path(robot.joint_names, path.astype(np.float64))
    if not validator.path(waypoints).valid:
        return None
    timed = time_parameterize(
        robot, waypoints, lambda motion: validator.trajectory(motion).valid, validator.collision_free
    )
    if not validator.trajectory(timed).valid:
        return None
    times = np.linspace(0.0, timed.duration, settings.waypoints)
    rows = [np.interp(times, timed.times, timed.positions[:, j]) for j in range(robot.dof)]
    return times, np.stack(rows, axis=1).astype(np.float32)
