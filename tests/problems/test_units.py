"""Notes on numbers that look like millimeters."""

import numpy as np
import pytest

import robotdiffuse as rd
from robotdiffuse.perception.ray_caster import looking_at, ray_cast
from robotdiffuse.problems.units import arm_in_cloud_note, unit_notes

PANDA = rd.load_robot("panda")
START = [0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785]
GOAL = [0.4, -0.7, 0.0, -2.3, 0.0, 1.571, 0.785]
VIEW = ray_cast(
    rd.Scene([rd.Box([0.0, -0.8, 0.3], [0.2, 0.2, 0.6])]),
    looking_at(np.array([1.7, 0.0, 0.6]), np.array([0.4, 0.0, 0.3])),
    *((75.0, 75.0, 39.5, 29.5), (80, 60), PANDA, np.array(START)),
)
CUBE = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
FACES = [[0, 1, 3], [0, 3, 2], [4, 5, 7], [4, 7, 6], [0, 1, 5], [0, 5, 4]]


def _notes(*shapes: rd.Box | rd.Mesh | rd.PointCloud | rd.Sphere, **options: object) -> tuple[str, ...]:
    return unit_notes(rd.Problem(PANDA, rd.Scene(shapes), START, GOAL, **options))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("shape", "text"),
    [
        (rd.Mesh(200 * CUBE + [500, 300, 600], FACES), "mesh is 200 m long"),
        (rd.PointCloud(1600 * CUBE - 800), "point_cloud is 1600 m long"),
        (rd.Box([500, 300, 600], [200, 200, 200]), "box is 200 m long"),
        (rd.Sphere([0, 5, 0], 0.2), "beyond the arm's reach of"),
    ],
)
def test_obstacles_in_millimeters_are_noted(shape: rd.Box, text: str) -> None:
    [note] = _notes(shape)
    assert note.startswith("check the units") and text in note and "millimeters" in note


def test_scenes_in_meters_have_no_notes_on_units() -> None:
    floor = rd.Box([0, 0, -0.6], [30, 30, 1], name="floor")
    assert (
        _notes() == _notes(floor) == _notes(rd.Sphere([0.5, 0.3, 0.6], 0.1), rd.Sphere([0, 9, 0], 0.1)) == ()
    )
    assert _notes(rd.PointCloud(CUBE), rd.PointCloud(np.zeros((0, 3)))) == ()


def test_a_depth_image_in_millimeters_is_noted() -> None:
    assert _notes(views=[VIEW]) == ()
    wrong = [rd.DepthView(1000 * VIEW.depth, VIEW.intrinsics, VIEW.T_base_camera)]
    [note] = _notes(views=wrong)
    assert "depths of views[0] begin at" in note and "millimeters" in note
    problem = rd.Problem(PANDA, rd.Scene(), START, GOAL, views=wrong, unknown="padded")
    assert rd.load_planner("aorrtc").plan(problem).notes.count(note) == 1


def test_what_views_see_in_reach_is_no_scene_beyond_it() -> None:
    far = rd.Scene([rd.Sphere([0, 5, 0], 0.2)])
    problem = rd.Problem(PANDA, far, START, GOAL, views=[VIEW], unknown="padded")
    notes = rd.load_planner("aorrtc").plan(problem).notes
    assert all(note.startswith("compiled for") for note in notes), notes


def test_a_cloud_that_the_arm_stands_in_is_noted() -> None:
    points = np.random.default_rng(0).uniform(-0.5, 0.8, (3000, 3))
    scene = rd.Scene([rd.PointCloud(points, name="scan")])
    result = rd.load_planner("aorrtc").plan(rd.Problem(PANDA, scene, START, GOAL), time_limit=60.0)
    assert result.status is rd.Status.INVALID_START
    assert "points of scan are within the arm" in result.notes[0] and "millimeters" in result.notes[0]
    assert arm_in_cloud_note(PANDA, rd.Scene([rd.PointCloud(CUBE + 2)]), np.array(START)) == ""
