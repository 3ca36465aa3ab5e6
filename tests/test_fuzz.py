"""Damaged inputs, each with an answer or a one-line error; `benchmarks/robustness.py` runs more."""

import shutil
from pathlib import Path

import pytest

from helpers.fuzz.inputs import KINDS, outcome_of

COUNTS = {
    "problem": 80,
    "moveit": 80,
    "cloud": 500,
    "mesh": 80,
    "urdf": 80,
    "result": 200,
    "bundle": 50,
    "http": 120,
    "socket": 60,
    "motion": 30,
    "certificate": 120,
    "depth": 40,
    "upload": 50,
    "head": 250,
    "settings": 40,
    "weights": 50,
    "npz": 40,
}


SLOW = {"settings", "socket"}
"""These load PyTorch, or start a server."""


@pytest.mark.parametrize("every", [5, pytest.param(1, marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    "kind", [pytest.param(kind, marks=pytest.mark.slow if kind in SLOW else ()) for kind in KINDS]
)
def test_damaged_inputs(kind: str, every: int, tmp_path: Path) -> None:
    faults = []
    for seed in range(0, COUNTS[kind], every):
        folder = tmp_path / str(seed)
        folder.mkdir()
        outcome, said = outcome_of(kind, seed, folder)
        if outcome == "fault":
            faults.append(f"{kind} {seed}: {said}")
        shutil.rmtree(folder)
    assert not faults


@pytest.mark.parametrize(
    ("kind", "seed"),
    [
        ("weights", 50009884),
        ("depth", 50020386),
        ("settings", 50036692),
        ("result", 50057525),
        ("weights", 50164958),
    ],
    ids=[
        "brackets in weights",
        "a lens of 1e-300 pixels",
        "1e25 levels",
        "a long joint name",
        "a long link name",
    ],
)
def test_inputs_that_once_failed(kind: str, seed: int, tmp_path: Path) -> None:
    outcome, said = outcome_of(kind, seed, tmp_path)
    assert outcome == "error", said
