"""How likely a motion is free of what no camera saw: fitted on the calibration half of the problems of
`benchmarks/cameras.py`.

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
"""Share of the motions of an assumption that were free in the true scene, where nothing is predicted."""
BY_RISK: dict[str, tuple[float, float]] = {
    "predicted": (3.48, -0.81),
    "as seen": (0.98, -0.14),
}
"""Where voxels were predicted, for motions of predicted assumptions and for those as seen: the log odds of a motion
that sweeps a probability of 1, and how they change with its logarithm."""
LEAST_RISK = 0.2
"""Summed probabilities below this count as this."""


def confidence(assumption: str, risk: float | None = None) -> float:
    """The probability that a motion is free in truth. `risk` is the probability, summed over the voxels, that
    it sweeps; None where none was predicted."""
    if risk is None:
        return RATES[assumption]
    odds, slope = BY_RISK["as seen" if assumption == "as seen" else "predicted"]
    return 1 / (1 + math.exp(-(odds + slope * math.log(max(risk, LEAST_RISK)))))
