"""Allowed contacts of a scene: which links may touch which obstacle, everywhere in the chain."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

import robotdiffuse as rd
from helpers.box_arm import box_arm
from helpers.commands import python
from helpers.refusals import refuses
from robotdiffuse.collision.checker import CollisionChecker
from robotdiffuse.collision.exact_meshes import ExactCollision
from robotdiffuse.core.types import Path as JointPath
from robotdiffuse.problems.files import problem_from_record, problem_record, save_problem
from robotdiffuse.scenes.scene import contact_notes
from robotdiffuse.scenes.shapes import Shape

BALL = rd.Sphere([1.15, 0.0, 0.0], 0.1, "ball")
WALL = rd.Box([0.9, 0.6, 0.0], [0.05, 0.4, 0.4], name="wall")
FINGERS = ("panda_hand", "panda_leftfinger", "panda_rightfinger")
HOME = np.array([0.0, 0.3, 0.0, -1.8, 0.0, 2.1, 0.8])


class SolidOnly:
    """An object that a robot can hold, but that is no shape of a scene."""

    name = "lump"
    solid = BALL.solid


def grasp(kind: str, contacts: dict[str, object]) -> rd.Problem:
    """A Panda whose fingers are around an object, and its motion away from there past a ball."""
    robot = rd.load_robot("panda")
    T = robot.fk(HOME, "panda_hand")
    at = T[:3, 3] + 0.09 * T[:3, 2]
    made = trimesh.creation.cylinder(0.03, 0.1)
    shapes: dict[str, Shape] = {
        "box": rd.Box(at, [0.05, 0.05, 0.05], name="mug"),
        "mesh": rd.Mesh(made.vertices, made.faces, at, name="mug"),
        "point_cloud": rd.PointCloud(made.vertices + at, 0.02, name="mug"),
    }
    scene = rd.Scene([shapes[kind], rd.Sphere([0.62, 0.33, 0.5], 0.1, "ball")], contacts)  # type: ignore[arg-type]
    return rd.Problem(robot, scene, HOME, np.array([1.0, 0.3, 0.0, -1.8, 0.0, 2.1, 0.8]))


@pytest.mark.parametrize("kind", ["box", "mesh", "point_cloud"])
def test_an_allowed_contact_is_allowed_everywhere(kind: str) -> None:
    oracle = pytest.importorskip("robotdiffuse.simulation.validator")
    problem = grasp(kind, {"mug": FINGERS})
    result = rd.plan(problem, time_limit=2.0)
    assert result.solved and result.trajectory is not None, result.reason
    assert "contact of mug with panda_hand, panda_leftfinger, panda_rightfinger is allowed" in result.notes
    rows = result.trajectory.positions[::8]
    assert not ExactCollision(problem.robot, problem.scene).collides(rows).any()
    with oracle.PyBulletOracle(problem.robot, problem.scene) as bullet:
        assert bullet.check_rows(rows) is None
        nearest = bullet.nearest(HOME)
        assert nearest is None or nearest.distance > 0
    assert not rd.certify(problem, result.trajectory).check(problem).differences
    assert problem.clearance_at(HOME) > 0
    other = replace(problem, scene=rd.Scene(problem.scene.shapes))
    report = rd.verify(other, result.trajectory)
    assert report.violation is not None and "mug" in report.violation.message
    assert ExactCollision(other.robot, other.scene).collides(HOME[None]).all()
    assert rd.certify(problem, result.trajectory).check(other).differences
    assert other.clearance_at(HOME) <= 0 and not rd.plan(other, time_limit=0.1).solved


def test_other_links_may_not_touch_it() -> None:
    """Only the last link may touch the ball: all checks refuse a motion in which another link touches it."""
    contacts = {"ball": ["l3"]}
    folded = JointPath(box_arm().joint_names, np.array([[0.0, 0.0, 0.0], [0.3, 0.0, 0.0]]))
    free = rd.Problem(box_arm(), rd.Scene([BALL], contacts), folded.positions[0], folded.positions[1])
    assert rd.verify(free, folded).valid
    scene = rd.Scene([replace(BALL, center=[0.8, 0.2, 0.0])], contacts)  # the ball is beside the middle link
    report = rd.verify(replace(free, scene=scene), folded)
    assert report.violation is not None and report.violation.message.startswith("l2")
    checker = CollisionChecker(box_arm(), scene)
    assert list(checker.free(folded.positions)) == [True, False]
    assert dict(zip(checker.links, checker.link_clearances(folded.positions)[1], strict=True))["l3"] == 1.0


def test_costs_pass_over_allowed_contacts_of_the_links_that_have_them_alone() -> None:
    q = np.zeros((1, 3))
    cost, gradient = CollisionChecker(box_arm(), rd.Scene([BALL], {"ball": "all"})).cost_gradients(q, 0.05)
    assert cost[0] == 0 and not gradient.any()
    assert CollisionChecker(box_arm(), rd.Scene([BALL])).cost_gradients(q, 0.05)[0][0] > 0
    made = trimesh.creation.icosphere(subdivisions=6, radius=0.1)  # 81,920 triangles
    mesh = rd.Mesh(made.vertices, made.faces, BALL.center, name="ball")
    for links, free in ((["l3"], True), (["l1", "l2"], False)):
        checker = CollisionChecker(box_arm(), rd.Scene([mesh], {"ball": links}))
        assert len(checker.scene_arrays.solids) <= 1000 and checker.free(np.zeros((1, 3)))[0] == free


def test_held_objects_are_links() -> None:
    robot = box_arm().attach(rd.Box([0.35, 0.0, 0.0], [0.1, 0.05, 0.05], name="cup"), "l3")
    q = np.zeros(3)
    scene = rd.Scene([rd.Box([1.26, 0.0, 0.0], [0.06, 0.2, 0.2], name="shelf")], {"shelf": ["cup"]})
    path = JointPath(robot.joint_names, np.array([q, [0.0, 0.0, 1.0]]))
    assert rd.verify(rd.Problem(robot, scene, q, path.positions[1]), path).valid
    assert not rd.verify(rd.Problem(robot, rd.Scene(scene.shapes), q, path.positions[1]), path).valid


def test_unknown_names_are_errors_with_the_known_ones() -> None:
    refuses(r"unknown obstacle in allowed_contacts: 'cup'; known: ball, wall", rd.Scene, [BALL, WALL], {"cup": "all"})
    with pytest.raises(rd.InputError, match=r"unknown link in allowed_contacts of ball: 'l9'; known: .*l1, l2"):
        rd.Problem(box_arm(), rd.Scene([BALL], {"ball": ["l9"]}), [0, 0, 1.0], [0, 0, -1.0])
    for wrong in ([["ball"]], "ball", 3, {"ball": "l3"}, {"ball": 3}, {"ball": [3]}, {3: "all"}):
        refuses("allowed_contacts", rd.Scene, [BALL], wrong)


WRONG_TYPES = """
import numpy as np
import robotdiffuse as rd

ball, box, cloud = rd.Sphere([1, 0, 0], 0.1, "ball"), rd.Box([1, 0, 0], [1, 1, 1]), rd.PointCloud([[1, 0, 0]])
robot, scene, moving = rd.load_robot("panda"), rd.Scene([ball]), rd.MovingObstacle(ball, velocity=[1, 0, 0])
space = rd.Workspace(robot)
space.add(ball)
goal, view = rd.PoseGoal("panda_hand", np.eye(4)), rd.DepthView.from_cloud(np.ones((9, 3)), np.eye(4))
things = (ball, box, cloud, scene, moving, goal, view)
two = np.array(["panda_hand", "panda_link7"])
calls = [(rd.Scene, [ball], {"ball": two}), (space.allow, "ball", two), (robot.with_tool, "panda_hand", np.eye(4), (), (), two)]
for name in (two, ["panda_hand"], {}, ""):
    calls += [(robot.attach, box, name), (scene.attach, "ball", robot, np.zeros(7), name), (space.pose, "ready", name)]
    calls += [(robot.fk, np.zeros(7), name), (robot.jacobian, np.zeros(7), name), (rd.Workspace, robot, name)]
for T in (np.eye(3), 2 * np.eye(4), np.diag([1.0, 1.0, -1.0, 1.0]), "T"):
    calls += [(thing.moved, T) for thing in things] + [(robot.with_tool, "panda_hand", T)]
for call, *arguments in calls:
    try:
        call(*arguments)
    except rd.InputError as error:
        assert len(str(error).splitlines()) == 1
    else:
        raise AssertionError((call, arguments))
for thing in things:
    thing.moved(np.eye(4).tolist())
"""


def test_wrong_names_and_motions_are_refused_in_one_line() -> None:
    """Regression: lists in place of names were a TypeError or a ValueError; a box moved by twice the identity stayed."""
    python(WRONG_TYPES)  # without this suite's type checks
    # a held object that is no shape of a scene was in neither scene nor robot after `Scene.detach`
    held = box_arm().attach(SolidOnly(), "l3")
    refuses(r"scene\[1\] is .*SolidOnly.*; it must be a shape", rd.Scene([WALL]).detach, "lump", held, np.zeros(3))


def test_a_name_given_twice_stands_for_both() -> None:
    scene = rd.Scene([BALL, BALL, WALL], {"ball": ["l3"], "ball_2": ["l2"]})
    assert scene.allowed_contacts == (("ball", ("l3",)), ("ball_2", ("l3", "l2")))
    assert [shape.name for shape in scene.with_shapes([*scene.shapes[1:], BALL]).shapes] == ["ball_2", "wall", "ball"]
    grown = rd.Scene([BALL], {"ball": ["l3"]}).with_shapes([BALL, replace(BALL, center=[1.1, 0.3, 0.0])])
    assert grown.may_touch("l3", "ball") and not grown.may_touch("l3", "ball_2")
    assert not scene.with_shapes([WALL]).allowed_contacts
    assert contact_notes(rd.Scene([BALL], {"ball": "all"})) == ("contact of ball with all links is allowed",)


def test_a_ball_on_a_track_can_be_moved_by_a_turn() -> None:
    """Regression: a sphere's frame does not turn, but the poses of its track did, which was refused."""
    poses = [rd.pose([0.5, 0, 1.6]), rd.pose([0.5, 0, 1.3])]
    ball = rd.MovingObstacle(rd.Sphere([0.5, 0, 1.6], 0.05), times=[1, 2], poses=poses)
    T = rd.pose([1, 0, 0], rpy=[0.3, 0, 1])
    np.testing.assert_allclose(ball.moved(T).pose(1.5)[:3, 3], (T @ [0.5, 0, 1.45, 1])[:3])


def test_moved_attached_and_detached_scenes_keep_what_remains() -> None:
    scene = rd.Scene([BALL, WALL], {"ball": ["l3"], "wall": "all"})
    assert scene.moved(np.eye(4)).allowed_contacts == scene.allowed_contacts
    left, holding = scene.attach("ball", box_arm(), np.zeros(3), "l3")
    assert left.allowed_contacts == (("wall", "all"),)
    assert left.detach("ball", holding, np.zeros(3))[0].allowed_contacts == (("wall", "all"),)


def test_allowed_contacts_come_back_from_files(tmp_path: Path) -> None:
    problem = grasp("box", {"mug": FINGERS, "ball": "all"})
    assert problem_from_record(problem_record(problem)).scene.allowed_contacts == problem.scene.allowed_contacts
    save_problem(problem, tmp_path / "grasp.yaml")
    text = (tmp_path / "grasp.yaml").read_text()
    assert "ball: all" in text
    assert rd.load_problem(tmp_path / "grasp.yaml").scene.allowed_contacts == problem.scene.allowed_contacts
    (tmp_path / "grasp.yaml").write_text(text.replace("ball: all", "bell: all"))
    refuses(r"grasp.yaml: unknown obstacle in allowed_contacts: 'bell'", rd.load_problem, tmp_path / "grasp.yaml")
