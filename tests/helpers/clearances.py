"""Clearances of single configurations."""

import numpy as np

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.collision.kernels.collision_cost import CLEARANCE_CAP


def least_clearance(checker: CollisionChecker, q: np.ndarray) -> np.ndarray:
    """Least distance of each configuration to the scene and between links [m], at most 1 m."""
    every = [checker.link_clearances(q), checker.pair_clearances(q), np.full((len(q), 1), CLEARANCE_CAP)]
    return np.concatenate(every, axis=1).min(axis=1)
