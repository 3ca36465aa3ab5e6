"""The words of messages."""

from robotdiffuse.core.errors import counted


def test_a_count_of_one_is_singular() -> None:
    """Regression: "1 problems", "1 workers"."""
    assert [counted(count, "entry", "entries") for count in (0, 1, 2000)] == ["0 entries", "1 entry", "2,000 entries"]
    assert [counted(count, "worker") for count in (1, "ray")] == ["1 worker", "ray workers"]
