"""The probability that a motion is free of what no camera saw."""

import math

from robotdiffuse.perception.unknown_space import CrossedSpace

RATES: dict[str, float] = {
    "as seen": 0.64,
    "points padded by 9 cm": 0.82,
    "points padded by 6 cm": 0.7,
    "points padded by 4 cm": 0.5,
    "unknown is occupied": 0.99,
}
"""Part of the motions under an assumption that were free in the true scene, without a prediction, as
`python benchmarks/cameras.py --fit` prints it for the calibration half of its problems."""

MAX_CONFIDENCE = 0.995
"""Of a motion that is free in every sampled world: the network and 256 worlds cannot tell more."""


def confidence(assumption: str, crossed: CrossedSpace) -> float:
    """The probability that a motion under an assumption is free in the true scene.

    It is the share of sampled worlds in which the motion is free; see `sampled_worlds`. Without a prediction,
    it is the assumption's rate.
    """
    share = crossed.free_share
    return RATES[assumption] if share is None else min(share, MAX_CONFIDENCE)


EXPLORED = (4.05, -1.15)
"""Of an Explorer's motions: the log odds of one that sweeps a summed probability of 1, and the slope of the
log odds over its logarithm, fitted to 493 motions of `benchmarks/exploring.py`, half of them with noise; see
its report."""
MIN_RISK = 0.2
"""Smaller summed probabilities are raised to this."""


def explored_confidence(risk: float) -> float:
    """The probability that a motion is free in the true scene, where an Explorer's views left little unknown.

    Sampled worlds, which suit the large parts that one view leaves unknown, state too little there.
    risk: the predicted probability that the motion sweeps, summed over voxels.
    """
    odds, slope = EXPLORED
    return 1 / (1 + math.exp(-(odds + slope * math.log(max(risk, MIN_RISK)))))
