"""Points that views add to a problem: only points on obstacles, with noise, with the arm in view, and beside known shapes."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy import ndarray

import robotdiffuse as rd
from helpers.panda import GOAL, PANDA, START
from helpers.refusals import refuses
from helpers.sphere_oracles import depth_of_balls
from robotdiffuse.collision import CollisionChecker
from robotdiffuse.core.transforms import transform
from robotdiffuse.perception import seen_points as shown
from robotdiffuse.perception.depth_filter import point_errors
from robotdiffuse.perception.depth_view import SeenPoints
from robotdiffuse.problems.files import problem_from_record, problem_record, save_problem

BALL = rd.Sphere([0.6, 0.0, 0.5], 0.15)
K = (150.0, 150.0, 79.5, 59.5)
T = transform(np.array([2.0, 0.0, 0.5]), np.array([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]))


def picture(balls: ndarray) -> ndarray:
    """The depth image of balls as seen from the pose T; 0 where there is no ball."""
    depth = depth_of_balls(balls, T, K, (160, 120))
    return np.where(np.isfinite(depth), depth, 0.0)


BALL_ROW = np.array([[*BALL.center, BALL.radius]])


def view(spheres: ndarray, configuration: ndarray | None = None) -> rd.DepthView:
    return rd.DepthView(picture(spheres), K, T, configuration)


def test_points_lie_on_what_was_seen_and_cover_it() -> None:
    seen = view(BALL_ROW)
    points = shown.seen_points([seen], PANDA, START)
    assert np.abs(np.linalg.norm(points - BALL.center, axis=1) - BALL.radius).max() < 0.004
    gaps = np.linalg.norm(seen.points()[:, None] - points[None], axis=2).min(axis=1)
    assert len(points) < len(seen.points()) and gaps.max() < shown.CELL * np.sqrt(3)


def test_the_arm_is_filtered_as_it_stood_then() -> None:
    for q, told in ((START, None), (GOAL, GOAL)):
        arm = PANDA.placed_spheres(q)
        points = shown.seen_points([view(np.concatenate([arm, BALL_ROW]), told)], PANDA, START)
        to_arm = np.linalg.norm(points[:, None] - arm[None, :, :3], axis=2) - arm[:, 3]
        assert len(points) and to_arm.min() > shown.ARM_DISTANCE - shown.CELL
        assert np.abs(np.linalg.norm(points - BALL.center, axis=1) - BALL.radius).max() < 0.004
    assert len(shown.seen_points([view(PANDA.placed_spheres(GOAL), START)], PANDA, START)) > 100


def test_clouds_and_several_views_add_up() -> None:
    seen = view(BALL_ROW)
    one = shown.seen_points([seen], PANDA, START)
    both = shown.seen_points([seen, rd.DepthView.from_cloud(seen.points(), T)], PANDA, START)
    assert len(one) == len(both) and np.linalg.norm(one[:, None] - both, axis=2).min(axis=1).max() < 1e-5
    many = rd.DepthView.from_cloud(np.random.default_rng(0).uniform(-1, 1, (400_000, 3)), T)
    assert len(shown.seen_points([many], PANDA, START)) > shown.INITIAL_CELLS


def test_the_scene_is_what_is_known_and_what_was_seen() -> None:
    floor = rd.Box([0.0, 0.0, -0.05], [3.0, 3.0, 0.1], name="floor")
    problem = rd.Problem(PANDA, rd.Scene([floor]), START, GOAL, views=[view(BALL_ROW)], unknown="padded")
    assert [shape.name for shape in problem.scene.shapes] == ["floor", "seen"] and problem.known_scene.shapes == (floor,)
    assert len(replace(problem, unknown="occupied").scene.shapes) == 2
    assert rd.Problem(PANDA, rd.Scene([BALL]), START, GOAL, views=[view(BALL_ROW)]).scene.shapes == (BALL,)


def test_points_that_an_end_is_near_are_bare() -> None:
    """A goal close to an obstacle stays valid: the radius that is added to points for safety must not make it invalid."""
    sphere = PANDA.placed_spheres(GOAL)[-1]
    near = np.array([[sphere[0] + sphere[3] + 0.105, *sphere[1:3], 0.1]])
    problem = rd.Problem(PANDA, rd.Scene(), START, GOAL, views=[view(near)])
    radii = {s.name: s.point_radius for s in problem.scene.shapes if isinstance(s, SeenPoints)}
    assert radii == {"seen": shown.POINT_RADIUS, "seen_at_ends": shown.MIN_POINT_RADIUS}


def test_files_keep_views_and_policy(tmp_path: Path) -> None:
    problem = rd.Problem(PANDA, rd.Scene(), START, GOAL, views=[view(BALL_ROW, START)], unknown="predicted")
    save_problem(problem, tmp_path / "problem.json")
    for again in (rd.load_problem(tmp_path / "problem.json"), problem_from_record(problem_record(problem))):
        assert again.unknown == "predicted" and np.array_equal(again.views[0].depth, problem.views[0].depth)
        assert np.array_equal(again.views[0].configuration, START)  # type: ignore[arg-type]
        [old], [new] = problem.scene.shapes, again.scene.shapes
        assert np.allclose(old.points, new.points)  # type: ignore[attr-defined]
    assert "views" not in problem_record(rd.Problem(PANDA, rd.Scene(), START, GOAL))


def test_what_is_refused() -> None:
    for fields, message in (
        ({"unknown": "hopeful"}, "unknown policy in unknown: 'hopeful'; known: occupied, optimistic, pad"),
        ({"views": 3}, "views is 3"),
        ({"views": [view(BALL_ROW, np.zeros(3))]}, r"views\[0\].configuration has 3 values; panda has 7"),
    ):
        refuses(message, rd.Problem, PANDA, rd.Scene(), START, GOAL, **fields)


def test_what_the_arm_holds_is_not_seen_as_an_obstacle() -> None:
    held = PANDA.attach(rd.Box([0, 0, 0.2], [0.1, 0.1, 0.15], name="parcel"), "panda_hand")
    alone = rd.DepthView(picture(held.placed_spheres(START)), K, T)
    assert not len(shown.seen_points([alone], held, START))
    assert len(shown.seen_points([alone], PANDA, START)), "the bare arm sees the parcel"


def test_points_of_a_pose_that_may_be_off_are_larger_and_leave_start_and_goals_free() -> None:
    """Regression: checks enlarge large points further, so starts were in collision with points that do not touch the arm."""
    error = 0.04
    spheres = PANDA.placed_spheres(START)
    rng = np.random.default_rng(0)
    points = spheres[rng.integers(len(spheres), size=4000), :3] + rng.uniform(-0.3, 0.3, (4000, 3))
    errors = np.tile([error, 0.0], (len(points), 1))
    shapes = shown.point_shapes(points, PANDA, rd.Scene([]), START, START[None], errors)
    distances = np.linalg.norm(points[:, None] - spheres[None, :, :3], axis=2) - spheres[:, 3]
    kept = np.concatenate([shape.points for shape in shapes])
    assert max(shape.point_radius for shape in shapes) == shown.POINT_RADIUS + error
    assert len(kept) == ((distances.min(axis=1) >= shown.MIN_POINT_RADIUS) | (distances.min(axis=1) < -error)).sum()
    apart = points[distances.min(axis=1) > 0]
    outside = shown.point_shapes(apart, PANDA, rd.Scene([]), START, START[None], errors[: len(apart)])
    assert CollisionChecker(PANDA, rd.Scene(outside)).free(START[None])[0]
    noisy = shown.point_shapes(points, PANDA, rd.Scene([]), START, START[None], errors[:, ::-1] / shown.END_SPREADS)
    assert {shape.point_radius for shape in noisy} == {shown.POINT_RADIUS, shown.MIN_POINT_RADIUS}
    assert sum(len(shape.points) for shape in noisy) == len(kept), "noise may put points of the arm this deep"


def test_each_point_is_larger_by_what_its_own_view_may_be_off() -> None:
    """Regression: all points were as large as those seen from farthest away, which closed passages."""
    points = np.random.default_rng(0).uniform(1.5, 2.5, (500, 3))
    errors = point_errors([replace(view(BALL_ROW), pose_deviation=(0.005, 0.02))], points)
    by_hand = 0.005 + 0.02 * np.linalg.norm(points - T[:3, 3], axis=1)
    np.testing.assert_allclose(errors, np.column_stack([by_hand, np.zeros(len(points))]))
    single = points.astype(np.float32)
    for shape in shown.point_shapes(points, PANDA, rd.Scene([]), START, START[None], errors):
        own = errors[np.isin(single, shape.points.astype(np.float32)).all(axis=1), 0]
        grown = shape.point_radius - shown.POINT_RADIUS
        assert len(own) == len(shape.points) and grown - shown.ERROR_STEP < own.min() and own.max() <= grown + 1e-9
