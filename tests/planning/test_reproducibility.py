"""The same seed gives the same path in another process with another number of threads."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

import robotdiffuse as rd
from robotdiffuse.problems.files import load_problem

SOURCE = Path(__file__).parents[2] / "src" / "robotdiffuse"
SHELF = SOURCE / "examples" / "shelf.yaml"


@pytest.mark.parametrize("planner", ["rrt_connect", "aorrtc"])
def test_another_process_with_other_threads_finds_the_same_path(planner: str) -> None:
    code = (
        "import sys, robotdiffuse as rd\n"
        f"result = rd.load_planner({planner!r}).plan(rd.load_problem(sys.argv[1]), 60.0, seed=3)\n"
        "print(result.path.positions.tobytes().hex())"
    )
    threads = {"OMP_NUM_THREADS": "2", "NUMBA_NUM_THREADS": "2", "MKL_NUM_THREADS": "2"}
    there = subprocess.run(
        [sys.executable, "-c", code, str(SHELF)],
        env=os.environ | threads | {"PYTHONPATH": str(SOURCE.parent)},
        capture_output=True,
        text=True,
        check=True,
    )
    here = rd.load_planner(planner).plan(load_problem(SHELF), 60.0, seed=3)
    assert here.path is not None
    assert there.stdout.strip() == here.path.positions.tobytes().hex()
