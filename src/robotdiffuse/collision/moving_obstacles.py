"""The motion certificate among moving obstacles: proves a timed motion free of them, or finds the first
contact.

A time interval is proved free for a link and an obstacle if their clearance at the middle of the interval
exceeds the sum of two distances: how far points of the link (`robots/motion_bounds.py`) and points of the
obstacle can move in half of the interval. Otherwise the interval is halved. If only the maximum speed of an
obstacle is known, the obstacle may be anywhere that it can have reached since time 0. Clearances are computed
from the covering spheres (`kernels/moving_obstacles.py`). Where these spheres come within the distance that
counts as contact, Coal computes the clearance from the meshes. The result is a proof and does not depend on
sampling.
"""

from collections.abc import Sequence
from copy import copy
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.collision.convex_geometry import Solid, solids_of
from robotdiffuse.collision.kernel_arrays import bounding_spheres, robot_groups
from robotdiffuse.collision.kernels import moving_obstacles as kernel
from robotdiffuse.collision.kernels.moving_obstacles import CLEARANCE_CAP, Links, Tasks, Tracks
from robotdiffuse.collision.motions import with_covering_spheres
from robotdiffuse.core.loading import loading
from robotdiffuse.core.transforms import inverse, quaternion_from_rotation
from robotdiffuse.core.types import NO_SPHERES, Values, for_kernels, interpolated
from robotdiffuse.robots.kinematic_tree import once_per_robot
from robotdiffuse.robots.motion_bounds import radii_of
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene import MovingObstacle, Scene, track_speeds

if TYPE_CHECKING:
    from robotdiffuse.collision.exact_meshes import ExactCollision

CONTACT_TIME_TOLERANCE = 1e-3
"""The first contact is located to within this time [s]."""
MIN_INTERVAL = 1e-7
"""Intervals are halved down to this length [s]; a shorter interval that is not proved counts as a contact."""
DEPTH_SAMPLE_TIME = 0.005
"""Time between the samples at which the depth of a contact is computed [s]."""
DEPTH_SAMPLES = 200
"""Largest number of samples at which the depth of one contact is computed."""


class TimedContact(NamedTuple):
    """The first contact of a timed motion with a moving obstacle."""

    link: str
    obstacle: str
    time: float
    """[s]"""
    depth: float
    """The greatest penetration found until the contact ends [m]; 0 for a touch."""


class TimedSweep(NamedTuple):
    """The result of certifying a timed motion."""

    contact: TimedContact | None
    clearance: float
    """Lower bound on all clearances to the obstacles [m], at most 1 m; 0 if there is a contact."""


class MovingCollision:
    """Certifies timed motions of a robot among moving obstacles. Threads may share an object of this class:
    calls change nothing but a cache."""

    def __init__(
        self, robot: Robot, moving: Sequence[MovingObstacle], contact: float, tightness: float
    ) -> None:
        """Meshes nearer than `contact` [m] count as touching. Intervals are halved until the lower bound on
        the clearance in each is at least `tightness`, in [0, 1), times the smallest clearance measured."""
        self.robot, self.moving, self.contact, self.tightness = robot, tuple(moving), contact, tightness
        self.link_names, self.links = compile_links(robot)
        self.tracks = compile_tracks(self.moving)

    def sweep(self, times: Float[ndarray, "n"], q: Float[ndarray, "n dof"]) -> TimedSweep:
        """Certify the motion on straight lines between rows q at increasing times [s]."""
        times = for_kernels(times)
        q = for_kernels(q)
        best = np.array([CLEARANCE_CAP])
        certified = CLEARANCE_CAP
        tasks = self._whole(times)
        hit = None  # time, link and obstacle of the first contact
        while len(tasks.start):
            bound, open_tasks = kernel.settle_tasks(
                self.links, self.tracks, times, q, tasks, self.contact, self.tightness, best
            )
            certified = min(certified, bound)
            halves = list[tuple[float, float, int, int]]()
            # movement: how far the link and the obstacle can approach each other in half of the interval
            for start, stop, link, o, movement in open_tasks:
                if hit is not None and start >= hit[0]:
                    continue
                time = (start + stop) / 2
                distance = self._distance(link, o, times, q, time)
                # an interval of length 0 is proved by the distance alone
                if distance <= self.contact or 0 < stop - start < MIN_INTERVAL:
                    if hit is None or time < hit[0]:
                        hit = time, link, o
                    if stop - start > 2 * CONTACT_TIME_TOLERANCE:
                        halves.append((start, time, link, o))
                    continue
                best[0] = min(best[0], distance)
                if distance - movement >= max(self.contact, self.tightness * best[0]):
                    certified = min(certified, distance - movement)
                else:
                    halves += [(start, time, link, o), (time, stop, link, o)]
            tasks = self._tasks([half for half in halves if hit is None or half[0] < hit[0]])
        if hit is not None:
            return TimedSweep(self._contact(times, q, *hit), 0.0)
        return TimedSweep(None, float(certified))

    def inflated(self, by: Values) -> "MovingCollision":
        """A copy for `first_unproved_time`, with each obstacle inflated by its entry of `by` [m]. Only bounds
        from the covering spheres use the inflation; distances of the exact meshes do not."""
        inflated = copy(self)
        inflated.tracks = self.tracks._replace(rounding=self.tracks.rounding + by)
        return inflated

    def first_unproved_time(
        self, times: Float[ndarray, "n"], q: Float[ndarray, "n dof"], least: float
    ) -> float | None:
        """A time [s] until which the covering spheres prove a clearance of `least` [m]: the start of the
        first interval for which they do not. None if they prove it for the whole motion. The exact meshes are
        never used, so the call is fast enough for searches and control loops."""
        times = for_kernels(times)
        q = for_kernels(q)
        best = np.array([CLEARANCE_CAP])
        tasks = self._whole(times)
        _, open_tasks = kernel.settle_tasks(self.links, self.tracks, times, q, tasks, least, 0.0, best)
        return min((start for start, *_ in open_tasks), default=None)

    def _whole(self, times: Values) -> Tasks:
        """One task: the time interval of the whole motion, for all pairs of a link and an obstacle."""
        pairs = np.ones((1, len(self.link_names), len(self.moving)), np.bool_)
        return Tasks(times[:1], times[-1:], pairs)

    def _tasks(self, halves: list[tuple[float, float, int, int]]) -> Tasks:
        pairs = np.zeros((len(halves), len(self.link_names), len(self.moving)), np.bool_)
        for i, (_, _, link, o) in enumerate(halves):
            pairs[i, link, o] = True
        starts = np.array([half[0] for half in halves])
        return Tasks(starts, np.array([half[1] for half in halves]), pairs)

    def _distance(self, link: int, o: int, times: ndarray, q: ndarray, time: float) -> float:
        """Signed distance [m] of a link's meshes to obstacle o at `time` [s]. If only the obstacle's maximum
        speed is known, the distance that it can have moved by then is subtracted."""
        obstacle = self.moving[o]
        # instead of the obstacle, the robot moves
        T_base_moved = obstacle.shape.T_base_shape @ inverse(obstacle.pose(time))
        distance = self._exact[o].distance_from_moved_base(
            self.link_names[link], interpolated(time, times, q), T_base_moved
        )
        return distance - self.tracks.growth[o] * max(time, 0.0)

    @cached_property
    def _exact(self) -> "tuple[ExactCollision, ...]":
        with loading():
            from robotdiffuse.collision.exact_meshes import (
                ExactCollision,  # imports Coal, which most motions do not need
            )

        return tuple(ExactCollision(self.robot, Scene([obstacle.shape])) for obstacle in self.moving)

    def _contact(self, times: ndarray, q: ndarray, time: float, link: int, o: int) -> TimedContact:
        """A contact with its greatest depth until link and obstacle separate."""
        depth = 0.0
        for k in range(DEPTH_SAMPLES):
            at = time + DEPTH_SAMPLE_TIME * k
            distance = self._distance(link, o, times, q, at) if at <= times[-1] or k == 0 else np.inf
            if k and distance > self.contact:
                break
            depth = max(depth, -distance)
        return TimedContact(self.link_names[link], self.moving[o].name, time, float(depth))


@once_per_robot
def compile_links(robot: Robot) -> tuple[tuple[str, ...], Links]:
    """Names of the moving links with geometry, and the links' arrays for compiled code."""
    covered = with_covering_spheres(robot)
    names = tuple(link for link in robot_groups(covered) if covered.link_frame(link) > 0)
    spheres = list(map(covered.frame_spheres, names))
    links = Links(
        *robot.kernel_joints,
        np.array([covered.link_frame(link) for link in names], np.int64),
        np.array(bounding_spheres(spheres)).reshape(-1, 4),
        np.cumsum([0, *map(len, spheres)]),
        np.concatenate(spheres) if spheres else NO_SPHERES,
        radii_of(covered, names),
    )
    return names, links


def compile_tracks(moving: Sequence[MovingObstacle]) -> Tracks:
    """The arrays of moving obstacles for compiled code. A mesh is represented by its bounding box."""
    # times, positions, quaternions and speeds: an empty entry, in case there is none, then one per obstacle
    tracks = [(np.zeros(0), np.zeros((0, 3)), np.zeros((0, 4)), np.zeros(0))]
    solids = list[Solid]()
    for obstacle in moving:
        at, poses = obstacle.track
        quaternions = np.stack([quaternion_from_rotation(T) for T in poses])
        for i in range(1, len(quaternions)):
            quaternions[i] *= 1.0 if quaternions[i] @ quaternions[i - 1] >= 0 else -1.0
        speeds = np.append(track_speeds(at, poses, obstacle.radius), 0.0)
        tracks.append((at, poses[:, :3, 3], quaternions, speeds))
        solids += solids_of(Scene([obstacle.shape]))
    boxes = [
        inverse(obstacle.shape.T_base_shape) @ solid.T_base_box
        for obstacle, solid in zip(moving, solids, strict=True)
    ]
    # The bounding box of a mesh is aligned with the base frame, so it is rotated in the obstacle's frame;
    # these are the half edges of a larger box, aligned with the obstacle's frame, that contains it.
    half_edges = [np.abs(T[:3, :3]) @ solid.half for T, solid in zip(boxes, solids, strict=True)]
    times, xyz, wxyz, speeds = map(np.concatenate, zip(*tracks, strict=True))
    return Tracks(
        np.cumsum([len(track[0]) for track in tracks]),
        times,
        xyz,
        wxyz,
        speeds,
        np.array([obstacle.max_speed or 0.0 for obstacle in moving]),
        np.array([T[:3, 3] for T in boxes]).reshape(-1, 3),
        np.array(half_edges).reshape(-1, 3),
        np.array([solid.disc for solid in solids], np.float64),
        np.array([solid.rounding for solid in solids], np.float64),
    )
