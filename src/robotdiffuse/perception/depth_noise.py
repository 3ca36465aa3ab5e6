"""DepthNoise: the errors of depth cameras, simulated."""

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from jaxtyping import Bool
from numpy import ndarray
from numpy.random import Generator

from robotdiffuse.core.settings import Bound, NotNegative, Positive, Settings
from robotdiffuse.perception.depth_view import DepthView

ShareBelowOne = Annotated[float, Bound(least=0.0, below=1.0)]
Angle = Annotated[float, Bound(least=0.0, below=np.pi / 2)]


@dataclass(frozen=True)
class DepthNoise(Settings, name="depth_noise"):
    """Noise of a real depth camera; the defaults resemble a stereo camera."""

    spread: NotNegative = 0.0015
    """Standard deviation of depth at a distance of 1 m [m]; it grows with the square of the distance."""
    missing: ShareBelowOne = 0.0
    """Fraction of the pixels without a return, anywhere."""
    stray: ShareBelowOne = 0.01
    """Fraction of the pixels, anywhere, with a depth between the camera and the surface."""
    flying: ShareBelowOne = 0.3
    """Fraction of the pixels at edges whose depth is between the two surfaces (flying pixels)."""
    edge_missing: ShareBelowOne = 0.3
    """Fraction of the pixels at edges without a return."""
    edge: Positive = 0.05
    """Neighbouring pixels whose depths differ by more than this are at an edge [m]."""
    grazing: Angle = 0.17
    """Surfaces at a smaller angle to the line of sight give no return [rad]."""

    def applied(self, view: DepthView, rng: Generator) -> DepthView:
        """The view with noise."""
        clean, depth = view.depth, view.depth.astype(np.float64)
        lost = self._grazed(view)
        for axis in (0, 1):
            # of two neighbours with an edge between them, the first becomes a flying pixel
            other = clean.take(np.arange(1, clean.shape[axis] + 1), axis, mode="clip")
            both = np.isfinite(clean) & np.isfinite(other)
            apart = np.where(both, other, 0.0) - np.where(both, clean, 0.0)
            edge = np.abs(apart) > self.edge
            flies = edge & (rng.random(clean.shape) < self.flying)
            depth[flies] = clean[flies] + rng.random(int(flies.sum())) * apart[flies]
            lost |= edge & (rng.random(clean.shape) < self.edge_missing)
        seen = np.isfinite(depth) & (depth > 0)
        depth[seen] += self.spread * depth[seen] ** 2 * rng.standard_normal(int(seen.sum()))
        stray = seen & (rng.random(depth.shape) < self.stray)
        depth[stray] *= rng.random(int(stray.sum()))
        depth[lost | (rng.random(depth.shape) < self.missing)] = 0.0
        return replace(view, depth=depth)

    def _grazed(self, view: DepthView) -> Bool[ndarray, "h w"]:
        """Pixels that see their surface at a smaller angle than `grazing`."""
        depth = np.where(np.isfinite(view.depth) & (view.depth > 0), view.depth, np.nan).astype(np.float64)
        steepness = np.zeros_like(depth)
        for axis, focal in ((1, view.intrinsics[0]), (0, view.intrinsics[1])):
            ahead = np.diff(depth, axis=axis, append=np.nan)
            behind = np.diff(depth, axis=axis, prepend=np.nan)
            # the smaller difference: across an edge, the other one lies on the surface
            steepness += (focal * np.fmin(np.abs(ahead), np.abs(behind)) / depth) ** 2
        return np.sqrt(steepness) * np.tan(self.grazing) > 1
