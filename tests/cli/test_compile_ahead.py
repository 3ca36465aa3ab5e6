"""The second process of a first plan."""

import subprocess
import sys
from importlib.resources import files

import pytest

import robotdiffuse as rd
from robotdiffuse.cli.compile_ahead import compiling_ahead, steps
from robotdiffuse.collision.kernels.motion_certificate import rounds
from robotdiffuse.core import loading
from robotdiffuse.trajectories.timing_kernel import fastest_speeds


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
    """Commands of the processes that were started."""
    commands: list[list[str]] = []
    monkeypatch.setattr(subprocess, "Popen", lambda command, **_: commands.append(command))
    monkeypatch.setattr("os.cpu_count", lambda: 2)
    return commands


def test_only_the_first_compilation_starts_a_process_and_none_a_warm_start_or_a_single_core(started, monkeypatch) -> None:
    with compiling_ahead(picture=True):
        assert started == []
        loading.compiles("one")
        loading.compiles("two")
    loading.compiles("three")
    with compiling_ahead(picture=False):
        pass
    loading.compiles("after the block")
    monkeypatch.setattr("os.cpu_count", lambda: 1)
    with compiling_ahead(picture=False):
        loading.compiles("on one core")
    assert started == [[sys.executable, "-m", "robotdiffuse.cli.compile_ahead", "picture"]]


def test_it_compiles_what_a_plan_calls() -> None:
    problem = rd.load_problem(str(files("robotdiffuse") / "examples" / "shelf.yaml"))
    assert rd.plan(problem, time_limit=5.0).solved
    of_a_plan = set(rounds.signatures), set(fastest_speeds.signatures)
    for step in steps(problem.robot, picture=True):
        step()
    assert (set(rounds.signatures), set(fastest_speeds.signatures)) == of_a_plan
