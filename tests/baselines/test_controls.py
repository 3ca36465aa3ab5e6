"""Controls: fixed vias, nearest motions, smooth noise."""

from pathlib import Path

import numpy as np
import pytest

import robotdiffuse as rd
from helpers.example_robots import planar_arm
from robotdiffuse.baselines import controls
from robotdiffuse.baselines.controls import NEAREST, NOISE, VIAS, Control, ControlSettings
from robotdiffuse.collision import CollisionChecker
from robotdiffuse.core.errors import InputError

PANDA = rd.load_robot("panda")
START = np.array([0.9, 0.3, 0.0, -1.9, 0.0, 2.2, 0.785])
GOAL = np.array([-0.9, 0.3, 0.0, -1.9, 0.0, 2.2, 0.785])
WALL = rd.Scene([rd.Box([0.45, 0.0, 0.4], [0.3, 0.05, 0.4], name="wall")])


@pytest.mark.parametrize(
    "settings", [ControlSettings(), ControlSettings(source=VIAS, guidance_steps=0)], ids=[NOISE, VIAS]
)
def test_a_wall_that_blocks_the_line_is_passed_by_candidates(settings: ControlSettings) -> None:
    found = Control(settings).plan(rd.Problem(PANDA, WALL, START, rd.JointGoal([GOAL])), 20.0)
    assert found.solved and found.stage == settings.source


def test_vias_are_free_and_on_the_candidates() -> None:
    vias = controls.fixed_vias(PANDA)
    assert vias.shape == (16, 7)
    checker = CollisionChecker(PANDA, rd.Scene())
    assert checker.free(vias).all()
    control = Control(ControlSettings(source=VIAS, samples=3, guidance_steps=0))
    q = control.candidates(START, GOAL[None], checker, np.random.default_rng(0))
    assert (q[:, 0] == START).all() and (q[:, -1] == GOAL).all()
    np.testing.assert_array_equal(q[:, q.shape[1] // 2], vias[:3])
    with pytest.raises(InputError, match="only the panda"):
        controls.fixed_vias(planar_arm(0.5, 0.4))


def test_the_nearest_motions_are_bent_to_start_and_goal(monkeypatch: pytest.MonkeyPatch) -> None:
    ends = np.array([[[0.0, 0.0], [1.0, 1.0]], [[3.0, 0.0], [0.1, 0.0]]])
    motions = np.stack([ends[:, 0], ends.mean(1) + np.array([0.0, 0.5]), ends[:, 1]], axis=1)
    start, goal = np.array([0.0, 0.1]), np.array([3.0, 0.0])
    first, second = controls.bent(motions, start, goal, 2)
    # backwards, by half of each difference
    np.testing.assert_allclose(first, np.stack([start, [1.5, 0.55], goal]))
    np.testing.assert_allclose(second[[0, -1]], [start, goal])
    monkeypatch.setattr(controls, "library", lambda data, robot: np.stack([[START, GOAL]] * 2))
    control = Control(ControlSettings(source=NEAREST, data="data", samples=1, guidance_steps=0))
    q = control.candidates(START, GOAL[None], CollisionChecker(PANDA, WALL), np.random.default_rng(0))
    np.testing.assert_allclose(q, [[START, GOAL]])


def test_data_are_for_the_nearest_motions_alone(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="needs data"):
        ControlSettings(source=NEAREST)
    with pytest.raises(InputError, match="needs data"):
        ControlSettings(data=str(tmp_path))
