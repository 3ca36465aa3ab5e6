"""The same seed gives the same motion: in a second call, and in a process with another number of threads."""

from functools import partial
from pathlib import Path

import numpy as np
import pytest

import robotdiffuse as rd
from helpers.commands import python
from robotdiffuse.validation.report import Report, Violation
from robotdiffuse.validation.validator import Verifier

SHELF = Path(__file__).parents[2] / "src" / "robotdiffuse" / "examples" / "shelf.yaml"
PLANNERS = ("rrt_connect", "aorrtc", "shared_tree_rrt_star", "diffusion", "robotdiffuse")
TWICE = f"""
import hashlib
import robotdiffuse as rd
from robotdiffuse.core.loading import compiled

problem = rd.load_problem({str(SHELF)!r})
for name in {PLANNERS}:
    planner = rd.load_planner(name)
    for _ in range(2):
        motion = planner.plan(problem, 60.0, seed=3).trajectory
        print(name, hashlib.sha256(motion.times.tobytes() + motion.positions.tobytes()).hexdigest())
print("compiled", len(compiled))
"""


def motions(threads: int) -> list[str]:
    """A line for each motion, by a process that does not compile: in one that compiles, the last bits may differ."""
    counts = dict.fromkeys(("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "MKL_NUM_THREADS"), str(threads))
    for _ in range(2):
        *lines, compiled = python(TWICE, 0, **counts).stdout.splitlines()
        if compiled == "compiled 0":
            break
    return lines


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_the_same_seed_gives_the_same_motion() -> None:
    here = motions(1)
    there = motions(2)
    assert len(here) == 2 * len(PLANNERS)
    assert here[::2] == here[1::2], "twice in one process"
    assert here == there, "in another process with other threads"


@pytest.mark.parametrize("planner", ["aorrtc", "rrt_connect"])
def test_the_first_call_and_later_ones_give_the_same_path_although_paths_are_refused(planner, monkeypatch):
    """Regression: the duration of earlier validations decided when later calls validated, which changes their search."""
    accepted = Verifier.path
    refusals = list[float]()

    def refuses_some(verifier: Verifier, path: rd.Path) -> Report:
        report = accepted(verifier, path)
        if int(path.length * 1e9) % 3:
            return report
        refusals.append(path.length)
        return Report(False, Violation("scene_collision", 0.0, "refused by the test"), None, None)

    call = partial(rd.plan, rd.load_problem(SHELF), 60.0, planner=planner)
    monkeypatch.setattr(Verifier, "path", refuses_some)
    first = call(seed=1)
    refused = len(refusals)
    assert refused > 0
    for seed in range(2, 4):
        other = call(seed=seed, until="first").path
    refusals.clear()
    later = call(seed=1)
    assert len(refusals) == refused
    assert np.array_equal(first.path.positions, later.path.positions)
    assert not np.array_equal(first.path.positions, other.positions)
