"""The probability that a motion is free of what no camera saw, fitted on the calibration half of the problems
of `benchmarks/cameras.py`.

python benchmarks/cameras.py --fit
"""

import math

RATES: dict[str, float] = {
    "as seen": 0.64,
    "points padded by 9 cm": 0.82,
    "points padded by 6 cm": 0.7,
    "points padded by 4 cm": 0.5,
    "unknown is occupied": 0.99,
}
"""Part of the motions under an assumption that were free in the true scene, without a prediction."""
BY_RISK: dict[str, tuple[float, float]] = {
    "predicted": (3.48, -0.81),
    "as seen": (0.98, -0.14),
    "explored": (4.05, -1.15),
}
"""With a prediction, for motions under a predicted assumption, for those as seen, and for those of an
Explorer: the log odds of a motion that sweeps a summed probability of 1, and the slope of the log odds over
its logarithm. The last is fitted on 493 motions of `benchmarks/exploring.py`, half of them with noise; see
its report."""
MIN_RISK = 0.2
"""Smaller summed probabilities are raised to this."""


def confidence(assumption: str, risk: float | None = None) -> float:
    """The probability that a motion under an assumption is free in the true scene.

    risk: the predicted probability that the motion sweeps, summed over voxels; None without a prediction.
    """
    if risk is None:
        return RATES[assumption]
    odds, slope = BY_RISK.get(assumption, BY_RISK["predicted"])
    return 1 / (1 + math.exp(-(odds + slope * math.log(max(risk, MIN_RISK)))))
