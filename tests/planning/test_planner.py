"""Properties of every planner in the table: solved means verified, anything else comes with a reason."""

import inspect
import traceback
from dataclasses import fields, replace

import numpy as np
import pytest

import robotdiffuse as rd
from helpers.panda import HOME, LEFT, PANDA, RIGHT
from helpers.refusals import refuses
from robotdiffuse.planning import DEFAULT_PLANNER, PLANNERS, SEARCH
from robotdiffuse.planning.context import PlanRequest
from robotdiffuse.planning.planner import Planner
from robotdiffuse.planning.search import rrt_kernel
from robotdiffuse.problems.held_out import held_out_problem

GOAL = HOME + np.array([1.2, 0.3, 0.0, 0.4, 0.0, 0.0, 0.0])
OTHER_ARGUMENTS = ("self", "problem", "planner", "settings")
"""Arguments of `plan` that are not of the request."""


@pytest.fixture(params=PLANNERS)
def name(request: pytest.FixtureRequest) -> str:
    if request.param.startswith("ompl_"):
        pytest.importorskip("ompl", reason="the extra `baselines` (ompl) is not installed")
    return request.param


@pytest.mark.parametrize("number", [0, 4])
def test_solved_means_verified(name: str, number: int) -> None:
    problem = held_out_problem("rop", number)
    result = rd.load_planner(name).plan(problem, time_limit=0.5, seed=number)
    assert result.planner == name and result.reason
    assert (result.path is not None) == (result.trajectory is not None) == result.solved
    if result.path is None or result.trajectory is None:
        assert result.progress == ()
        return
    assert rd.verify(problem, result.path).valid and rd.verify(problem, result.trajectory).valid
    times, lengths = np.array(result.progress).T
    assert (np.diff(times) >= 0).all() and (np.diff(lengths) < 0).all()
    assert lengths[-1] == pytest.approx(result.path.length)


def test_a_goal_in_collision_is_reported_and_time_limit_and_seed_are_checked(name: str) -> None:
    problem = rd.Problem(PANDA, rd.Scene([rd.Sphere((0.2, 0.5, 0.5), 0.3)]), HOME, GOAL)
    planner = rd.load_planner(name)
    result = planner.plan(problem, time_limit=30.0)
    assert result.status is rd.Status.INVALID_GOAL and "in collision" in result.reason
    for wrong, message in (({"time_limit": 0.0}, "time_limit is 0"), ({"seed": -1}, "seed is -1")):
        refuses(message, planner.plan, problem, **wrong)


def test_weights_are_for_learned_planners_alone(name: str) -> None:
    learned = PLANNERS[name].kind != SEARCH
    with pytest.raises(rd.InputError, match="nowhere" if learned else "has no weights"):
        rd.load_planner(name, weights="nowhere").plan(rd.Problem(PANDA, rd.Scene([]), HOME, GOAL))


def test_plan_takes_the_fields_of_a_request() -> None:
    request = [(field.name, field.default) for field in fields(PlanRequest)]
    arguments = list(inspect.signature(rd.plan).parameters.values())
    arguments = [argument for argument in arguments if argument.name not in OTHER_ARGUMENTS]
    assert [(argument.name, argument.default) for argument in arguments] == request


def test_plan_with_a_planner_and_settings_by_name() -> None:
    problem = rd.Problem(PANDA, rd.Scene(), HOME, GOAL)
    first = rd.plan(problem, planner="aorrtc", settings={"range": 0.5, "keep_trees": True})
    assert first.solved and first.planner == "aorrtc"
    nested = rd.load_planner("diffusion", {"guidance": {"margin": 0.03}, "guidance.self_margin": 0.02})
    assert (nested.settings.guidance.margin, nested.settings.guidance.self_margin) == (0.03, 0.02)  # type: ignore[attr-defined]
    refuses(r"patience=16000; did you mean range\?", rd.plan, problem, planner="aorrtc", settings={"rang": 1})
    refuses(r"aorrtc\.range is -1\.0", rd.plan, problem, planner="aorrtc", settings={"range": -1.0})
    refuses("settings is 'range=1'; it must be a table", rd.plan, problem, planner="aorrtc", settings="range=1")


def test_the_default_planner_is_aorrtc_and_needs_no_weights() -> None:
    panda = replace(PANDA, name="stranger")
    problem = rd.Problem(panda, rd.Scene([rd.Sphere([0.5, 0.0, 0.4], 0.15, name="ball")]), LEFT, RIGHT)
    names = (DEFAULT_PLANNER, "aorrtc")
    first, second = (rd.load_planner(name).plan(problem, 60.0, seed=3) for name in names)
    assert np.array_equal(first.path.positions, second.path.positions)
    assert (first.planner, second.planner) == names and first.stage == "aorrtc" and not first.notes


def test_warming_up_loads_what_a_plan_needs_by_default() -> None:
    # it ended at first paths, and the first plan then compiled the search for the fastest motion (10 s)
    assert inspect.signature(Planner.warm_up).parameters["until"].default == PlanRequest().until
    results = rd.load_planner("aorrtc").warm_up(rd.Problem(PANDA, rd.Scene([]), HOME, GOAL))
    rows = [len(result.path.positions) for result in results if result.path]
    assert rows[0] == 2 and max(rows) > 2, "balls in the way make corners"


def test_at_most_nine_functions_lead_to_the_search(monkeypatch: pytest.MonkeyPatch) -> None:
    """docs/architecture.md lists these functions; the type checks of the tests do not count."""
    depths = set[int]()
    search = rrt_kernel.search

    def measured(*arguments: object) -> object:
        frames = [frame for frame, _ in traceback.walk_stack(None)]
        own = [frame for frame in frames if frame.f_globals["__name__"].startswith("robotdiffuse.")]
        depths.add(sum(not frame.f_code.co_filename.startswith("<@beartype") for frame in own))
        return search(*arguments)

    monkeypatch.setattr(rrt_kernel, "search", measured)
    assert rd.plan(rd.Problem(PANDA, rd.Scene([rd.Box([0.45, 0.0, 0.4], [0.3, 0.05, 0.8])]), LEFT, RIGHT)).solved
    assert depths and max(depths) <= 9
