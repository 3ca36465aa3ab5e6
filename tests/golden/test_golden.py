"""Held-out problems have not changed: digests of their numbers are equal but for the last bits, in which processors differ.
`python tests/golden/test_golden.py` writes new digests; such a commit says which changed and why."""

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from robotdiffuse.problems.families import FAMILIES
from robotdiffuse.problems.files import held_out_problem, problem_record

GOLDEN = Path(__file__).with_name("golden.json")


def numbers_of(record: object) -> Iterator[float]:
    if isinstance(record, dict | list | tuple):
        for value in record.values() if isinstance(record, dict) else record:
            yield from numbers_of(value)
    elif isinstance(record, int | float):
        yield float(record)


def digest(family: str) -> dict[str, float]:
    problems = [held_out_problem(family, i) for i in range(8)]
    flat = np.array([number for problem in problems for number in numbers_of(problem_record(problem))])
    flat = np.nan_to_num(flat, nan=-1e3, posinf=1e3, neginf=-1e3)
    direction = np.random.default_rng(0).standard_normal(len(flat))
    return {"count": len(flat), "projection": float(direction @ flat), "scale": float(np.linalg.norm(flat))}


@pytest.mark.parametrize("family", FAMILIES)
def test_golden(family: str) -> None:
    assert digest(family) == pytest.approx(json.loads(GOLDEN.read_text())[family], rel=1e-4, abs=1e-3)


if __name__ == "__main__":
    rows = ",\n".join(f' "{family}": {json.dumps(digest(family))}' for family in FAMILIES)
    GOLDEN.write_text(f"{{\n{rows}\n}}\n")
