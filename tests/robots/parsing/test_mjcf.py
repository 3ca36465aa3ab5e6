"""MuJoCo models: frames, limits and collisions against MuJoCo itself; scenes; models that are refused."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

import robotdiffuse as rd
from helpers.quick_preparation import QUICK, coarse_grids
from helpers.refusals import refuses
from robotdiffuse.collision import CollisionChecker
from robotdiffuse.robots.fitting.preparation import add_robot
from robotdiffuse.robots.fitting.self_collisions import SamplingSettings
from robotdiffuse.robots.parsing.urdf import UrdfTree

mujoco = pytest.importorskip("mujoco", reason="the extra `mujoco` is not installed")
FILES = Path(__file__).parents[2] / "files" / "mujoco"
ARM = (FILES / "arm.xml").read_text()


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("mjcf") / "arm.xml"
    file.write_text(ARM)
    return file


def read(folder: Path, text: str) -> UrdfTree:
    (folder / "m.xml").write_text(text)
    return UrdfTree(folder / "m.xml", {})


def test_models_without_a_name_have_that_of_their_file(tmp_path: Path) -> None:
    """Regression: all were called "MuJoCo Model", and the second that was added replaced the first."""
    body = '<body><joint range="-90 90"/><geom size="0.1"/></body>'
    assert read(tmp_path, f"<mujoco><worldbody>{body}</worldbody></mujoco>").name == "m"


def state_of(model: Any, robot: rd.Robot, q: np.ndarray) -> Any:
    """MuJoCo's data at a configuration of the robot; other joints have their locked values."""
    data = mujoco.MjData(model)
    for name, value in (dict(zip(robot.joint_names, q, strict=True)) | robot.locked).items():
        data.qpos[model.joint(name).qposadr] = value
    mujoco.mj_forward(model, data)
    return data


def test_frames_limits_poses_and_mimics_are_those_of_mujoco(file: Path) -> None:
    tree = UrdfTree(file, {})
    robot = tree.robot(tip="wrist", srdf=tree.semantics)
    model = mujoco.MjModel.from_xml_path(str(file))
    assert robot.joint_names == ("j1", "lift", "j2", "j3")
    for q in np.random.default_rng(0).uniform(robot.lower, robot.upper, (50, robot.dof)):
        data = state_of(model, robot, q)
        bodies = ("base", "shoulder", "elbow", "wrist", "left_finger", "right_finger")
        for there in (*(data.body(name) for name in bodies), data.site("tool")):
            expected = np.column_stack([there.xmat.reshape(3, 3), there.xpos])
            np.testing.assert_allclose(robot.fk(q, there.name)[:3], expected, atol=1e-9)
    np.testing.assert_allclose([robot.lower[1], robot.upper[1]], [-0.1, 0.2])
    assert next(joint for joint in robot.joints if joint.name == "j2").effort == 20
    assert robot.locked["f2"] == pytest.approx(0.01 + 0.001 + robot.locked["f1"])
    assert robot.poses["home"] == {"j1": 0.5, "lift": 0.1, "j2": 0.4, "j3": -0.3, "f1": 0.01, "f2": 0.02}
    assert any("no velocity limit" in note for note in robot.notes)


def test_self_collisions_are_those_of_mujoco(file: Path, tmp_path: Path) -> None:
    """MuJoCo and the validator's meshes agree on contacts deeper than 1 mm; pairs that the model excludes are free."""
    settings = replace(QUICK, sampling=SamplingSettings(samples=300, descents=3))
    with coarse_grids():
        arm = add_robot(file, out=tmp_path / "arm", settings=settings).robot
    model = mujoco.MjModel.from_xml_path(str(file))
    checker = CollisionChecker(arm, rd.Scene())
    collisions = 0
    for q in np.random.default_rng(1).uniform(arm.lower, arm.upper, (200, arm.dof)):
        data = state_of(model, arm, q)
        touching = [contact.geom for contact in data.contact if contact.dist < -1e-3]
        bodies = [{model.body(model.geom_bodyid[geom]).name for geom in pair} for pair in touching]
        deep = [pair for pair in bodies if pair <= set(arm.link_names)]
        assert not deep or not checker.free(q[None])[0], (q, deep)
        collisions += bool(deep)
    assert frozenset(("base", "elbow")) in arm.allowed_collisions
    assert collisions > 3


def test_a_scene_is_all_that_is_not_the_robot(file: Path) -> None:
    model = mujoco.MjModel.from_xml_path(str(file))
    data = mujoco.MjData(model)
    data.qpos[2] = 0.3  # lifts the crate; no one has called mj_forward
    scene = rd.Scene.from_mujoco(model, data)
    floor, crate = scene.shapes
    assert [shape.name for shape in scene.shapes] == ["floor", "crate_wall"]
    assert floor.bounds[1, 2] == pytest.approx(-0.5)
    np.testing.assert_allclose(crate.bounds, [[0.55, -0.1, 0.2], [0.65, 0.3, 0.4]])
    np.testing.assert_allclose(rd.Scene.from_mujoco(model, data, base="base").shapes[0].bounds[1, 2], -0.55)
    refuses("body", rd.Scene.from_mujoco, model, base="bse")
    refuses("model is 'm.xml'; it must be a model", rd.Scene.from_mujoco, "m.xml")


FIELD = '<asset><hfield name="h" nrow="2" ncol="2" size="1 1 1 1"/></asset>'
CLOTH = """<flexcomp name="cloth" type="grid" count="3 3 1" spacing="1 1 1" radius="0.1" dim="2">
  {}</flexcomp>"""
TIED_CLOTH = CLOTH.format('<edge equality="true"/>')
"""Without constraints, MuJoCo warns."""


def test_obstacles_that_are_no_solids_are_refused_and_those_without_names_have_numbers(tmp_path: Path) -> None:
    """Regression: soft bodies were left out without a note."""
    for assets, world, message in (
        (FIELD, '<geom name="hill" type="hfield" hfield="h"/>', "geom hill is of type hfield; obstacles may"),
        ("", TIED_CLOTH, "flex cloth is soft; obstacles must be rigid"),
    ):
        model = mujoco.MjModel.from_xml_string(f"<mujoco>{assets}<worldbody>{world}</worldbody></mujoco>")
        refuses(message, rd.Scene.from_mujoco, model)
    tip = '<body name="left_finger"'
    with_cloth = ARM.replace(tip, TIED_CLOTH + tip)
    assert with_cloth != ARM
    refuses(r".*the robot has a soft part \(flex\)", read, tmp_path, with_cloth)
    # Regression: scenes of Meta-World were refused, since a box has no name.
    assert [shape.name for shape in rd.Scene.from_mujoco(mujoco.MjModel.from_xml_string(BODY.format(""))).shapes] == ["geom0"]


HILLY = f"""<mujoco>{FIELD}<worldbody><body name="b">
  <joint name="j" range="-1 1"/><geom name="hill" type="hfield" hfield="h" {{}}/><geom size="1"/>
</body></worldbody></mujoco>"""


def test_a_height_field_that_collides_with_nothing_is_left_out(tmp_path: Path) -> None:
    assert len(read(tmp_path, HILLY.format('contype="0" conaffinity="0" mass="0"')).surfaces("b")) == 1


BODY = "<mujoco><worldbody><body>{}<geom size='1'/></body></worldbody></mujoco>"


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        (HILLY.format(""), "hill of body b is of type hfield; use one of sphere"),
        (BODY.format(""), "has no robot: no body is moved by a hinge"),
        (BODY.format("<joint type='slide'/>"), "slide joint joint0 has no range"),
        (BODY.format("<joint/><joint name='b' type='ball'/>"), "joint b is a ball joint; use three hinges"),
        (BODY.format("<joint/><geom type='sdf' mesh='m'/>"), "is no valid MuJoCo model"),
        ("<mujoco><worldbody><body><joint", "is not well-formed XML"),
        ("<mujoco><worldbody><box/></worldbody></mujoco>", "no valid MuJoCo model: .*Element .box., line 1$"),
        ("<mujoco><asset><mesh name='m' file='none.stl'/></asset></mujoco>", "none.stl.*; meshes .STL, OBJ"),
    ],
)
def test_bad_models_are_one_line(text: str, wanted: str, tmp_path: Path) -> None:
    refuses(wanted, lambda: read(tmp_path, text).robot())


NAMED = (FILES / "named.xml").read_text()
PAIRS = '<pair geom1="foot" geom2="palm"/><pair geom1="post" geom2="palm"/>'


def test_geoms_of_named_pairs_collide(tmp_path: Path) -> None:
    """Regression: geoms that collide only in named pairs were left out, and named pairs of excluded bodies were excluded."""
    tree = read(tmp_path, NAMED.format(f'<exclude body1="base" body2="hand"/>{PAIRS}'))
    assert [len(tree.surfaces(link)) for link in ("base", "arm", "hand")] == [1, 1, 1]
    assert tree.semantics is not None and set(tree.semantics.allowed) == {frozenset(("arm", "hand"))}
    [post] = rd.Scene.from_mujoco(mujoco.MjModel.from_xml_path(str(tmp_path / "m.xml"))).shapes
    assert post.name == "post"


def test_a_model_with_other_exclusions_or_keyframes_is_another_robot(tmp_path: Path) -> None:
    """Regression: `load_robot` took the robot that had been prepared with the old exclusions and poses."""
    changes = ("", ""), ("", ""), ('body2="elbow"', 'body2="wrist"'), ("0.5 0.1 0.4", "0.5 0.1 0.5")
    digests = [read(tmp_path, ARM.replace(old, new)).digest for old, new in changes]
    assert digests[0] == digests[1] and len(set(digests)) == 3


def test_reading_a_model_neither_warns_nor_writes_a_log(tmp_path: Path, monkeypatch, recwarn) -> None:
    """Regression: MuJoCo's warnings were shown as Python's, or written to MUJOCO_LOG.TXT in the user's folder."""
    monkeypatch.chdir(tmp_path)
    Path("cloth.xml").write_text(NAMED.format("").replace("<worldbody>", "<worldbody>" + CLOTH.format("")))
    Path("nan.xml").write_text(NAMED.format("").replace("</mujoco>", '<keyframe><key qpos="nan 0"/></keyframe></mujoco>'))
    UrdfTree(Path("cloth.xml"), {})
    refuses("nan.xml: qpos of keyframe .* is .*nan.*; its numbers must be finite", UrdfTree, Path("nan.xml"), {})
    assert not [warning for warning in recwarn if warning.category is not ResourceWarning]
    assert sorted(file.name for file in tmp_path.iterdir()) == ["cloth.xml", "nan.xml"]
    assert mujoco.get_mju_user_warning() is None


TIED = """
<mujoco><worldbody><body><joint name="a" range="-1 1"/><geom size="0.1"/><body name="b" pos="0 0 1">
  <joint name="j" range="-1 1"/><geom size="0.1"/></body></body></worldbody>
  <tendon><fixed name="t"><joint joint="a" coef="1"/><joint joint="j" coef="1"/></fixed></tendon>
  <equality><joint joint1="j" polycoef="0.3 0 0 0 0"/><connect body1="b" anchor="0 0 0"/><tendon tendon1="t"/>
    <joint joint1="j" active="false"/></equality></mujoco>"""


def test_constraints_that_are_not_followed_are_noted(tmp_path: Path) -> None:
    """Regression: only polynomials of joints were noted; then, all but limits of tendons."""
    tree = read(tmp_path, TIED.replace('name="t"', 'name="t" range="0 1"'))
    assert "the limits of tendon t are ignored" in tree.notes
    notes = [note for note in tree.robot().notes if "equality" in note]
    for note, kind in zip(notes, ("joint", "connect", "tendon"), strict=True):
        assert f"({kind}) is ignored; --lock can hold what it ties" in note


PLACED = (FILES / "placed.xml").read_text()


@pytest.mark.parametrize("actuator", ["", "<actuator><position joint='x'/></actuator></mujoco>"])
def test_a_base_on_slides_without_range_is_held(actuator: str, tmp_path: Path) -> None:
    """As of Fetch in Gymnasium-Robotics, where nothing moves the slides, and of TidyBot, which drives on them."""
    tree = read(tmp_path, PLACED.replace("</mujoco>", actuator or "</mujoco>"))
    robot = tree.robot(srdf=tree.semantics)
    assert robot.joint_names == ("j",) and robot.poses["home"] == {"j": 0.5}
    assert any("slide joint x" in note and "is held" in note for note in robot.notes)
    np.testing.assert_allclose(robot.fk(np.array([0.0]), "base")[:3, 3], [0.1, 0, 0.2], atol=1e-12)


def test_a_scene_around_a_robot_that_has_moved_names_its_base() -> None:
    """Regression: obstacles were where the simulation has them, but the robot where its model places it."""
    box = '<geom name="box" size="0.1 0.1 0.1" type="box" pos="1.1 0 0.2"/>'
    model = mujoco.MjModel.from_xml_string(PLACED.replace("<worldbody>", f"<worldbody>{box}"))
    other = mujoco.MjData(mujoco.MjModel.from_xml_string("<mujoco/>"))  # Regression: memory was corrupted
    refuses("data is of another model", rd.Scene.from_mujoco, model, other)
    data = mujoco.MjData(model)
    data.qpos[1] = 0.5  # a joint that is planned
    assert len(rd.Scene.from_mujoco(model, data).shapes) == 1
    data.qpos[0] += 0.4
    refuses("data moves the robot, but a robot is loaded where", rd.Scene.from_mujoco, model, data)
    [shape] = rd.Scene.from_mujoco(model, data, base="base").shapes
    np.testing.assert_allclose(shape.bounds.mean(axis=0), [0.6, 0, 0], atol=1e-12)


def test_planes_are_boxes_around_the_base_at_least_as_large_as_drawn() -> None:
    """Regression: floors were obstacles only where MuJoCo draws them, but in MuJoCo nothing passes them anywhere."""
    model = mujoco.MjModel.from_xml_string("""<mujoco><worldbody>
      <geom name="floor" type="plane" size="0.1 7 0.1" pos="7 0 -0.2"/>
      <geom name="ramp" type="plane" size="0 0 0.1" pos="3 0 0" euler="0 30 0" contype="2" conaffinity="0"/>
      <body pos="-2 0 0.29"><freejoint/><geom size="0.5"/></body></worldbody></mujoco>""")
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert data.contact.dist == pytest.approx([-0.01])
    floor, ramp, _ = rd.Scene.from_mujoco(model, data).shapes
    np.testing.assert_allclose(floor.bounds, [[-5, -7, -0.3], [5, 7, -0.2]], atol=1e-12)
    normal = np.array([0.5, 0, np.sqrt(0.75)])
    np.testing.assert_allclose(ramp.bounds.mean(axis=0), (1.5 - 0.05) * normal, atol=1e-12)  # the plane is 1.5 m from the base


def test_a_free_body_with_joints_is_the_robot_if_nothing_else_is(tmp_path: Path) -> None:
    """Regression: a humanoid without actuators "has no robot: no body is moved by a hinge or a slide joint"."""
    free = '<joint name="x" type="free"/>'
    tree = read(tmp_path, re.sub("<joint name=.x.*?/>", free, PLACED).replace("0.3 0.5", "0 0 1 1 0 0 0 0.5"))
    assert tree.robot().joint_names == ("j",)
    assert any("the free joint of base is held" in note for note in tree.notes)


OVERLAPPING = """
<mujoco><worldbody><body name="base"><geom size="0.1"/>
  <body name="arm" pos="0 0 0.3"><joint name="a" axis="0 0 1" range="-90 90"/><geom size="0.05"/>
    <body name="cuff" pos="0 0 0.1"><joint name="b" axis="0 0 1" range="-90 90"/><geom size="0.03"/>
      <body name="ring" pos="0 0 -0.1"><joint name="c" axis="0 0 1" range="-90 90"/><geom size="0.03"/>{}</body>
  </body></body></body></worldbody></mujoco>
"""
FINGERS = """<body name="palm" pos="0 0 0.3"><joint name="d" axis="0 1 0" range="-90 90"/><geom size="0.02"/>
  <body name="f" pos="0.01 0 0.1"><joint name="finger1" type="slide" axis="1 0 0" range="0 0.1"/><geom size="0.02"/></body>
  <body name="g" pos="-0.01 0 0.1"><joint name="finger2" type="slide" axis="1 0 0" range="-0.1 0"/><geom size="0.02"/></body>
</body>"""


def test_links_that_always_touch_are_noted(tmp_path: Path) -> None:
    """Regression: pairs that MuJoCo checks were dropped without a note if they always overlap; so were those of held links."""
    (tmp_path / "m.xml").write_text(OVERLAPPING.format(FINGERS))
    with coarse_grids():
        robot = add_robot(tmp_path / "m.xml", out=tmp_path / "robot", settings=QUICK).robot
    assert any("touch in all motions are not checked: arm and ring, f and g; if" in note for note in robot.notes)


TURNED = (FILES / "turned.xml").read_text()


def test_mirrored_meshes_are_where_mujoco_has_them_and_what_is_not_driven_is_none(tmp_path: Path) -> None:
    trimesh.creation.box([0.1, 0.2, 0.1]).apply_translation([0.02, 0.05, 0.0]).export(tmp_path / "part.stl")
    tree = read(tmp_path, TURNED)
    robot = tree.robot()
    assert robot.joint_names == ("j",) and "other" not in robot.link_names
    data = state_of(mujoco.MjModel.from_xml_path(str(tmp_path / "m.xml")), robot, np.array([0.5]))
    for name in ("base", "arm"):
        expected = np.column_stack([data.body(name).xmat.reshape(3, 3), data.body(name).xpos])
        np.testing.assert_allclose(robot.fk(np.array([0.5]), name)[:3], expected, atol=1e-9)
    [wedge] = tree.surfaces("base")
    np.testing.assert_allclose(wedge.vertices.min(axis=0), [-0.03, -0.075, -0.1], atol=1e-6)
    np.testing.assert_allclose(wedge.vertices.max(axis=0), [0.07, 0.025, 0.1], atol=1e-6)


HOLLOW = """<mujoco><asset><mesh name="u" vertex="{}" face="{}"/></asset><worldbody>
  <body name="base"><joint name="j" range="-1 1"/><geom type="mesh" mesh="u"/></body>
</worldbody></mujoco>"""


def test_meshes_that_collide_are_hulls_as_for_mujoco(tmp_path: Path) -> None:
    """A link has a hollow. MuJoCo collides with its hull, so a motion through the hollow is in collision."""
    legs = [trimesh.creation.box([0.1, 0.1, 0.3]).apply_translation([x, 0, 0]) for x in (-0.2, 0.2)]
    vertices = np.concatenate([leg.vertices for leg in legs])
    faces = np.concatenate([legs[0].faces, legs[1].faces + len(legs[0].vertices)])
    numbers = (" ".join(map(str, values.ravel().tolist())) for values in (vertices, faces))
    [surface] = read(tmp_path, HOLLOW.format(*numbers)).surfaces("base")
    bounds = surface.vertices.max(axis=0) - surface.vertices.min(axis=0)
    np.testing.assert_allclose(trimesh.Trimesh(surface.vertices, surface.faces).volume, np.prod(bounds), rtol=1e-6)
