"""Awkward URDFs: each is prepared and plans a motion, or is refused by one line that says what to do."""

from pathlib import Path

import numpy as np
import pytest

from helpers.awkward_urdfs import REFUSED, WORKS
from helpers.made_arms import BALL, chain, row, written
from helpers.quick_preparation import QUICK, coarse_grids
from robotdiffuse.collision import CollisionChecker
from robotdiffuse.core.errors import InputError
from robotdiffuse.planning import load_planner
from robotdiffuse.problems.problem import Problem
from robotdiffuse.robots.fitting.add import add_robot
from robotdiffuse.robots.fitting.preparation import LARGE, PreparationSettings
from robotdiffuse.robots.scaling import reach
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.validation.validator import verify


@pytest.mark.parametrize("name", WORKS)
def test_awkward_arms_are_prepared_and_plan(name: str, tmp_path: Path) -> None:
    if name == "xacro":
        pytest.importorskip("xacrodoc")
    make, dof = WORKS[name]
    with coarse_grids():
        report = add_robot(make(tmp_path), out=tmp_path / "robot", settings=QUICK)
    made = report.robot
    assert made.dof == dof and all(part.covered for part in report.links)
    rng = np.random.default_rng(0)
    q = rng.uniform(made.lower, made.upper, (2000, dof))
    q = q[CollisionChecker(made, Scene()).free(q)]
    near = q[0] + np.array([[0.1], [0.03], [0.01], [0.001]]) * ((made.lower + made.upper) / 2 - q[0])
    problem = Problem(made, Scene(), q[0], near[CollisionChecker(made, Scene()).free(near)][0])
    result = load_planner("rrt_connect").plan(problem, time_limit=10.0)
    assert result.solved and result.path is not None, result.reason
    assert verify(problem, result.path).valid


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_work_is_refused_by_one_line_that_says_what_to_do(name: str, tmp_path: Path) -> None:
    make, message = REFUSED[name]
    with pytest.raises(InputError, match=message) as error:
        add_robot(make(tmp_path), out=tmp_path / "robot", settings=QUICK)
    assert "\n" not in str(error.value)
    assert not (tmp_path / "robot").exists()


def test_an_arm_four_times_as_large_takes_no_more_spheres(tmp_path: Path) -> None:
    """An ABB IRB140 of which a package holds a model with 3 m of reach took over 400 s: spheres 15 mm from
    links of 2 m."""
    counts = []
    for size in (2, 8):
        length, width = 0.4 * size, 0.06 * size
        box = (
            f'<collision><origin xyz="0 0 {length / 2}"/><geometry><box size="{width} {width} {length}"/>'
            "</geometry></collision>"
        )
        parts = chain("base", row("j", 4), xyz=f"0 0 {length}").replace(BALL, box)
        report = add_robot(written(tmp_path, parts), out=tmp_path / f"{size}", settings=QUICK)
        assert all(part.covered for part in report.links) and reach(report.robot) > LARGE
        counts.append(report.sphere_count)
    assert counts[1] == pytest.approx(counts[0], rel=0.2) and min(counts) > 10


def test_an_arm_on_a_long_rail_is_no_larger(tmp_path: Path) -> None:
    rail = chain("base", ["rail"], kind="prismatic", limits='lower="-9" upper="9"')
    counts = []
    for parts in (rail + chain("rail_link", row("j", 4)), chain("base", ["rail", *row("j", 4)])):
        report = add_robot(written(tmp_path, parts), out=tmp_path / "robot", settings=QUICK)
        counts.append(report.sphere_count)
    assert counts[0] == counts[1]


def test_settings_are_those_of_arms_of_up_to_a_metre_and_a_half() -> None:
    settings = PreparationSettings()
    assert settings.for_reach(0.9) == settings
    twice = settings.for_reach(2 * LARGE)
    assert twice.spheres.first_half == 2 * settings.spheres.first_half and twice.finest == 2 * settings.finest
    assert twice.parts.concavity == 2 * settings.parts.concavity and twice.parts.most == settings.parts.most
