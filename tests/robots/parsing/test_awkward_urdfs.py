"""Awkward URDFs: each is prepared and plans a motion, or raises a one-line error that says what to do."""

from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

import robotdiffuse as rd
from helpers.awkward_urdfs import REFUSED, WORKS
from helpers.box_arm import boxes
from helpers.made_arms import BALL, chain, joint, link, row, written
from helpers.quick_preparation import QUICK, coarse_grids
from helpers.refusals import refuses
from robotdiffuse.collision import CollisionChecker
from robotdiffuse.robots.fitting import preparation
from robotdiffuse.robots.fitting.preparation import LARGE_REACH, PreparationSettings, add_robot
from robotdiffuse.robots.fitting.self_collisions import FalseCollisions
from robotdiffuse.robots.parsing.urdf import UrdfTree

PREPARED = {"a gantry", "names with slashes and spaces", "tiny links", "links without geometry", "xacro"}
PREPARED |= {"a mesh with degenerate triangles"}
"""Cases that the quick suite prepares; it reads the others, of which most differ for the reader alone."""


@pytest.mark.parametrize("name", [name for name in WORKS if name not in PREPARED])
def test_awkward_arms_are_read(name: str, tmp_path: Path) -> None:
    make, dof = WORKS[name]
    tree = UrdfTree(make(tmp_path), {})
    made = tree.robot(None, None, None)
    assert made.dof == dof and made.meshes and all(tree.surfaces(part) for part in made.meshes)


@pytest.mark.parametrize("name", [pytest.param(name, marks=[] if name in PREPARED else [pytest.mark.slow]) for name in WORKS])
def test_awkward_arms_are_prepared_and_plan(name: str, tmp_path: Path) -> None:
    if name == "xacro":
        pytest.importorskip("xacrodoc")
    make, dof = WORKS[name]
    with coarse_grids():
        report = add_robot(make(tmp_path), out=tmp_path / "robot", settings=QUICK)
    made = report.robot
    assert made.dof == dof and all(part.covered for part in report.links)
    q = np.random.default_rng(0).uniform(made.lower, made.upper, (2000, dof))
    q = q[CollisionChecker(made, rd.Scene()).free(q)]
    near = q[0] + np.array([[0.1], [0.03], [0.01], [0.001]]) * ((made.lower + made.upper) / 2 - q[0])
    problem = rd.Problem(made, rd.Scene(), q[0], near[CollisionChecker(made, rd.Scene()).free(near)][0])
    result = rd.load_planner("rrt_connect").plan(problem, time_limit=10.0)
    assert result.solved and result.path is not None, result.reason
    assert rd.verify(problem, result.path).valid


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_work_is_refused_by_one_line_that_says_what_to_do(name: str, tmp_path: Path) -> None:
    make, message = REFUSED[name]
    refuses(message, add_robot, make(tmp_path), out=tmp_path / "robot", settings=QUICK)
    assert not (tmp_path / "robot").exists()


def on_a_lift(folder: Path) -> Path:
    """An arm on a lift, with bellows on two locked joints that always overlap the column behind it."""
    column = '<collision><origin xyz="-0.2 0 0.2"/><geometry><box size="0.05 0.05 0.6"/></geometry></collision>'
    lift = joint("lift", "base", "lift_link", "prismatic", axis="0 0 1", limits='lower="0" upper="0.2"')
    short = {"kind": "prismatic", "axis": "0 0 1", "limits": 'lower="0" upper="0.6"'}
    names = row("bellows", 2)
    parents = ["lift_link", *(f"{name}_link" for name in names)]
    bellows = [
        link(f"{name}_link", BALL if name == names[-1] else "")
        + joint(name, above, f"{name}_link", xyz="0 0 0" if i else "-0.2 0 0", **short)
        for i, (name, above) in enumerate(zip(names, parents, strict=False))
    ]
    stand = link("column", column) + joint("stand", "base", "column", "fixed", xyz="0 0 0")
    return written(folder, stand, link("lift_link"), lift, *bellows, chain("lift_link", row("j", 3)))


def test_an_arm_that_is_never_free_is_refused_with_the_pair_to_allow(tmp_path: Path) -> None:
    """Regression: no configuration of the vendor's Fetch was free, but the exit status was 0."""
    pair = ("column", "bellows2_link")
    how = {"base": "base", "tip": "j3_link", "out": tmp_path / "robot", "settings": QUICK}
    with coarse_grids():
        text = refuses("collides with itself in every configuration", add_robot, on_a_lift(tmp_path), **how)
    assert f"{pair[0]} and {pair[1]} collide in 100.0%" in text and "--srdf FILE" in text
    assert f"--allow {pair[0]} {pair[1]}" in text and text.count("--allow") == 1
    assert not (tmp_path / "robot").exists()
    with coarse_grids():
        assert add_robot(on_a_lift(tmp_path), allow=[pair], **how).false_collisions.free > 0.2


def test_an_arm_whose_spheres_always_collide_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Regression: a PR2, with which nothing could be planned, was written with the exit status 0."""
    pair = Mock(links=("a", "b"), colliding=0.0, by_spheres=1.0)
    prepared = Mock(false_collisions=FalseCollisions(0.7, 0.0, 1.0, (pair,)))
    monkeypatch.setattr(preparation, "prepare", lambda *_: prepared)
    message = "a and b collide in 100.0%; .*--allow a b,"
    refuses(message, add_robot, on_a_lift(tmp_path), base="base", tip="j3_link", out=tmp_path / "robot")
    assert not (tmp_path / "robot").exists()


def test_parts_are_finer_where_they_touch_in_vain(tmp_path: Path) -> None:
    """Regression: goals of Fetch and Baxter collided, since the arm touches convex parts of the torso, but not the torso."""
    sides = (((x, -0.2, 0.05), (x + 0.05, 0.2, 0.4)) for x in (0.25, -0.3))
    boxes(((-0.3, -0.2, 0), (0.3, 0.2, 0.05)), *sides).export(tmp_path / "trough.stl")
    mesh = '<collision><geometry><mesh filename="trough.stl"/></geometry></collision>'
    stand = link("trough", mesh) + joint("stand", "base", "trough", "fixed", xyz="-0.1 0 -0.1")
    urdf = written(tmp_path, stand, chain("base", row("j", 3)))
    settings = replace(QUICK, parts=replace(QUICK.parts, most=1), samples=400)
    refused = []
    for finer in (False, True):
        with coarse_grids(), pytest.MonkeyPatch.context() as patch:
            if not finer:
                patch.setattr(preparation, "with_finer_parts", lambda *_: None)
            report = add_robot(urdf, tip="j3_link", out=tmp_path / str(finer), settings=settings)
        refused.append(report.false_collisions.by_parts)
        assert all(made.covered for made in report.links)
    assert refused[1] < 0.5 * refused[0]


def test_an_arm_on_a_long_rail_is_no_larger(tmp_path: Path) -> None:
    rail = chain("base", ["rail"], kind="prismatic", limits='lower="-9" upper="9"')
    counts = []
    for parts in (rail + chain("rail_link", row("j", 4)), chain("base", ["rail", *row("j", 4)])):
        with coarse_grids():
            report = add_robot(written(tmp_path, parts), out=tmp_path / "robot", settings=QUICK)
        counts.append(report.sphere_count)
    assert counts[0] == counts[1]


def test_settings_are_those_of_arms_of_up_to_a_meter_and_a_half() -> None:
    settings = PreparationSettings()
    assert settings.for_reach(0.9) == settings
    twice = settings.for_reach(2 * LARGE_REACH)
    assert twice.spheres.first_half == 2 * settings.spheres.first_half and twice.finest == 2 * settings.finest
    assert twice.parts.concavity == 2 * settings.parts.concavity and twice.parts.most == settings.parts.most
