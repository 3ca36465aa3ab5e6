"""Problem.is_free and clearance_at; notes on numbers that look like millimeters."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import robotdiffuse as rd
from helpers.panda import HOME, PANDA
from helpers.refusals import refuses
from robotdiffuse.collision import CollisionChecker
from robotdiffuse.perception.ray_caster import looking_at, ray_cast
from robotdiffuse.problems.units import arm_in_cloud_note, unit_notes

Q = np.array([0.0, 0.3, 0, -1.8, 0, 2.1, 0.8])
HAND = PANDA.fk(Q, "panda_hand")[:3, 3]
PROBLEM = rd.Problem(PANDA, rd.Scene([rd.Sphere(HAND, 0.05, "ball")]), "ready", "extended")


def test_a_free_configuration_is_true_without_a_reason() -> None:
    for q in ("ready", PANDA.poses["ready"].values(), Q * [-1, 1, 1, 1, 1, 1, 1] + [1, 0, 0, 0, 0, 0, 0]):
        state = PROBLEM.is_free(q if isinstance(q, str) else list(q))
        assert state and state.reason == "" and state.links == ()


def test_the_reason_names_links_and_obstacle_or_the_limit_and_a_wrong_shape_is_an_error() -> None:
    state = PROBLEM.is_free(Q)
    assert not state and state.reason.startswith("panda_hand is ") and state.reason.endswith("inside ball")
    assert state.links[0] == "panda_hand"
    state = rd.Problem(PANDA, rd.Scene(), Q, Q).is_free([0, 0, 0, -3.0, 0, 0, 0])
    assert not state and "overlap" in state.reason and len(state.links) >= 2
    assert PROBLEM.is_free([9.0, *Q[1:]]).reason.startswith("panda_joint1 is 9 rad; its limits are")
    refuses("q has 2 values", PROBLEM.is_free, [1, 2])
    refuses("unknown pose in q: 'home'; known: extended, ready", PROBLEM.is_free, "home")


def test_it_agrees_with_the_validator() -> None:
    scene = rd.Scene([rd.Box([0.5, 0, 0.4], [0.3, 0.6, 0.05]), rd.Sphere([-0.3, 0.3, 0.6], 0.2)])
    states = []
    for q in np.random.default_rng(0).uniform(PANDA.lower, PANDA.upper, (60, 7)):
        problem = rd.Problem(PANDA, scene, q, q)
        report = rd.verify(problem, rd.Path(PANDA.joint_names, q[None]))
        states.append(bool(problem.is_free(q)))
        assert states[-1] == report.valid, report.violation
    assert 5 < sum(states) < 55


def test_the_least_distance_at_one_configuration_or_several() -> None:
    q = np.array([Q, [0.6, *Q[1:]]])
    checker = CollisionChecker(PANDA, PROBLEM.scene)
    expected = np.hstack([checker.link_clearances(q), checker.pair_clearances(q)]).min(axis=1)
    np.testing.assert_allclose(PROBLEM.clearance_at(q), expected)
    one = PROBLEM.clearance_at(Q.tolist())
    assert isinstance(one, float) and one == pytest.approx(expected[0])
    refuses(r"q is .* it must be 7 numbers", PROBLEM.clearance_at, [0.0])


TO = [0.4, -0.7, 0.0, -2.3, 0.0, 1.571, 0.785]


@cache
def seen() -> rd.DepthView:
    """A depth view of a box beside the arm, from a camera in front of the arm."""
    camera = looking_at(np.array([1.7, 0.0, 0.6]), np.array([0.4, 0.0, 0.3]))
    lens = (75.0, 75.0, 39.5, 29.5)
    return ray_cast(rd.Scene([rd.Box([0.0, -0.8, 0.3], [0.2, 0.2, 0.6])]), camera, lens, (80, 60), PANDA, HOME)


CUBE = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
FACES = [[0, 1, 3], [0, 3, 2], [4, 5, 7], [4, 7, 6], [0, 1, 5], [0, 5, 4]]


def _notes(*shapes: rd.Box | rd.Mesh | rd.PointCloud | rd.Sphere, **options: object) -> tuple[str, ...]:
    return unit_notes(rd.Problem(PANDA, rd.Scene(shapes), HOME, TO, **options))  # type: ignore[arg-type]


def test_obstacles_in_millimeters_are_noted() -> None:
    for shape, text in (
        (rd.Mesh(200 * CUBE + [500, 300, 600], FACES), "mesh is 200 m long"),
        (rd.PointCloud(1600 * CUBE - 800), "point_cloud is 1600 m long"),
        (rd.Sphere([0, 5, 0], 0.2), "beyond the arm's reach of"),
    ):
        [note] = _notes(shape)
        assert note.startswith("check the units") and text in note and "millimeters" in note


def test_scenes_in_meters_have_no_notes_on_units() -> None:
    floor = rd.Box([0, 0, -0.6], [30, 30, 1], name="floor")
    assert _notes() == _notes(floor) == _notes(rd.Sphere([0.5, 0.3, 0.6], 0.1), rd.Sphere([0, 9, 0], 0.1)) == ()
    assert _notes(rd.PointCloud(CUBE), rd.PointCloud(np.zeros((0, 3)))) == ()
    [note] = _notes(rd.PointCloud(np.zeros((0, 3))), rd.Sphere([0, 5, 0], 0.2, name="ball"))
    assert "the obstacle ball is beyond" in note, "it named the empty cloud"


def test_a_depth_image_in_millimeters_is_noted() -> None:
    assert _notes(views=[seen()]) == ()
    wrong = [rd.DepthView(1000 * seen().depth, seen().intrinsics, seen().T_base_camera)]
    [note] = _notes(views=wrong)
    assert "depths of views[0] begin at" in note and "millimeters" in note
    problem = rd.Problem(PANDA, rd.Scene(), HOME, TO, views=wrong, unknown="padded")
    assert rd.load_planner("aorrtc").plan(problem).notes.count(note) == 1


def test_intrinsics_for_images_of_another_size_are_noted() -> None:
    """Regression: without the arm in the image, nothing told that intrinsics were those before the image was resized."""
    for factor in (0.5, 2.0):
        [note] = _notes(views=[replace(seen(), intrinsics=tuple(factor * np.array(seen().intrinsics)))])
        assert note.startswith("check the intrinsics of views[0]: cx and cy") and "(60, 80) pixels" in note


def test_what_views_see_in_reach_is_no_scene_beyond_it() -> None:
    problem = rd.Problem(PANDA, rd.Scene([rd.Sphere([0, 5, 0], 0.2)]), HOME, TO, views=[seen()], unknown="padded")
    notes = rd.load_planner("aorrtc").plan(problem).notes
    assert all(note.startswith("compiled for") for note in notes), notes


def test_a_cloud_that_the_arm_stands_in_is_noted() -> None:
    scene = rd.Scene([rd.PointCloud(np.random.default_rng(0).uniform(-0.5, 0.8, (3000, 3)), name="scan")])
    result = rd.load_planner("aorrtc").plan(rd.Problem(PANDA, scene, HOME, TO), time_limit=60.0)
    assert result.status is rd.Status.INVALID_START
    assert "points of scan are within the arm" in result.notes[0] and "millimeters" in result.notes[0]
    assert arm_in_cloud_note(PANDA, rd.Scene([rd.PointCloud(CUBE + 2)]), HOME) == ""
