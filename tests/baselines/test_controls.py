"""Controls: the straight line, fixed vias, nearest motions, smooth noise."""

import numpy as np
import pytest

import robotdiffuse as rd
from helpers.example_robots import planar_arm
from helpers.panda import LEFT, PANDA, RIGHT
from helpers.refusals import refuses
from robotdiffuse.baselines import controls
from robotdiffuse.collision import CollisionChecker
from robotdiffuse.learning.exported_model import exported_model

WALL = rd.Scene([rd.Box([0.45, 0.0, 0.4], [0.3, 0.05, 0.4], name="wall")])


@pytest.mark.parametrize("given", [{}, {"source": controls.VIAS, "guidance_steps": 0}], ids=[controls.NOISE, controls.VIAS])
def test_a_wall_that_blocks_the_line_is_passed_by_candidates(given: dict) -> None:
    settings = controls.ControlSettings(**given)
    found = controls.Control(settings).plan(rd.Problem(PANDA, WALL, LEFT, rd.JointGoal([RIGHT])), 20.0)
    assert found.solved and found.stage == settings.source


def test_vias_are_free_and_on_the_candidates_and_for_a_panda_with_all_joints() -> None:
    vias = controls.fixed_vias(PANDA)
    assert vias.shape == (16, 7)
    checker = CollisionChecker(PANDA, rd.Scene())
    assert checker.free(vias).all()
    control = controls.Control(controls.ControlSettings(source=controls.VIAS, samples=3, guidance_steps=0))
    q = control.candidates(LEFT, RIGHT[None], checker, np.random.default_rng(0))
    assert (q[:, 0] == LEFT).all() and (q[:, -1] == RIGHT).all()
    np.testing.assert_array_equal(q[:, q.shape[1] // 2], vias[:3])
    refuses("only the panda", controls.fixed_vias, planar_arm(0.5, 0.4))
    refuses("only the panda", controls.fixed_vias, rd.load_robot("panda", locked={"panda_joint3": 0.0}))


def test_the_nearest_motions_need_data_and_are_bent_to_start_and_goal(monkeypatch: pytest.MonkeyPatch) -> None:
    ends = np.array([[[0.0, 0.0], [1.0, 1.0]], [[3.0, 0.0], [0.1, 0.0]]])
    motions = np.stack([ends[:, 0], ends.mean(1) + np.array([0.0, 0.5]), ends[:, 1]], axis=1)
    start, goal = np.array([0.0, 0.1]), np.array([3.0, 0.0])
    first, second = controls.bent(motions, start, goal, 2)
    # backwards, by half of each difference
    np.testing.assert_allclose(first, np.stack([start, [1.5, 0.55], goal]))
    np.testing.assert_allclose(second[[0, -1]], [start, goal])
    monkeypatch.setattr(controls, "read_manifest", lambda data: None)
    monkeypatch.setattr(controls, "library", lambda data, robot: np.stack([[LEFT, RIGHT]] * 2))
    control = controls.Control(controls.ControlSettings(source=controls.NEAREST, data="data", samples=1, guidance_steps=0))
    q = control.candidates(LEFT, RIGHT[None], CollisionChecker(PANDA, WALL), np.random.default_rng(0))
    np.testing.assert_allclose(q, [[LEFT, RIGHT]])
    refuses("needs data", controls.ControlSettings, source=controls.NEAREST)
    refuses("needs data", controls.ControlSettings, data="of other controls")


def test_smooth_noise_has_the_covariance_of_the_pandas_weights_and_keeps_ends_and_limits() -> None:
    rng = np.random.default_rng(1)
    middle = 0.5 * (PANDA.lower + PANDA.upper)
    q = controls.smooth_noise(middle, middle[None], 4000, 48, PANDA, rng) - middle
    rows = np.moveaxis(q / np.minimum(0.5 * (PANDA.upper - PANDA.lower), controls.MAX_HALF_RANGE), 1, 2).reshape(-1, 48)
    assert abs(rows.std() - controls.SPREAD) < 0.005
    factor = exported_model("model", None, PANDA).statistics.noise_factor.astype(np.float64)
    shares = [np.linalg.eigvalsh(c)[::-1] / np.trace(c) for c in (rows.T @ rows, factor @ factor.T)]
    assert np.abs(shares[0] - shares[1]).max() < 0.012
    goals = np.stack([middle, middle + 0.1]).astype(np.float32)
    q = controls.smooth_noise(PANDA.lower, goals, 5, 48, PANDA, rng)
    lower, upper = PANDA.lower.astype(np.float32), PANDA.upper.astype(np.float32)
    assert q.dtype == np.float32 and (q[:, 0] == lower).all() and ((q >= lower) & (q <= upper)).all()
    assert np.array_equal(q[:, -1], goals[[0, 1, 0, 1, 0]])


def test_any_goal_is_tried_where_the_nearest_is_blocked() -> None:
    free = np.append(2.8, RIGHT[1:])
    problem = rd.Problem(PANDA, WALL, LEFT, rd.JointGoal([RIGHT, free]))
    found = controls.StraightLine().plan(problem, 5.0)
    assert found.solved
    np.testing.assert_array_equal(found.path.positions, [LEFT, free])
    alone = controls.StraightLine(controls.StraightLineSettings(goals=controls.NEAREST_GOAL)).plan(problem, 5.0)
    assert not alone.solved and alone.refused == "scene_collision"
    assert "the straight line is refused" in alone.reason
