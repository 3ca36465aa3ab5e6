"""One shard of the data: problems drawn and solved until it is full; it depends on settings and number."""

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
from robotdiffuse.datasets.rows import resample
from robotdiffuse.datasets.shards import Row, row_of
from robotdiffuse.generation.aorrtc_solver import AORRTCSearch
from robotdiffuse.generation.settings import GenerationSettings
from robotdiffuse.generation.solvers import SEARCHES
from robotdiffuse.planning.search.shared_tree.planner import SharedTreeSearch
from robotdiffuse.problems.families.family import SampledProblem
from robotdiffuse.robots import load_robot
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene_arrays import PackedScenes
from robotdiffuse.trajectories.timing import time_parameterize
from robotdiffuse.validation.validator import Verifier, VerifySettings

TRIES = 50
"""Problems drawn for each row, and GRACE more, before the settings are called hopeless."""
GRACE = 1_000
NUMBERS = 2**32
"""Problem numbers of a shard; shards do not share any."""

Arrays = dict[str, ndarray]
Counts = dict[str, int]


def make_shard(settings: GenerationSettings, index: int) -> tuple[Arrays, Counts]:
    """Arrays and counts of a shard, as `datasets.shards` keeps them.

    Counts: `tried` problems; of those `solved` ones are in the shard, `thinned` ones are trivial and left
    out, of `unsolved` ones the search found no path, and `refused` ones did not pass the validator. Raises
    InputError if hardly any problem can be solved.
    """
    robot, rows = load_robot(settings.robot), settings.rows(index)
    kept: list[Row] = []
    counts: Counts = dict.fromkeys(("tried", "solved", "thinned", "unsolved", "refused"), 0)
    while len(kept) < rows:
        if counts["tried"] >= TRIES * rows + GRACE:
            raise InputError(
                f"only {len(kept)} of {counts['tried']} problems were solved for {robot.name}; a smaller "
                f"safety_distance than {settings.search.safety_distance} m or other scenes may help"
            )
        number = index * NUMBERS + counts["tried"]
        counts["tried"] += 1
        row = solve(settings, robot, number)
        if isinstance(row, str):
            counts[row] += 1
        else:
            kept.append(row)
            counts["solved"] += 1
    return {name: np.stack([row[name] for row in kept]) for name in kept[0]}, counts


def solve(settings: GenerationSettings, robot: Robot, number: int) -> Row | str:
    """The row of a problem by its number, or why there is none: thinned, unsolved or refused."""
    rng = np.random.default_rng([settings.seed, number])
    family, drawn = draw(settings, robot, rng)
    drawn = with_near_goals(robot, drawn)
    checker = CollisionChecker(robot, drawn.scene)
    lines_free = [_line_is_free(settings, checker, drawn.start, goal) for goal in drawn.goals]
    thinned = rng.random() >= settings.trivial_share
    if thinned and all(lines_free):
        return "thinned"  # whichever goal a search would choose
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
    motion = _frames(settings, robot, path, validator)
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
    """A random problem, and the number of its family in the mix; the same state of `rng` gives the same."""
    shares = np.array(list(settings.mix.values()))
    number = int(rng.choice(len(shares), p=shares / shares.sum()))
    family = list(settings.families.values())[number]
    return number, family.draw(robot, rng, settings.goals, settings.target)


def with_near_goals(robot: Robot, drawn: SampledProblem) -> SampledProblem:
    """The problem with goals of joints that turn more than once as near to the start as whole turns allow."""
    return replace(drawn, goals=np.stack([robot.same_stance(q, drawn.start)[0] for q in drawn.goals]))


def _line_is_free(
    settings: GenerationSettings, checker: CollisionChecker, start: ndarray, goal: ndarray
) -> bool:
    space = search_space(checker, settings.search.resolution)
    return bool(motions_free(space, np.stack([start, goal]))[0])


def _frames(
    settings: GenerationSettings, robot: Robot, path: Float32[ndarray, "n dof"], validator: Verifier
) -> tuple[ndarray, Float32[ndarray, "waypoints dof"]] | None:
    """Times and joint values of the waypoints; None if the timed motion does not pass the validator."""
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
