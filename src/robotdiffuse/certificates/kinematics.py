"""The checker's own kinematics in NumPy: poses of links, and bounds on their displacement.

It uses only a robot's joints, and no arrays that planners or the validator compute from the joints.
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
    Trajectory,
    Values,
)
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

    def place(self, q: Configurations) -> Postures:
        """Poses at configurations."""
        n, dof = q.shape
        origins = np.zeros((n, dof, 3))
        axes = np.zeros((n, dof, 3))
        at = {self.robot.base: np.tile(np.eye(4), (n, 1, 1))}
        for joint in self.robot.joints:
            T_base_joint = at[joint.parent] @ joint.T_parent_joint
            j = self._planned.get(joint.name)
            value = np.full(n, self.robot.locked.get(joint.name, 0.0)) if j is None else q[:, j]
            if j is not None:
                origins[:, j] = T_base_joint[:, :3, 3]
                axes[:, j] = T_base_joint[:, :3, :3] @ joint.axis
            at[joint.child] = T_base_joint @ joint.motion(value)
        return Postures(np.stack([at[link] for link in self.links], axis=1), origins, axes)

    def levers(self, link: str, q: Configurations) -> Values:
        """Upper bounds on the distance of a link's origin from the axis of each planned joint that moves it,
        base first [m]; 1 for a prismatic joint. q: rows that contain the extreme position of each joint."""
        bounds = list[float]()
        length = 0.0
        above = {joint.child: joint for joint in self.robot.joints}
        while link in above:
            joint = above[link]
            link = joint.parent
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
        """The planned joints that move a link, and the derivatives of its origin's position with respect to
        each joint [m/rad] or [m/m]."""
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
        """Upper bound on the displacement of any point of balls [m] if joints move by up to `spans`.

        rows: the posture of each ball, and its row in `spans`. centers, radii: each ball at its place in this
        posture. moved: the joints that count for each ball.

        Joints are moved one after the other, the last joint first, so the axes of earlier joints are still at
        their places in the posture. When joint j moves, later joints have displaced a point by at most d. So
        the point moves on a circle with a radius of at most its distance from the axis in the posture plus d,
        by at most spans_j times this radius.
        """
        went = np.zeros(len(rows))
        for j in reversed(range(len(self.slides))):
            arm = 1.0
            if not self.slides[j]:
                across = np.cross(centers - postures.origins[rows, j], postures.axes[rows, j])
                arm = np.linalg.norm(across, axis=1) + radii + went
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
        off: JointValues,
    ) -> Float[ndarray, "k v"]:
        """Upper bound on the movement of each point against each unit normal [m].

        origins, axes: of the joints in a posture. moved_by: the joints that move the points, base first.
        steps: configurations minus that of the posture; the joints move anywhere on the straight lines
        between these configurations, or within `off` of the lines.

        To first order, a point's movement along a normal is linear in the joints, so it is least at one of
        the steps; `off` lowers it further. With spans D and the greatest distance L_k of the point from axis
        k, the remainder is at most sum_k L_k D_k (D_k / 2 + sum_{j<k} D_j), because the second derivative of
        the point by joints j <= k is at most L_k.
        """
        moving_joints = moved_by.tolist()
        spans = np.abs(steps).max(axis=0) + off
        rates = np.cross(axes[moving_joints, None], points[None] - origins[moving_joints, None])
        rates[self.slides[moving_joints]] = axes[moving_joints, None][self.slides[moving_joints]]
        lengths = np.linalg.norm(rates, axis=2)
        along = np.moveaxis(rates @ normals.T, 2, 1)
        towards = np.tensordot(off[moving_joints], np.abs(along), 1)
        towards -= np.tensordot(steps[:, moving_joints], along, 1).min(axis=0)
        went = np.zeros(len(points))
        remainder = np.zeros(len(points))
        for i in reversed(range(len(moving_joints))):
            j = moving_joints[i]
            arm = lengths[i] if self.slides[j] else lengths[i] + went
            went = went + spans[j] * arm
            remainder += spans[j] * arm * (spans[j] / 2 + spans[moving_joints[:i]].sum())
        return np.minimum(np.maximum(towards, 0.0) + remainder, went)


class Cubics(NamedTuple):
    """The cubics from each row of a motion to the next. Their accelerations are linear in time; for a path,
    they are 0."""

    times: Values
    """Time at which each cubic begins [s]."""
    steps: Float[ndarray, "m 1"]
    """Duration of each cubic [s]."""
    positions: Configurations
    """Positions at the start of each cubic."""
    velocities: JointRows
    """Velocities at the start of each cubic."""
    start: JointRows
    """Accelerations at the start of each cubic."""
    end: JointRows
    """Accelerations at the end of each cubic."""

    def at(self, row: Int[ndarray, "n"], time: Values) -> tuple[Configurations, JointRows, JointRows]:
        """Positions, velocities and accelerations on the cubics with the indices `row`, `time` [s] after each
        begins."""
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
        """Index of the cubic at each time; at a row's time, the cubic that begins there."""
        return np.clip(np.searchsorted(self.times, times, side="right") - 1, 0, len(self.times) - 1)

    @property
    def peak_accelerations(self) -> JointRows:
        """The greatest absolute acceleration of each cubic and joint."""
        return np.maximum(np.abs(self.start), np.abs(self.end))

    @property
    def jerks(self) -> JointRows:
        """The absolute jerk of each cubic and joint."""
        return np.abs(self.end - self.start) / self.steps

    @property
    def speeds(self) -> JointRows:
        """The greatest absolute velocity of each cubic and joint, which is at an end or where the
        acceleration is 0."""
        curve = self.end - self.start
        share = np.clip(np.divide(-self.start, curve, out=np.zeros_like(curve), where=curve != 0), 0.0, 1.0)
        extremal = self.velocities + self.steps * share * (self.start + share * curve / 2)
        last = self.velocities + self.steps * (self.start + self.end) / 2
        return np.maximum(np.abs(extremal), np.maximum(np.abs(self.velocities), np.abs(last)))

    @property
    def turning_points(self) -> Configurations:
        """Positions that include the extremes of each joint inside each cubic: two rows per cubic, at the
        roots of the velocity; for a root that is missing or outside, at any other place on the cubic."""
        # the two roots of v + start * share + curve * share**2 / 2, in a form without cancellation
        v = self.velocities / self.steps
        curve = self.end - self.start
        root = np.sqrt(np.maximum(self.start**2 - 2 * curve * v, 0.0))
        far = -self.start - np.where(self.start < 0, -root, root)
        shares = [
            np.divide(above, below, out=np.zeros_like(above), where=below != 0)
            for above, below in ((2 * v, far), (far, curve))
        ]
        points = []
        for share in np.clip(shares, 0.0, 1.0):
            t = share * self.steps
            points.append(self.positions + t * (self.velocities + t * (self.start / 2 + share * curve / 6)))
        return np.concatenate(points)

    def deviations(self, times: Values) -> JointRows:
        """Upper bounds on how far each joint leaves the straight lines between its positions at these times.

        The bound is an eighth of the greatest acceleration between two times, multiplied by the square of
        the time between them. The times include those of all rows.
        """
        row = self.rows(times[:-1])
        ends = (self.at(row, end - self.times[row])[2] for end in (times[:-1], times[1:]))
        return np.abs([*ends]).max(axis=0) * np.diff(times)[:, None] ** 2 / 8

    def jumps(self) -> JointRows:
        """The jump of the acceleration at each row, with zero acceleration before and after the motion."""
        none = np.zeros_like(self.start[:1])
        return np.abs(np.concatenate([self.start, none]) - np.concatenate([none, self.end]))


def clock(motion: Path | Trajectory) -> Values:
    """The times of a trajectory's rows; for a path, the indices of its rows."""
    return motion.times if isinstance(motion, Trajectory) else np.arange(len(motion.positions), dtype=float)


def places_of(motion: Path | Trajectory, between: Values) -> Values:
    """The `clock` of the rows and the places `between` them, in order."""
    return np.sort(np.concatenate([clock(motion), between]), kind="stable")


def cubics_of(motion: Path | Trajectory) -> Cubics:
    """The cubics of a trajectory with increasing times; for a path, its straight lines, by its `clock`."""
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
