"""Inverse kinematics: several distinct configurations for a pose of a link."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from numbers import Integral

import numpy as np
from jaxtyping import Int
from numpy import ndarray

from robotdiffuse.core.errors import InputError, rigid_transform, shown
from robotdiffuse.core.settings import Count, Settings
from robotdiffuse.core.types import Configuration, Configurations, Mask, Pose, for_kernels, nearest_first
from robotdiffuse.robots.ik_kernel import CONTINUOUS, PRISMATIC, REVOLUTE, IKChain, IKParameters, solve_seeds
from robotdiffuse.robots.kinematic_tree import JointMask, KinematicTree

KINDS = {"revolute": REVOLUTE, "prismatic": PRISMATIC, "continuous": CONTINUOUS}


POSITION_TOLERANCE = 1e-6
"""Largest position error of a solution [m]."""
ROTATION_TOLERANCE = 1e-6
"""Largest orientation error of a solution [rad]."""
MIN_DISTANCE = 0.1
"""Two solutions count as distinct if they differ by more than this in at least one joint [rad or m]."""
LIMIT_MARGIN = 1e-6
"""Distance kept from the joint limits [rad or m]."""
MAX_ITERATIONS = 60
"""Largest number of damped Newton steps from each seed."""
ROTATION_WEIGHT = 0.3
"""Weight of orientation errors: an error of 1 rad counts like a position error of this length [m/rad]."""
PARAMETERS = IKParameters(
    False, ROTATION_WEIGHT, POSITION_TOLERANCE, ROTATION_TOLERANCE, MAX_ITERATIONS, MIN_DISTANCE
)


@dataclass(frozen=True)
class InverseKinematicsSettings(Settings, name="inverse kinematics"):
    """Effort of `inverse_kinematics`."""

    position_only: bool = False
    """Ignore the orientation of the pose, as in the paper's ROP problems."""
    seeds_per_round: Count = 64
    """Number of random start configurations drawn in each round."""
    max_rounds: Count = 64
    """Largest number of rounds."""
    patience: Count = 4
    """Once a solution is found, the search ends after this many consecutive rounds without a new one."""


def inverse_kinematics(
    robot: KinematicTree,
    frame: str,
    T_base_frame: Pose,
    count: int = 10,
    *,
    rng: np.random.Generator,
    accept: Callable[[Configurations], Mask] | None = None,
    settings: InverseKinematicsSettings | None = None,
    near: Configuration | None = None,
    rest: Configuration | None = None,
) -> Configurations:
    """Up to `count` distinct configurations that bring link `frame` to the pose, inside the joint limits.

    Damped Newton steps (Levenberg-Marquardt) start from random seeds (see `random_seeds`). Steps are clipped
    to the limits, and joints pushed against a limit are held while the other joints move. Joints after the
    link keep the random values of the seed. The result depends only on the arguments and the state of `rng`.

    Args:
        robot: The robot.
        frame: Name of the link.
        T_base_frame: Pose that the link shall reach [m].
        count: Largest number of configurations.
        rng: Source of the seeds.
        accept: Called with batches of solutions; returns a mask of the solutions to keep, e.g. those free of
            collision. Further solutions need not differ from rejected ones.
        settings: Whether the orientation of the pose must be reached, and the effort.
        near: A configuration that is the first seed, so that a slightly moved pose has a slightly moved first
            solution. Results are sorted by their distance from it. Joints that can turn more than once are
            turned by whole turns to be as close to it as possible.
        rest: A configuration, from which joints of other arms take their values: joints that neither move
            the link nor come after it. None: random values.

    Returns:
        Configurations, one per row; no rows if the pose was not reached, or `accept` kept no solution.

    Raises:
        InputError: For an unknown link, a link that no planned joint moves, a count below 1, or a matrix that
            is not a finite rigid transform.
    """
    settings = settings or InverseKinematicsSettings()
    if not isinstance(count, Integral) or count < 1:
        raise InputError(f"inverse kinematics: count is {shown(count)}; it must be an integer of at least 1")
    target = rigid_transform("inverse kinematics: T_base_frame", T_base_frame)
    arm, chain = ik_chain(robot, frame, LIMIT_MARGIN)
    accepted = np.zeros((0, robot.dof))
    if _out_of_reach(chain, target):
        return accepted
    lower, upper = robot.narrowed_limits(LIMIT_MARGIN)
    parameters = PARAMETERS._replace(position_only=settings.position_only)
    stale_rounds = 0
    for i in range(settings.max_rounds):
        seeds = random_seeds(robot, lower, upper, settings.seeds_per_round, rng, near)
        if i == 0 and near is not None:
            seeds[0] = np.clip(near - robot.whole_turns(near), lower, upper)
        seeds = np.ascontiguousarray(seeds[:, arm])
        before = len(accepted)
        while len(seeds) and len(accepted) < count:
            accepted_arm = np.ascontiguousarray(accepted[:, arm])
            missing = min(count - len(accepted), len(seeds))
            new, used = solve_seeds(seeds, accepted_arm, missing, chain, target, parameters)
            seeds = seeds[used:]
            if len(arm) < robot.dof:
                new_arm = new
                shape = (len(new), robot.dof)
                new = rng.uniform(lower, upper, shape) if rest is None else np.tile(rest, (len(new), 1))
                new[:, arm] = new_arm
            if len(new):
                accepted = np.concatenate([accepted, new if accept is None else new[accept(new)]])
        stale_rounds = 0 if len(accepted) > before else stale_rounds + 1
        if len(accepted) >= count or (len(accepted) and stale_rounds >= settings.patience):
            break
    if near is None:
        return accepted
    return nearest_first(robot.nearest_turns(accepted, near), near)


def each_pose(
    robot: KinematicTree,
    frame: str,
    poses: Iterable[Pose],
    count: int,
    seeds: Configurations,
    rest: Configuration,
) -> Iterator[Configurations]:
    """Up to `count` distinct configurations for each of several poses of a link. Each pose is solved from the
    same seeds; joints of another arm have the values of `rest`."""
    arm, chain = ik_chain(robot, frame, LIMIT_MARGIN)
    seeds = np.clip(np.ascontiguousarray(seeds[:, arm]), chain.lower, chain.upper)
    for T in poses:
        solutions = seeds[:0]
        if not _out_of_reach(chain, T):
            solutions = solve_seeds(seeds, solutions, count, chain, for_kernels(T), PARAMETERS)[0]
        q = np.tile(rest, (len(solutions), 1))
        q[:, arm] = solutions
        yield q


def _out_of_reach(chain: IKChain, target: Pose) -> bool:
    """Whether a pose is farther from the first joint than the length of the stretched chain."""
    joints = chain.length
    travel = np.maximum(abs(chain.lower), abs(chain.upper))[chain.kinds == PRISMATIC].sum()
    reach = np.linalg.norm(chain.offsets[1:joints, :3, 3], axis=1).sum() + np.linalg.norm(chain.tool[:3, 3])
    distance = np.linalg.norm(target[:3, 3] - chain.offsets[0, :3, 3])
    return bool(distance > reach + travel + POSITION_TOLERANCE)


def ik_chain(robot: KinematicTree, frame: str, limit_margin: float) -> tuple[Int[ndarray, "k"], IKChain]:
    """Indices of the planned joints that move a link or come after it, and the chain of these joints with
    limits narrowed by a margin [rad] or [m]. Raises InputError for an unknown link, and for a link that no
    planned joint moves."""
    if robot.link_frame(frame) == 0:
        raise InputError(f"inverse kinematics: no planned joint moves the link {shown(frame)}")
    arm = np.flatnonzero(~on_other_arm(robot, frame))
    kinds = np.array([KINDS[joint.kind] for joint in robot.planned_joints])[arm]
    lower, upper = (limits[arm] for limits in robot.narrowed_limits(limit_margin))
    tool = for_kernels(robot.T_frame_link(frame))
    return arm, IKChain(robot.frame_offsets[arm], tool, kinds, len(robot.chain(frame)), lower, upper)


def random_seeds(
    robot: KinematicTree,
    lower: Configuration,
    upper: Configuration,
    count: int,
    rng: np.random.Generator,
    near: Configuration | None = None,
) -> Configurations:
    """Uniformly random configurations.

    With `near`, they are random points on straight lines from `near` to random configurations. Each rotating
    joint of these configurations is within half a turn of `near`.
    """
    if near is None:
        return rng.uniform(lower, upper, (count, robot.dof))
    reach = np.where(robot.prismatic, np.inf, np.pi)
    near = np.clip(near - robot.whole_turns(near), lower, upper)
    anywhere = rng.uniform(
        np.maximum(lower, near - reach), np.minimum(upper, near + reach), (count, robot.dof)
    )
    return near + rng.uniform(0.0, 1.0, (count, 1)) * (anywhere - near)


def on_other_arm(robot: KinematicTree, link: str) -> JointMask:
    """Mask of the planned joints of other arms: joints that neither move a link nor come after it."""
    frame = robot.link_frame(link)
    downstream = robot.moved_by[1:, frame - 1] if frame else np.ones(robot.dof, bool)
    return ~(robot.moved_by[frame] | downstream)
