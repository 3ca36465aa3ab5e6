"""The stated probability that a motion is free of what no camera saw."""

from itertools import pairwise

import numpy as np

from robotdiffuse.perception.unknown_space import (
    MAX_CONFIDENCE,
    RATES,
    CrossedSpace,
    confidence,
    explored_confidence,
)
from robotdiffuse.perception.voxel_grid import FINE_SHAPE

VOXELS = np.zeros(FINE_SHAPE, np.bool_)
VOXELS[40:60, 50:52, 20:22] = True


def test_confidence_falls_with_the_predicted_probability() -> None:
    crossed = [CrossedSpace(VOXELS, np.full(FINE_SHAPE, p, np.float32)) for p in (0, 0.01, 0.1, 0.5, 1)]
    stated = [confidence("predicted, p > 0.1", one) for one in crossed]
    assert stated[0] == MAX_CONFIDENCE and stated[-1] == 0 and all(b < a for a, b in pairwise(stated))


def test_an_explorers_confidence_falls_with_the_probability_that_is_swept() -> None:
    stated = [explored_confidence(risk) for risk in (0.0, 0.1, 1.0, 10.0, 1000.0)]
    assert all(0 <= b <= a <= 1 for a, b in pairwise(stated))


def test_without_a_prediction_confidence_is_the_rate_of_the_assumption() -> None:
    assert all(confidence(name, CrossedSpace(VOXELS, None)) == rate for name, rate in RATES.items())
