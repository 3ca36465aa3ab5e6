"""The stated probability that a motion is free of what no camera saw."""

from itertools import pairwise

from robotdiffuse.perception.confidence import RATES, confidence


def test_confidence_falls_with_the_probability_that_is_swept() -> None:
    for assumption in ("predicted, p > 0.1", "as seen", "explored"):
        stated = [confidence(assumption, risk) for risk in (0.0, 0.1, 1.0, 10.0, 1000.0)]
        assert all(0 <= b <= a <= 1 for a, b in pairwise(stated))
    assert all(0 < confidence(assumption) < 1 for assumption in RATES)
