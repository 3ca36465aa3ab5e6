"""Data by AORRTC: what the paper's planner promises of its data holds for its too."""

from dataclasses import replace
from pathlib import Path as FilePath
from typing import Any

import numpy as np
import pytest

from helpers.factory_runs import in_this_process
from robotdiffuse.collision import CollisionChecker
from robotdiffuse.core.errors import InputError
from robotdiffuse.core.types import Path
from robotdiffuse.generation import GenerationSettings, factory, generate
from robotdiffuse.generation.aorrtc_solver import AORRTCSearchSettings
from robotdiffuse.generation.factory import SEARCHES, draw, solve
from robotdiffuse.robots import load_robot
from robotdiffuse.validation.validator import verify

SETTINGS = GenerationSettings(
    mix={"rop_dense": 1.0},
    goals=4,
    waypoints=32,
    trivial_share=0.0,
    planner="aorrtc",
    search=AORRTCSearchSettings(),
)


def rows_of(settings: GenerationSettings, count: int) -> list[tuple[int, dict[str, Any]]]:
    robot = load_robot(settings.robot)
    found = []
    number = 0
    while len(found) < count:
        row = solve(settings, robot, number)
        if not isinstance(row, str):
            found.append((number, dict(row)))
        number += 1
    return found


@pytest.mark.parametrize("name", ["panda", "ur5e"])
def test_motions_are_free_reach_a_goal_and_keep_their_distance(name: str) -> None:
    settings = replace(SETTINGS, robot=name)
    robot = load_robot(name)
    for number, row in rows_of(settings, 3):
        drawn = draw(settings, robot, np.random.default_rng([settings.seed, number]))[1]
        q = np.asarray(row["trajectories"], np.float64)
        assert verify(drawn.problem(robot), Path(robot.joint_names, q)).valid
        goal = row["goals"][row["goal_index"]]
        np.testing.assert_array_equal(q[-1], goal)
        assert np.isfinite(row["goal_costs"]).sum() == 1
        length = np.linalg.norm(np.diff(q, axis=0), axis=1).sum()
        assert length == pytest.approx(row["goal_costs"][row["goal_index"]], rel=0.02)
        checker = CollisionChecker(robot, drawn.scene)
        clearances = checker.link_clearances(q).min(axis=1)
        assert clearances.min() >= min(row["safety_distance"], *clearances[[0, -1]]) - 0.004


def test_the_same_number_gives_the_same_row() -> None:
    robot = load_robot("panda")
    [(number, row)] = rows_of(SETTINGS, 1)
    again = solve(SETTINGS, robot, number)
    assert not isinstance(again, str)
    for name, value in row.items():
        np.testing.assert_array_equal(again[name], value)


def test_goals_a_turn_away_are_taken_the_short_way() -> None:
    """Of an arm whose joints turn twice, a seventh of the motions went the long way round, to a goal that the
    validator did not know."""
    robot = load_robot("ur5e")
    far = list[int]()
    settings = GenerationSettings(robot="ur5e", mix={"rop": 1.0}, target="pose", goals=1, waypoints=16)
    turning = robot.upper - robot.lower > 2 * np.pi + 0.1
    for number in range(60):
        drawn = draw(settings, robot, np.random.default_rng([settings.seed, number]))[1]
        if np.abs(drawn.goals[0] - drawn.start)[turning].max() > np.pi:
            far.append(number)
            row = solve(settings, robot, number)
            assert row != "refused"
            if not isinstance(row, str):
                assert np.abs(np.asarray(row["goals"])[0] - drawn.start)[turning].max() <= np.pi + 1e-6
        if len(far) == 3:
            return
    pytest.fail(f"only {len(far)} such problems")


def test_settings_are_those_of_the_planner() -> None:
    with pytest.raises(InputError, match="planner is aorrtc, but its settings are SharedTreeSettings"):
        GenerationSettings(planner="aorrtc")
    with pytest.raises(InputError, match=r"planner 'bi_rrt'; known: aorrtc, shared_tree_rrt_star"):
        GenerationSettings(planner="bi_rrt")
    assert GenerationSettings.from_json(SETTINGS.to_json(), "settings") == SETTINGS
    assert SEARCHES.defaults("aorrtc") == SETTINGS.search


def test_a_data_set_continues_with_its_own_planner_only(
    tmp_path: FilePath, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(factory, "on_this_machine", in_this_process)
    settings = GenerationSettings(trajectories=2, shard=1, waypoints=8)
    assert generate(settings, tmp_path) == 2
    with pytest.raises(InputError, match=r'begun with planner "shared_tree_rrt_star", not "aorrtc"'):
        generate(replace(settings, planner="aorrtc", search=AORRTCSearchSettings()), tmp_path)
