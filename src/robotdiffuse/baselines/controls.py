"""Controls: candidate motions that come neither from a network nor from a search, such as the straight line
in joint space. Every learned result is compared with them."""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from itertools import islice
from pathlib import Path as FilePath
from typing import Annotated

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.core.errors import InputError, counted
from robotdiffuse.core.settings import Count, Natural, OneOf, Settings
from robotdiffuse.core.types import Configuration, Configurations, Path, PlanResult
from robotdiffuse.datasets.shards import SPLITS, read_manifest, read_rows
from robotdiffuse.learning.guidance import CollisionGuidance, Trajectories
from robotdiffuse.learning.weight_files import stamp
from robotdiffuse.planning.context import PlanningContext
from robotdiffuse.planning.learned import nearest_goals
from robotdiffuse.planning.planner import Planner
from robotdiffuse.planning.start_goal import StartGoal
from robotdiffuse.robots.robot import Robot

NEAREST_GOAL = "nearest"
ANY = "any"


@dataclass(frozen=True)
class StraightLineSettings(Settings, name="straight_line"):
    goals: Annotated[str, OneOf((NEAREST_GOAL, ANY))] = ANY
    """Goal configurations that are tried: only the nearest one, or all of them, the nearest first."""


def shortest_accepted(
    context: PlanningContext, start_goal: StartGoal, candidates: Iterable[Configurations], stage: str
) -> PlanResult | None:
    """The result of the shortest candidate that the validator accepts; None if it accepts none in time."""
    names = context.problem.robot.joint_names
    paths = [Path(names, start_goal.complete(q)) for q in candidates]
    for path in sorted(paths, key=lambda path: path.length):
        result = context.finish(path.positions, stage)
        if result is not None or context.ended:
            return result
    return None


def straight_lines(start_goal: StartGoal) -> ndarray:
    """The straight lines from the start to the goals [goals, 2, dof]."""
    start, goals = start_goal.leads()
    return np.stack([np.broadcast_to(start, goals.shape), goals], axis=1)


class StraightLine(Planner[StraightLineSettings]):
    """Returns the shortest straight line from the start to a goal configuration that passes the validator."""

    name = "straight_line"
    settings_class = StraightLineSettings

    def solve(self, context: PlanningContext, start_goal: StartGoal) -> PlanResult:
        """See `planning.planner.Planner`."""
        lines = straight_lines(start_goal)
        if self.settings.goals == NEAREST_GOAL:
            lines = lines[[np.linalg.norm(lines[:, 1] - lines[:, 0], axis=1).argmin()]]
        subject = "line is" if len(lines) == 1 else f"lines to {len(lines)} goal configurations are"
        result = shortest_accepted(context, start_goal, lines, self.name)
        return result or context.unsolved(f"the straight {subject} refused")


# values of `ControlSettings.source`
VIAS = "vias"
NEAREST = "nearest_motions"
NOISE = "smooth_noise"
LIBRARY_SHARDS = 10
"""Number of shards of a data set from which the nearest motions are taken: a few thousand motions."""
WAYPOINTS = 48
"""Number of waypoints of a candidate, as in the networks' motions."""
SPREAD = 0.127
"""Standard deviation of smooth noise, as a fraction of half the range of a joint. The Panda's bundled network
has noise of this standard deviation, averaged over the joints."""
MAX_HALF_RANGE = np.pi
"""Upper bound on half the range of a joint in `smooth_noise` [rad], for continuous joints, which have no
limits."""
WAVES = 8
"""Number of sines that are summed; all further sines would add 0.2 % to the variance."""
VARIANCE_EXPONENT = 3.5
"""The variance of the sine with k half waves is proportional to k to the power of minus this."""
EQUAL_TIME_STEPS = 110
"""Number of gradient steps on 16 candidates that takes about as long as six guided denoising steps of 16
samples."""


@dataclass(frozen=True)
class ControlSettings(Settings, name="control"):
    source: Annotated[str, OneOf((VIAS, NEAREST, NOISE))] = NOISE
    """How candidates are made: by fixed via configurations (`vias`), which only the Panda has; from the
    motions of a data set with the nearest starts and goals, bent to start and goal (`nearest_motions`); or by
    smooth noise added to the straight line (`smooth_noise`)."""
    samples: Count = 16
    """Number of candidates."""
    guidance_steps: Natural = EQUAL_TIME_STEPS
    """Number of gradient steps of collision guidance on the candidates."""
    data: str | None = None
    """Folder of the data set from which the nearest motions are taken."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if (self.source == NEAREST) != (self.data is not None):
            raise InputError(
                f"source is {self.source} and data is {self.data}; {NEAREST} needs data, and other sources "
                "take none"
            )
        if self.data is not None:
            read_manifest(self.data)


class Control(Planner[ControlSettings]):
    """The straight line, then the shortest candidate that passes the validator."""

    name = "control"
    settings_class = ControlSettings

    def prepare(self, robot: Robot) -> None:
        """Read the vias or motions."""
        if self.settings.source == VIAS:
            fixed_vias(robot)
        if self.settings.data is not None:
            library(self.settings.data, robot)

    def candidates(
        self, start: Configuration, goals: Configurations, checker: CollisionChecker, rng: np.random.Generator
    ) -> Trajectories:
        """Candidate motions from the start, after guidance. Those with smooth noise lead to the nearest
        goals, all others to the nearest goal. Motions through vias are in the order of the vias, the most
        useful first."""
        settings = self.settings
        goals = nearest_goals(start, goals, settings.samples)
        robot = checker.robot
        if settings.source == NOISE:
            q = smooth_noise(start, goals, settings.samples, WAYPOINTS, robot, rng)
        elif settings.source == VIAS:
            vias = fixed_vias(robot)[: settings.samples]
            segments = [np.linspace(*ends, WAYPOINTS // 2) for ends in ((start, vias), (vias, goals[:1]))]
            q = np.concatenate(np.broadcast_arrays(*segments)).swapaxes(0, 1)
        else:
            assert settings.data is not None
            q = bent(library(settings.data, robot), start, goals[0], settings.samples)
            q = np.clip(q, robot.lower, robot.upper)
        steps = settings.guidance_steps
        return CollisionGuidance(checker)(q.astype(np.float32), steps) if steps else q

    def solve(self, context: PlanningContext, start_goal: StartGoal) -> PlanResult:
        """See `planning.planner.Planner`."""
        result = shortest_accepted(context, start_goal, straight_lines(start_goal), self.settings.source)
        if result is not None:
            return result
        candidates = self.candidates(*start_goal.leads(), start_goal.checker, context.rng)
        result = shortest_accepted(context, start_goal, candidates, self.settings.source)
        return result or context.unsolved(
            f"the straight line and {counted(len(candidates), 'candidate')} are refused"
        )


def smooth_noise(
    start: Configuration,
    goals: Configurations,
    count: int,
    waypoints: int,
    robot: Robot,
    rng: np.random.Generator,
) -> Trajectories:
    """Straight lines from the start to the goals in turn, plus smooth noise; float32.

    The noise imitates that of the Panda's bundled model, which has the covariance of the training
    trajectories about the straight lines from start to goal. The eigenvectors of this covariance are nearly
    sines of k half waves, its eigenvalues are proportional to k^-3.5, and its standard deviation is an eighth
    of half the range of a joint. With these numbers, the noise can be computed for any arm. All waypoints
    except start and goal are clipped to the joint limits.
    """
    t = np.linspace(0.0, 1.0, waypoints)
    waves = np.arange(1, WAVES + 1)
    deviations = waves ** (-VARIANCE_EXPONENT / 2)
    deviations *= SPREAD * np.sqrt(2) / np.linalg.norm(deviations)  # a sine's mean square is a half
    basis = np.sin(np.pi * t[:, None] * waves) * deviations
    half = np.minimum(0.5 * (robot.upper - robot.lower), MAX_HALF_RANGE)
    lines = start + t[:, None] * (goals[np.arange(count) % len(goals), None] - start)
    q = lines + half * (basis @ rng.normal(size=(count, WAVES, len(start))))
    q = np.clip(q, robot.lower, robot.upper).astype(np.float32)
    q[:, 0] = lines[:, 0]
    q[:, -1] = lines[:, -1]
    return q


@lru_cache
def fixed_vias(robot: Robot) -> Configurations:
    """The via configurations of the Panda [n, dof], the most useful first. Raises InputError for another
    robot."""
    vias = np.loadtxt(FilePath(__file__).with_name("panda_vias.csv"), delimiter=",")
    if robot.name != "panda" or robot.dof != vias.shape[1]:
        about = f"source is {VIAS} and the robot {robot.name} with {counted(robot.dof, 'planned joint')}"
        raise InputError(f"{about}; only the panda has fixed vias, for {vias.shape[1]} planned joints")
    return vias


def library(data: str, robot: Robot) -> Trajectories:
    """Motions of the training split from the first shards of a data set. Trivial motions, whose straight line
    from start to goal is free, are left out. They are read again if the data set was made anew."""
    folder = FilePath(data).absolute()
    return _library(folder, stamp(folder, "manifest"), robot)


@lru_cache(maxsize=2)
def _library(data: FilePath, _stamp: object, robot: Robot) -> Trajectories:
    rows = islice(read_rows(data, robot, WAYPOINTS), LIBRARY_SHARDS)
    train = SPLITS.index("train")
    return np.concatenate([part.q[(part.split == train) & ~part.shard["line_free"]] for part in rows])


def bent(
    motions: Float[ndarray, "n waypoints dof"], start: Configuration, goal: Configuration, count: int
) -> Trajectories:
    """The `count` motions, forwards or backwards, that begin and end nearest to start and goal; the nearest
    first. Each motion is bent to begin at the start and end at the goal: the offsets of its first row from
    the start and of its last row from the goal are interpolated linearly along the motion and subtracted."""
    both_directions = np.concatenate([motions, motions[:, ::-1]])
    distance = np.square(both_directions[:, [0, -1]] - np.stack([start, goal])).sum(axis=(1, 2))
    nearest = both_directions[np.argsort(distance)[:count]]
    share = np.linspace(0.0, 1.0, nearest.shape[1])[:, None]
    return nearest + (1 - share) * (start - nearest[:, :1]) + share * (goal - nearest[:, -1:])
