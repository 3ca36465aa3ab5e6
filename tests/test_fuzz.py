"""Some thousand damaged inputs: each gives an answer or a one-line error."""

import shutil
from pathlib import Path

import pytest

from helpers.fuzz.inputs import KINDS, outcome_of

COUNTS = {
    "problem": 150,
    "moveit": 150,
    "cloud": 1000,
    "mesh": 150,
    "urdf": 200,
    "result": 400,
    "bundle": 100,
    "http": 300,
    "socket": 120,
    "motion": 50,
    "certificate": 250,
    "depth": 60,
    "upload": 120,
    "head": 500,
    "settings": 80,
    "weights": 100,
    "npz": 80,
}


@pytest.mark.parametrize("kind", KINDS)
def test_damaged_inputs(kind: str, tmp_path: Path) -> None:
    faults = []
    for seed in range(COUNTS[kind]):
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
