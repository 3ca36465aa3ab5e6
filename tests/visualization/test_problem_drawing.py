"""Drawings of problems without a motion: start, goal, and the links that collide."""

from pathlib import Path

import numpy as np
import pytest

import robotdiffuse as rd
from helpers.pages import page_data
from helpers.panda import GOAL, PANDA, START
from robotdiffuse.core.transforms import transform
from robotdiffuse.visualization.replay_page import COLLIDING, write_problem

AT_START = rd.Sphere(PANDA.fk(START, "panda_hand")[:3, 3], 0.05, "ball")
FAR = transform(np.array([1.5, 0.0, 0.0]))


def page(problem: rd.Problem, file: Path) -> dict:
    write_problem(problem, file)
    return page_data(file)


def marks(data: dict, color: tuple[int, int, int]) -> list[dict]:
    return [shape for shape in data["scene"] if tuple(shape["color"]) == color]


def test_links_that_collide_are_red(tmp_path: Path) -> None:
    problem = rd.Problem(PANDA, rd.Scene([AT_START]), START, GOAL)
    data = page(problem, tmp_path / "a.html")
    assert len(marks(data, COLLIDING)) == len(problem.is_free(START).links) > 0
    assert data["positions"] == [START.tolist(), GOAL.tolist()] and data["times"] == [0.0, 0.0]
    assert dict(data["facts"])["start"].endswith("inside ball") and dict(data["facts"])["goal"] == "free"
    assert not marks(page(rd.Problem(PANDA, rd.Scene(), START, GOAL), tmp_path / "b.html"), COLLIDING)


@pytest.mark.parametrize("moved", [False, True])
def test_a_goal_out_of_reach_has_axes(moved: bool, tmp_path: Path) -> None:
    problem = rd.Problem(PANDA, rd.Scene(), START, rd.PoseGoal("panda_hand", FAR))
    if moved:
        T = transform(np.array([1.0, 2.0, 0.5]))
        problem = rd.Problem.in_world(T, PANDA, rd.Scene(), START, rd.PoseGoal("panda_hand", T @ FAR))
    data = page(problem, tmp_path / "a.html")
    assert data["positions"] == [START.tolist()] and len(data["scene"]) == 3
    assert dict(data["facts"])["goal"] == "no configuration within the joint limits"


def test_of_several_goals_a_free_one_is_drawn(tmp_path: Path) -> None:
    problem = rd.Problem(PANDA, rd.Scene([AT_START]), GOAL, [START, GOAL])
    assert page(problem, tmp_path / "a.html")["positions"][1] == GOAL.tolist()
