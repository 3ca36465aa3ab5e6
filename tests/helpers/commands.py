"""Runs commands in this process and code in others, and the problem of their tests."""

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import yaml

from robotdiffuse.cli import main

Said = Callable[..., str]
"""What a command with these words prints, to standard error if it is refused; its status comes first."""
START = [-1.0, 0.3, 0.0, -1.8, 0.0, 2.1, 0.8]
GOAL = [1.0, 0.3, 0.0, -1.8, 0.0, 2.1, 0.8]
BALL = {"sphere": {"center": [0.5, 0.0, 0.5], "radius": 0.15}}
PROBLEM = {"robot": "panda", "scene": [BALL], "start": START, "goal": {"joints": GOAL}}


def run(*argv: object) -> int:
    """Runs a command; returns its exit status."""
    try:
        return main([str(value) for value in argv])
    except SystemExit as end:
        assert isinstance(end.code, int)
        return end.code


def python(code: str, status: int = 0, **environment: str) -> subprocess.CompletedProcess[str]:
    """What a new Python process printed for this code; it must end with this exit status."""
    command = [sys.executable, "-c", code]
    ended = subprocess.run(command, capture_output=True, text=True, env=os.environ | environment, timeout=1500)
    assert ended.returncode == status, ended.stderr
    return ended


def written(folder: Path, data: object, name: str = "problem.yaml") -> Path:
    """Writes a file, as YAML if its name ends in that, else as JSON."""
    file = folder / name
    file.write_text(yaml.safe_dump(data) if file.suffix == ".yaml" else json.dumps(data))
    return file


def write_problem(folder: Path, name: str = "problem.json", **changes: object) -> Path:
    """Write PROBLEM, with changes, to a file."""
    return written(folder, PROBLEM | changes, name)
