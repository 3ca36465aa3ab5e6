"""Damaged inputs, each with an answer or a one-line error; `benchmarks/robustness.py` runs more."""

import shutil
from pathlib import Path

import pytest

from helpers.fuzz.inputs import KINDS, outcome_of

COUNTS = {"problem": 80, "moveit": 80, "mesh": 80, "urdf": 80, "bundle": 50, "upload": 50, "weights": 50, "cloud": 500}
COUNTS |= {"result": 200, "http": 120, "socket": 60, "motion": 30, "certificate": 120, "depth": 40, "head": 250}
COUNTS |= {"settings": 40, "npz": 40}
SLOW = {"settings", "socket"}
"""These load PyTorch, or start a server."""


@pytest.mark.parametrize("others", [False, pytest.param(True, marks=pytest.mark.slow)])
@pytest.mark.parametrize("kind", [pytest.param(kind, marks=pytest.mark.slow if kind in SLOW else ()) for kind in KINDS])
def test_damaged_inputs(kind: str, others: bool, tmp_path: Path) -> None:
    """The quick suite makes every fifth input, the slow tests make the others."""
    faults = []
    for seed in (seed for seed in range(COUNTS[kind]) if (seed % 5 > 0) == others):
        folder = tmp_path / str(seed)
        folder.mkdir()
        outcome, said = outcome_of(kind, seed, folder)
        if outcome == "fault":
            faults.append(f"{kind} {seed}: {said}")
        shutil.rmtree(folder)
    assert not faults


ONCE_FAILED = {
    "brackets in weights": ("weights", 50009884),
    "a lens of 1e-300 pixels": ("depth", 50020386),
    "1e25 levels": ("settings", 50036692),
    "a long joint name": ("result", 50057525),
    "a long link name": ("weights", 50164958),
}


@pytest.mark.parametrize(("kind", "seed"), ONCE_FAILED.values(), ids=ONCE_FAILED)
def test_inputs_that_once_failed(kind: str, seed: int, tmp_path: Path) -> None:
    outcome, said = outcome_of(kind, seed, tmp_path)
    assert outcome == "error", said
