"""Tables that tell for which values of the joints between two links the links do not collide."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from robotdiffuse.core.bounds import Value

TURN = 2 * np.pi
ROUNDING = 1e-5
"""Upper bound on the rounding error of a joint value [rad] or [m]."""


@dataclass(frozen=True, eq=False)
class LinkPairTable(Value):
    """Where the convex parts of two links are apart, as a function of the one or two joints between them."""

    links: tuple[str, str]
    joints: tuple[str, ...]
    """Joints between the links, from the base on."""
    lower: tuple[float, ...]
    """Joint values at which the table begins [rad] or [m]."""
    upper: tuple[float, ...]
    """Joint values at which it ends. A range of one whole turn repeats itself."""
    apart: Bool[ndarray, "*cells"]
    """Whether the links are apart throughout a cell."""

    def at(self, *values: Float[ndarray, "n"]) -> Bool[ndarray, "n"]:
        """Whether the links are known to be apart at joint values, one array per joint."""
        known = np.ones(len(values[0]), dtype=bool)
        index = []
        for axis, value in enumerate(values):
            cell = np.floor((value - self.lower[axis]) / self._edge(axis)).astype(int)
            count = self.apart.shape[axis]
            if not self._whole(axis):
                known &= (cell >= 0) & (cell < count)
            index.append(cell % count)
        return known & self.apart[tuple(index)]

    def throughout(
        self, *intervals: tuple[Float[ndarray, "n"], Float[ndarray, "n"]]
    ) -> Bool[ndarray, "*intervals"]:
        """Whether the links are known to be apart throughout intervals [low, high] of the joints between
        them.

        With two joints, the result holds every combination of an interval of the first and one of the second.
        """
        touch = ~self.apart
        for axis, (low, high) in enumerate(intervals):
            touch = np.moveaxis(np.tensordot(self._reached(axis, low, high), touch, (1, axis)), 0, axis)
            if not self._whole(axis):
                beyond = (low < self.lower[axis] - ROUNDING) | (high > self.upper[axis] + ROUNDING)
                touch |= np.expand_dims(beyond, tuple(i for i in range(len(intervals)) if i != axis))
        return ~touch.astype(bool)

    def _edge(self, axis: int) -> float:
        return (self.upper[axis] - self.lower[axis]) / self.apart.shape[axis]

    def _whole(self, axis: int) -> bool:
        return abs(self.upper[axis] - self.lower[axis] - TURN) < ROUNDING

    def _reached(
        self, axis: int, low: Float[ndarray, "n"], high: Float[ndarray, "n"]
    ) -> Bool[ndarray, "n cells"]:
        """Which cells along a joint each interval overlaps."""
        count = self.apart.shape[axis]
        first = np.floor((low - ROUNDING - self.lower[axis]) / self._edge(axis)).astype(int)
        last = np.floor((high + ROUNDING - self.lower[axis]) / self._edge(axis)).astype(int)
        steps = np.arange((last - first).max(initial=0) + 1)
        cell = np.minimum(first[:, None] + steps, last[:, None])
        cell = cell % count if self._whole(axis) else np.clip(cell, 0, count - 1)
        found = np.zeros((len(low), count), dtype=bool)
        np.put_along_axis(found, cell, True, axis=1)
        return found
