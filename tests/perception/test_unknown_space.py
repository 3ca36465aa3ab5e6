"""The unknown space that a motion passes through, and the probability that it sweeps."""

import numpy as np

from robotdiffuse import Path, load_robot
from robotdiffuse.perception.unknown_space import UnknownSpace
from robotdiffuse.perception.voxel_grid import FINE, FINE_SHAPE

PANDA = load_robot("panda")
START = np.array([0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785])
EVERYWHERE = np.ones(FINE_SHAPE, np.bool_)
PREDICTED = np.full(FINE_SHAPE, 0.01, np.float32)


def test_only_what_the_arm_fills_at_the_ends_is_left_out_without_a_margin() -> None:
    """A hand that grazes an unseen cupboard beside its goal stated a confidence of 0.98."""
    ends = START[None]
    path = Path(PANDA.joint_names, np.stack([START, START + 0.015, START]))
    filled = FINE.filled(PANDA, [START])
    bare = UnknownSpace(PANDA, ends, EVERYWHERE, PREDICTED, margin=0.0).crossed(path)
    usual = UnknownSpace(PANDA, ends, EVERYWHERE, PREDICTED).crossed(path)
    assert bare.voxels.any() and not (bare.voxels & filled).any()
    assert not usual.voxels.any() and usual.risk == 0
    assert bare.risk is not None and np.isclose(bare.risk, 0.01 * bare.voxels.sum(), rtol=1e-4)
