"""Texts of error messages."""

from hypothesis import given
from hypothesis import strategies as st

from robotdiffuse.core.errors import distinct


@given(st.lists(st.floats(allow_nan=False), min_size=1, max_size=3), st.integers(2, 6))
def test_different_numbers_are_told_apart(values: list[float], digits: int) -> None:
    texts = distinct(*values, digits=digits)
    assert len(set(texts)) >= len(set(values))


def test_as_few_digits_as_needed() -> None:
    assert distinct(3.14, 9.0) == ["3.14", "9"]
    assert distinct(3.1400001049, 3.14) == ["3.1400001", "3.14"]
