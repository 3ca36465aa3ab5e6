"""Configurations that an arm can reach from where it is, and the ways there."""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.collision.motions import search_space
from robotdiffuse.planning.search.rrt_kernel import extend, make_trees
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.trajectories.simplification import simplify

RESOLUTION = 0.02
"""No point of the arm moves further than this between two checks of a motion [m]."""
CAPACITY = 2000
"""Most configurations of a tree."""
PARTS = (0.25, 0.5, 1.0)
"""Parts of a way that may be gone."""


class ReachableTree:
    """A tree of straight motions without collision from a configuration on.

    Searches between two configurations fail where only a narrow gap leads out of the first one. The tree
    knows what is beyond such gaps before anything there is chosen as a goal.
    """

    def __init__(self, robot: Robot, scene: Scene, start: Float[ndarray, "dof"]) -> None:
        self._space = search_space(CollisionChecker(robot, scene), RESOLUTION)
        self._start = start
        self._trees = make_trees(start.astype(np.float32), np.zeros((0, robot.dof), np.float32), CAPACITY)

    def __len__(self) -> int:
        return int(self._trees.sizes[0])

    @property
    def configurations(self) -> Float[ndarray, "n dof"]:
        """The start, and what is reached from it."""
        return self._trees.nodes[0, : len(self)].astype(np.float64)

    def grow(self, targets: Float[ndarray, "n dof"], longest: Float[ndarray, "n"]) -> None:
        """Extend the tree from its nearest configuration towards each target, where that motion is free.

        longest: the longest extension towards each [rad, joint-space L2].
        """
        targets = np.clip(targets, self._space.lower, self._space.upper)
        extend(self._space, self._trees, targets.astype(np.float32), longest.astype(np.float32))

    def way(self, number: int) -> Float[ndarray, "m dof"]:
        """Waypoints from the start to one of the configurations."""
        nodes, parents, path = self._trees.nodes[0], self._trees.parents[0], [number]
        while parents[path[-1]] >= 0:
            path.append(parents[path[-1]])
        way = simplify(self._space, nodes[path[::-1]], 1).astype(np.float64)
        way[0] = self._start
        return way


def first_parts(waypoints: Float[ndarray, "n dof"]) -> Iterator[Float[ndarray, "m dof"]]:
    """The first parts of a way, the shortest first, and all of it."""
    at = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(waypoints, axis=0), axis=1))])
    for part in PARTS:
        end = part * at[-1]
        last = np.array([np.interp(end, at, joint) for joint in waypoints.T])
        yield np.concatenate([waypoints[at < end], last[None]])
