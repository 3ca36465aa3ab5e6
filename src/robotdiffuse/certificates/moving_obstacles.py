"""Clearances to moving obstacles over stretches of a timed motion.

A stretch is free of an obstacle if the clearance of the link's spheres in its middle, in place and time,
exceeds the sum of the largest displacements of any point of the link and of the obstacle from there until
either end.
"""

from collections.abc import Sequence
from functools import cached_property

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.certificates.bounds import CLEARANCE_CAP, Bounds, Claim, Plane, Prover, Stretches
from robotdiffuse.certificates.obstacles import Obstacles
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.moving_obstacles import MovingObstacle
from robotdiffuse.scenes.scene import Scene


class MovingProver(Prover):
    """Computes bounds for a robot among moving obstacles along straight lines through configurations at
    times, or near them."""

    def __init__(
        self,
        robot: Robot,
        moving: Sequence[MovingObstacle],
        q: Float[ndarray, "rows dof"],
        times: Float[ndarray, "rows"],
        off: Float[ndarray, "rows1 dof"] | None = None,
    ) -> None:
        super().__init__(robot, Scene(), q, off)
        self.times, self.moving = times, tuple(moving)
        self._shapes = [Obstacles(Scene([one.shape])) for one in moving]

    @cached_property
    def claims(self) -> tuple[Claim, ...]:
        """Each moving link against each obstacle."""
        links = [link for link in self.links if self._moved[self._of[link]].any()]
        return tuple(Claim(link, one.name) for link in links for one in self.moving)

    def bounds(self, stretches: Stretches, by_planes: ndarray, planes: list[Plane]) -> Bounds:
        """Bounds of stretches by the spheres; planes are not used."""
        middle = (stretches.start + stretches.stop) / 2
        spans = self.spans(stretches.start, stretches.stop, middle)
        postures = self.linkage.place(self.at(middle))
        rows = np.arange(len(self.times))
        begin, at, end = (np.interp(s, rows, self.times) for s in (stretches.start, middle, stretches.stop))
        further = np.array([self._of[claim.link] for claim in self.claims])[stretches.claim]
        row, ball, first = self._expand(further)
        centers = self._placed(postures, row, further[row], self._balls[ball, :3])
        radii, moved = self._balls[ball, 3], self._moved[further][row]
        went = self.linkage.displacement(postures, row, centers, radii, moved, spans)
        number = {one.name: i for i, one in enumerate(self.moving)}
        which = np.array([number[claim.against] for claim in self.claims])[stretches.claim]
        distances, obstacle = np.empty(len(row)), np.empty(len(which))
        for i, one in enumerate(self.moving):
            of_it = np.flatnonzero(which == i)
            if one.max_speed is None:
                T = np.array([one.pose(time) for time in at[of_it]]).reshape(-1, 4, 4)
                obstacle[of_it] = one.top_speed * np.maximum(at - begin, end - at)[of_it]
            else:
                T = np.broadcast_to(one.pose(0.0), (len(of_it), 4, 4))
                obstacle[of_it] = one.max_speed * np.maximum(end[of_it], 0.0)
            place = np.empty(len(which), int)
            place[of_it] = np.arange(len(of_it))
            balls = np.flatnonzero(which[row] == i)
            there = T[place[row[balls]]]
            local = np.einsum("nji,nj->ni", there[:, :3, :3], centers[balls] - there[:, :3, 3])
            stands = one.pose(float(one.track[0][0]))
            distances[balls] = self._shapes[i].distances(local @ stands[:3, :3].T + stands[:3, 3])[:, 0]
        clearance = np.minimum(np.minimum.reduceat(distances - radii, first), CLEARANCE_CAP)
        return Bounds(clearance, np.maximum.reduceat(went, first) + obstacle)
