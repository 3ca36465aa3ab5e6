"""The checker's own kinematics in NumPy: poses of links, and bounds on their displacement.

It uses only a robot's joints, and nothing that planners or the validator derive from them.
"""

from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from robotdiffuse.core.types import (
    Configurations,
    JointRows,
    JointValues,
    Path,
    Points,
    Rotation,
    Trajectory,
    Values,
    Vector,
)
from robotdiffuse.robots.kinematic_tree import Joint
from robotdiffuse.robots.robot import Robot


class Postures(NamedTuple):
    """A robot at n configurations, in the base frame."""

    T: Float[ndarray, "n links 4 4"]
    """Poses of `Linkage.links`."""
    origins: Float[ndarray, "n dof 3"]
    """A point on the axis of each planned joint [m]."""
    axes: Float[ndarray, "n dof 3"]
    """Unit direction of each planned joint's axis."""


class Linkage:
    """The joints and links of a robot."""

    def __init__(self, robot: Robot) -> None:
        self.robot = robot
        self.links = (robot.base, *(joint.child for joint in robot.joints))
        self.slides = np.array([joint.kind == "prismatic" for joint in robot.planned_joints], bool)
        self._planned = {joint.name: j for j, joint in enumerate(robot.planned_joints)}

    @cached_property
    def moved(self) -> Bool[ndarray, "links dof"]:
        """Which planned joints move each link."""
        moved = {self.robot.base: np.zeros(len(self._planned), bool)}
        for joint in self.robot.joints:
            moved[joint.child] = moved[joint.parent].copy()
            if joint.name in self._planned:
                moved[joint.child][self._planned[joint.name]] = True
        return np.stack([moved[link] for link in self.links])

    def place(self, q: Configurations, link: str | None = None) -> Postures:
        """Poses at configurations. With `link`, only the links between the base and that link; the rest is
        0."""
        n, dof = q.shape
        T = np.zeros((n, len(self.links), 4, 4))
        T[:, :, 3, 3] = 1.0
        origins = np.zeros((n, dof, 3))
        axes = np.zeros((n, dof, 3))
        at = {self.robot.base: (np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3)))}
        for joint in self.robot.joints if link is None else self._up_to(link):
            R, p = at[joint.parent]
            turn = joint.T_parent_joint[:3, :3]
            p = p + R @ joint.T_parent_joint[:3, 3]
            j = self._planned.get(joint.name)
            axis = R @ (turn @ joint.axis)
            value = np.full((n, 1), self.robot.locked.get(joint.name, 0.0)) if j is None else q[:, j, None]
            if j is not None:
                origins[:, j] = p
                axes[:, j] = axis
            if joint.kind in ("fixed", "prismatic"):
                R = _times(R, turn)
                p = p + value * axis * (joint.kind == "prismatic")
            else:
                K = cross_matrix(joint.axis)  # for Rodrigues' formula
                angle = value[:, None]
                R = (
                    _times(R, turn)
                    + np.sin(angle) * _times(R, turn @ K)
                    + (1 - np.cos(angle)) * _times(R, turn @ K @ K)
                )
            at[joint.child] = R, p
        for k, name in enumerate(self.links):
            if name in at:
                T[:, k, :3, :3], T[:, k, :3, 3] = at[name]
        return Postures(T, origins, axes)

    def _up_to(self, link: str) -> list[Joint]:
        """Joints from the base to a link, parents first."""
        chain = list[Joint]()
        above = {joint.child: joint for joint in self.robot.joints}
        while link in above:
            chain.append(above[link])
            link = above[link].parent
        return chain[::-1]

    def levers(self, link: str, q: Configurations) -> Float[ndarray, "joints"]:
        """Upper bounds on the distance of a link's origin from the axes of the planned joints that move it,
        in order [m]; 1 for a joint that slides. `q` holds the extreme positions of a motion."""
        bounds = list[float]()
        length = 0.0
        for joint in reversed(self._up_to(link)):
            j = self._planned.get(joint.name)
            if j is not None:
                bounds.append(1.0 if self.slides[j] else length)
            if joint.kind == "prismatic":
                far = self.robot.locked.get(joint.name, 0.0) if j is None else q[:, j]
                length += float(np.abs(far).max())
            length += float(np.linalg.norm(joint.T_parent_joint[:3, 3]))
        return np.array(bounds[::-1])

    def rates(
        self, postures: Postures, link: str
    ) -> tuple[Int[ndarray, "joints"], Float[ndarray, "n joints 3"]]:
        """The planned joints that move a link, and the derivatives of its origin by each of them [m]."""
        k = self.links.index(link)
        joints = np.flatnonzero(self.moved[k])
        arms = postures.T[:, k, None, :3, 3] - postures.origins[:, joints]
        axes = postures.axes[:, joints]
        return joints, np.where(self.slides[joints][:, None], axes, np.cross(axes, arms))

    def displacement(
        self,
        postures: Postures,
        rows: Int[ndarray, "m"],
        centers: Points,
        radii: Values,
        moved: Bool[ndarray, "m dof"],
        spans: JointRows,
    ) -> Values:
        """Upper bound on the displacement of any point of balls [m] when joints move by up to `spans`.

        Balls are given at their places in the postures of `rows`; `moved` marks the joints that move them,
        seen from a body before these joints. Turning the last joint first, joint j moves a ball that later
        joints have displaced by d on a circle of radius at most its distance from the axis plus d, so by at
        most spans_j times that. Axes of earlier joints are still where they are in the posture.
        """
        went = np.zeros(len(rows))
        for j in reversed(range(len(self.slides))):
            arm = 1.0
            if not self.slides[j]:
                across = np.cross(centers - postures.origins[rows, j], postures.axes[rows, j])
                arm = np.sqrt((across**2).sum(axis=1)) + radii + went
            went += np.where(moved[:, j], spans[rows, j] * arm, 0.0)
        return went

    def approach(
        self,
        origins: Float[ndarray, "dof 3"],
        axes: Float[ndarray, "dof 3"],
        points: Points,
        moved_by: Int[ndarray, "joints"],
        steps: JointRows,
        normals: Float[ndarray, "k 3"],
        off: JointValues | float = 0.0,
    ) -> Float[ndarray, "k v"]:
        """Upper bound on the movement of points against unit vectors [m].

        Joints move from their posture to anywhere within `off` of the straight lines through `steps`, which
        are differences from it. Only the joints `moved_by` count, each behind the one before.

        To first order a point's movement along the normal is a linear function of the joints, with its
        minimum at one of the steps, less what `off` adds. The remainder is at most
        sum_k L_k D_k (D_k / 2 + sum_{j<k} D_j), because the second derivative of the point by joints j <= k
        is at most its greatest distance L_k from axis k.
        """
        moving_joints = moved_by.tolist()
        off = np.broadcast_to(off, steps.shape[1])
        spans = np.abs(steps).max(axis=0) + off
        rates = np.cross(axes[moving_joints, None], points[None] - origins[moving_joints, None])
        rates[self.slides[moving_joints]] = axes[moving_joints, None][self.slides[moving_joints]]
        lengths = np.sqrt((rates**2).sum(axis=2))
        along = np.moveaxis(rates @ normals.T, 2, 1).reshape(len(moving_joints), -1)
        towards = off[moving_joints] @ np.abs(along) - (steps[:, moving_joints] @ along).min(axis=0)
        towards = towards.reshape(len(normals), len(points))
        went = np.zeros(len(points))
        rest = np.zeros(len(points))
        for i in reversed(range(len(moving_joints))):
            j = moving_joints[i]
            arm = lengths[i] if self.slides[j] else lengths[i] + went
            went = went + spans[j] * arm
            rest += spans[j] * arm * (spans[j] / 2 + spans[moving_joints[:i]].sum())
        return np.minimum(np.maximum(towards, 0.0) + rest, went)


def _times(R: Float[ndarray, "n 3 3"], right: Float[ndarray, "3 m"]) -> Float[ndarray, "n 3 m"]:
    return (R.reshape(-1, 3) @ right).reshape(len(R), 3, right.shape[1])


def cross_matrix(axis: Vector) -> Rotation:
    """The matrix of the cross product with a vector."""
    x, y, z = axis
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])


class Cubics(NamedTuple):
    """The cubics from each row to the next; their accelerations are linear in time, and 0 for a path."""

    times: Values
    """When each cubic begins [s]."""
    steps: Float[ndarray, "m 1"]
    """Durations of the steps [s]."""
    positions: Configurations
    """At the start of each cubic."""
    velocities: JointRows
    start: JointRows
    """Acceleration at the start of each."""
    end: JointRows

    def at(self, row: Int[ndarray, "n"], time: Values) -> tuple[Configurations, JointRows, JointRows]:
        """Positions, velocities and accelerations of cubics `time` seconds after they begin."""
        t = time[:, None]
        a = self.start[row]
        jerk = (self.end[row] - a) / self.steps[row]
        v = self.velocities[row]
        q = self.positions[row]
        return (
            q + t * (v + t * (a / 2 + t * jerk / 6)),
            v + t * (a + t * jerk / 2),
            a + t * jerk,
        )

    def rows(self, times: Values) -> Int[ndarray, "n"]:
        """The cubic at each time; at a row, the one that begins there."""
        return np.clip(np.searchsorted(self.times, times, side="right") - 1, 0, len(self.times) - 1)

    @property
    def pulls(self) -> JointRows:
        """The greatest absolute acceleration of each."""
        return np.maximum(np.abs(self.start), np.abs(self.end))

    @property
    def jerks(self) -> JointRows:
        """The absolute jerk of each."""
        return np.abs(self.end - self.start) / self.steps

    @property
    def speeds(self) -> JointRows:
        """The greatest absolute velocity of each, which is at an end or where the acceleration is 0."""
        curve = self.end - self.start
        share = np.clip(np.divide(-self.start, curve, out=np.zeros_like(curve), where=curve != 0), 0.0, 1.0)
        extremal = self.velocities + self.steps * share * (self.start + share * curve / 2)
        last = self.velocities + self.steps * (self.start + self.end) / 2
        return np.maximum(np.abs(extremal), np.maximum(np.abs(self.velocities), np.abs(last)))

    @property
    def turns(self) -> Configurations:
        """Positions of each joint where a cubic has its extremes, or elsewhere on it if it has none."""
        v = self.velocities / self.steps
        curve = self.end - self.start
        root = np.sqrt(np.maximum(self.start**2 - 2 * curve * v, 0.0))
        far = -self.start - np.where(self.start < 0, -root, root)
        shares = [
            np.divide(above, below, out=np.zeros_like(above), where=below != 0)
            for above, below in ((2 * v, far), (far, curve))
        ]
        turns = []
        for share in np.clip(shares, 0.0, 1.0):
            t = share * self.steps
            turns.append(self.positions + t * (self.velocities + t * (self.start / 2 + share * curve / 6)))
        return np.concatenate(turns)

    def deviations(self, times: Values) -> JointRows:
        """Upper bounds on how far each joint leaves the straight lines between its positions at these times,
        among which are those of all rows: an eighth of its greatest acceleration times the square of the
        time."""
        row = self.rows(times[:-1])
        max_acceleration = 0.0
        for end in (times[:-1], times[1:]):
            max_acceleration = np.maximum(max_acceleration, np.abs(self.at(row, end - self.times[row])[2]))
        return max_acceleration * np.diff(times)[:, None] ** 2 / 8

    def jumps(self) -> JointRows:
        """By how much the acceleration jumps at each row; before and after the motion it is 0."""
        none = np.zeros_like(self.start[:1])
        return np.abs(np.concatenate([self.start, none]) - np.concatenate([none, self.end]))


def clock(motion: Path | Trajectory) -> Values:
    """The times of a motion's rows; of a path, their numbers."""
    return motion.times if isinstance(motion, Trajectory) else np.arange(len(motion.positions), dtype=float)


def places_of(motion: Path | Trajectory, between: Values) -> Values:
    """The `clock` of the rows, and of places between them, in order."""
    return np.sort(np.concatenate([clock(motion), between]), kind="stable")


def cubics_of(motion: Path | Trajectory) -> Cubics:
    """The cubics of a trajectory whose times increase; the straight lines of a path, whose `clock` counts."""
    times = clock(motion)
    steps = np.diff(times)[:, None]
    q = motion.positions
    mean = np.diff(q, axis=0) / steps
    v, last = (
        (motion.velocities[:-1], motion.velocities[1:]) if isinstance(motion, Trajectory) else (mean, mean)
    )
    start = (6 * (mean - v) - 2 * (last - v)) / steps
    end = (6 * (last - mean) - 2 * (last - v)) / steps
    return Cubics(times[:-1], steps, q[:-1], v, start, end)
