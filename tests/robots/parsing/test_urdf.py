"""Reading URDFs with their mesh files, packages and xacro; robot folders; adding robots."""

import json
import re
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

import robotdiffuse as rd
from helpers.made_arms import BALL, chain, joint, link, read_urdf, row, written
from helpers.quick_preparation import QUICK, coarse_grids
from helpers.refusals import refuses
from robotdiffuse.core import files as core_files
from robotdiffuse.core.transforms import quaternion_from_rotation, rotation_from_rpy
from robotdiffuse.robots import DATA, load_robot, robot_folder
from robotdiffuse.robots.fitting import preparation
from robotdiffuse.robots.fitting.convex_parts import MIN_THICKNESS, Surface, convex_hull
from robotdiffuse.robots.fitting.preparation import PreparationSettings, add_robot
from robotdiffuse.robots.fitting.self_collisions import SamplingSettings
from robotdiffuse.robots.fitting.sphere_fitting import covered
from robotdiffuse.robots.kinematic_tree import CONTINUOUS_LIMIT
from robotdiffuse.robots.parsing.urdf import UrdfTree, read_limits, with_limits
from robotdiffuse.robots.robot_folder import read_robot_folder, read_source, write_robot_folder

ARM = (Path(__file__).parents[2] / "files" / "tiny.urdf").read_text()
GRIPPER = (Path(__file__).parents[2] / "files" / "gripper.xml").read_text()


def urdf(folder: Path, text: str = ARM) -> Path:
    file = folder / "tiny.urdf"
    file.write_text(text)
    return file


def test_joints_limits_and_geometry(tmp_path: Path) -> None:
    robot = read_urdf(urdf(tmp_path))
    assert (robot.name, robot.base, robot.tip) == ("tiny", "base", "fore") and robot.joint_names == ("turn", "bend")
    np.testing.assert_allclose([robot.lower, robot.upper], [[-2, -CONTINUOUS_LIMIT], [1, CONTINUOUS_LIMIT]])
    np.testing.assert_allclose([robot.velocity, robot.acceleration, robot.jerk], [[1.5, 1.0], [6, 4], [60, 40]])
    np.testing.assert_allclose(robot.planned_joints[0].axis, [0, 0, 1])
    assert any("bend" in note and "velocity" in note for note in robot.notes)
    box = robot.meshes["upper"][0].vertices
    assert len(box) == 8
    np.testing.assert_allclose(np.linalg.norm(box[:, :2], axis=1), 0.03 * 2**0.5)
    np.testing.assert_allclose(np.unique(box[:, 2].round(9)), [0, 0.3])


@pytest.mark.parametrize(
    "corners, thin",
    [
        ([[0, 0, 0], [0.1, 0, 0], [0.1, 0.1, 0], [0, 0.1, 0]], 1),
        ([[0, 0, 0], [0.1, 0, 0], [0.2, 0, 0], [0.3, 0, 1e-7]], 2),
        ([[0.1, 0.1, 0.1]] * 4, 3),
    ],
)
def test_what_has_no_thickness_is_given_some(corners: list[list[float]], thin: int) -> None:
    """The hulls of a sheet, a line and a point are thickened by half a millimeter to each side."""
    turned = np.array(corners, float) @ rotation_from_rpy(0.3, -0.8, 1.2).T
    hull = convex_hull(turned)
    solid = trimesh.Trimesh(hull.vertices, hull.faces, process=False)
    size = np.sort(solid.bounding_box_oriented.primitive.extents)
    np.testing.assert_allclose(size[:thin], MIN_THICKNESS, rtol=0.01)
    assert solid.is_watertight and solid.volume > 0 and solid.contains(turned.mean(0)[None]).all()


def test_bad_arguments_give_one_clear_line(tmp_path: Path) -> None:
    file = urdf(tmp_path)
    refuses(r"none\.urdf", read_urdf, tmp_path / "none.urdf")
    refuses("'nowhere'; known: base, fore, upper", read_urdf, file, base="nowhere")
    refuses("'base'; known: fore", read_urdf, file, base="fore", tip="base")
    refuses("no movable joint", read_urdf, file, base="fore")
    refuses("'wrist'", read_urdf, file, locked={"wrist": 0.0})
    refuses("baxter_left, baxter_right, ", load_robot, "no_such_robot")
    refuses(r"arm\.urdf", load_robot, "nowhere/arm.urdf")
    refuses(r"arm\.usda is a USD file; robots are read from URDF", load_robot, "arm.usda")


def same(a: rd.Robot, b: rd.Robot) -> None:
    assert (a.name, a.base, a.tip, a.locked, a.notes) == (b.name, b.base, b.tip, b.locked, b.notes)
    assert a.allowed_collisions == b.allowed_collisions
    assert [(j.name, j.kind, j.lower, j.jerk) for j in a.joints] == [(j.name, j.kind, j.lower, j.jerk) for j in b.joints]
    np.testing.assert_allclose(a.frame_offsets, b.frame_offsets, atol=1e-12)
    assert a.meshes.keys() == b.meshes.keys() and a.spheres.keys() == b.spheres.keys()
    for name in a.meshes:
        for first, second in zip(a.meshes[name], b.meshes[name], strict=True):
            np.testing.assert_array_equal(first.vertices, second.vertices)
            np.testing.assert_array_equal(first.faces, second.faces)
    for name in a.spheres:
        np.testing.assert_allclose(a.spheres[name], b.spheres[name], atol=1e-6)


def test_robot_folder_round_trip(tmp_path: Path) -> None:
    robot = replace(
        read_urdf(urdf(tmp_path, ARM.replace("</robot>", GRIPPER))),
        spheres={"upper": np.array([[0, 0, 0.1, 0.2], [0, 0, 0.2, 0.1]])},
        allowed_collisions=frozenset({frozenset(("base", "upper"))}),
    )
    folder = tmp_path / "out" / "tiny"
    write_robot_folder(robot, folder, {"urdf": "tiny.urdf", "sha256": "x"})
    (folder / "other.txt").write_text("kept")
    write_robot_folder(robot, folder, {"urdf": "tiny.urdf", "sha256": "y"})
    same(robot, read_robot_folder(folder))
    assert read_source(folder)["sha256"] == "y"
    assert sorted(file.name for file in folder.iterdir()) == ["meshes.npz", "other.txt", "robot.json"]


def damage_json(**change: object) -> str:
    data = json.loads((DATA / "panda" / "robot.json").read_text()) | change
    return json.dumps({key: value for key, value in data.items() if value is not None})


@pytest.mark.parametrize(
    "file, content",
    [
        ("robot.json", "{"),
        ("robot.json", damage_json(format=99)),
        ("robot.json", damage_json(joints=None)),
        ("robot.json", damage_json(spheres={"panda_link1": [[0, 0, 0]]})),
        ("robot.json", damage_json(spheres={"nobody": [[0, 0, 0, 1]]})),
        ("robot.json", damage_json(tip="nobody")),
        ("meshes.npz", "no archive"),
    ],
)
def test_damaged_folder_names_the_file(file: str, content: str, tmp_path: Path) -> None:
    for name in ("robot.json", "meshes.npz"):
        (tmp_path / name).write_bytes((DATA / "panda" / name).read_bytes())
    (tmp_path / file).write_text(content)
    refuses(file, read_robot_folder, tmp_path)
    (tmp_path / file).unlink()
    refuses(file, read_robot_folder, tmp_path)


def test_limits_file(tmp_path: Path) -> None:
    file = tmp_path / "limits.yaml"
    file.write_text(
        "joint_limits:\n"
        "  turn: {has_velocity_limits: true, max_velocity: 2, max_effort: 9, has_jerk_limits: false, max_jerk: 1}\n"
        "  bend: {max_acceleration: 3.5, min_position: -1, has_jerk: false}\n"  # as KUKA's files have it
    )
    robot = with_limits(read_urdf(urdf(tmp_path)), read_limits(file)[0])
    assert robot.planned_joints[0].effort == 9
    found = [robot.lower, robot.velocity, robot.acceleration, robot.jerk]
    np.testing.assert_allclose(found, [[-2, -1], [2, 1], [8, 3.5], [80, 35]])
    # regression: a lower velocity raised the acceleration that the URDF states
    stated = replace(robot, joints=tuple(replace(j, acceleration=2.0, jerk=20.0) for j in robot.joints))
    slower = with_limits(stated, {"turn": {"velocity": 1.5}}).planned_joints[0]
    assert (slower.velocity, slower.acceleration, slower.jerk) == (1.5, 2.0, 20.0)
    file.write_text("default_velocity_scaling_factor: 0.1\njoint_limits: {j: {max_velocity: 1}}\n")
    note = "limits.yaml: default_velocity_scaling_factor 0.1 is ignored; plan with velocity_scaling=0.1"
    assert read_limits(file) == ({"j": {"velocity": 1.0}}, (note,))
    for text, message in (
        ("joint_limits: [", "not valid YAML"),
        ("limits: {}", "no joint_limits"),
        ("joint_limits: {turn: {max_speed: 1}}", "'max_speed'"),
        ("joint_limits: {turn: {max_velocity: -1}}", "max_velocity of turn is -1"),
        ("joint_limits: {turn: {max_velocity: 1.0e-300}}", "is 1e-300; it must be a number from 1e-06"),
        ("joint_limits: {turn: {max_deceleration: 1}}", "set max_acceleration to the smaller of both"),
        ("joint_limits: {wrist: {max_velocity: 1}}", "'wrist'"),
        ("joint_limits: {turn: {min_position: 5}}", "turn: min_position"),
    ):
        file.write_text(text)
        refuses(re.escape(message), lambda: with_limits(read_urdf(urdf(tmp_path)), read_limits(file)[0]))


def test_limits_of_a_file_decide_which_joints_are_held(tmp_path: Path) -> None:
    """A joint with equal new limits was planned, which inverse kinematics cannot do; a held joint stayed outside of its."""
    tree = UrdfTree(urdf(tmp_path, ARM.replace("</robot>", GRIPPER)), {})
    robot = tree.robot(limits={"bend": {"lower": 0.5, "upper": 0.5, "velocity": 2.0}, "grip": {"lower": 0.02}})
    assert robot.joint_names == ("turn",) and robot.locked == {"bend": 0.5, "grip": 0.02, "grip2": 0.02}
    assert not any("no velocity limit" in note for note in robot.notes)


def test_add_and_load_by_name_and_by_urdf(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROBOTDIFFUSE_ROBOTS", str(tmp_path / "robots"))
    balls = re.sub("<(box|cylinder) .*?/>", '<sphere radius="0.15"/>', ARM)  # which are fitted quickly
    file = urdf(tmp_path, balls)
    steps = []
    quick = PreparationSettings(sampling=SamplingSettings(samples=200), samples=200, rounds=0)
    monkeypatch.setattr(preparation, "PreparationSettings", lambda: quick)
    with coarse_grids():
        report = add_robot(file, progress=lambda what, step, count: steps.append((step, count)))
    assert report.folder == tmp_path / "robots" / "tiny"
    assert steps[0] == (0, 8) and steps[-1] == (8, 8)
    for fitted in report.links:
        assert fitted.covered and fitted.stick_out <= 0.0151
        assert covered(report.robot.meshes[fitted.link], report.robot.spheres[fitted.link])
    assert {pair.links: pair.reason for pair in report.pairs}["base", "upper"] == "adjacent"
    for key in ("tiny", str(file), file, str(report.folder)):
        same(load_robot(key), report.robot)
    refuses(r"known: .*panda, .*tiny", load_robot, "other")
    # a changed URDF is another robot, prepared and stored anew
    larger = urdf(tmp_path, balls.replace('radius="0.15"', 'radius="0.16"'))
    with coarse_grids():
        changed = load_robot(larger)
    assert any("spheres were fitted" in note for note in changed.notes)
    assert np.ptp(changed.meshes["upper"][0].vertices[:, 2]) == pytest.approx(0.32, rel=0.05)
    kept = tmp_path / "robots" / f"tiny-{UrdfTree(larger, {}).digest[:8]}"
    stamp = (kept / "robot.json").stat().st_mtime_ns
    assert load_robot(larger) is load_robot(larger)
    assert (kept / "robot.json").stat().st_mtime_ns == stamp


def test_quaternions_of_joints_turn_what_follows(tmp_path: Path) -> None:
    """Regression: `quat_xyzw` was ignored."""
    wxyz = quaternion_from_rotation(rotation_from_rpy(0.3, -0.4, 0.5))
    xyzw = " ".join(map(str, np.roll(wxyz, -1)))
    turned = {}
    for how in ('rpy="0.3 -0.4 0.5"', f'quat_xyzw="{xyzw}"'):
        file = written(tmp_path, chain("base", ["j"]))
        file.write_text(file.read_text().replace('<origin xyz="0 0 0.1"/>', f'<origin xyz="0 0 0.1" {how}/>'))
        turned[how] = read_urdf(file).joints[0].T_parent_joint
    np.testing.assert_allclose(*turned.values(), atol=1e-12)


def test_a_wheel_without_limits_is_held_and_a_planned_joint_without_limits_is_refused(tmp_path: Path) -> None:
    """Regression: Centauro was refused for the sake of its wheels, which no arm needs."""
    wheel = [link("wheel"), joint("wheel_joint", "base", "wheel", limits="")]
    file = written(tmp_path, *chain("base", row("j", 4)), *wheel)
    assert read_urdf(file).joint_names == ("j1", "j2", "j3", "j4")
    for limits in ({}, {"wheel_joint": {"velocity": 1.0}}):
        refuses("made.urdf: wheel_joint: no <limit lower= upper=>; add it", read_urdf, file, tip="wheel", limits=limits)
    refuses("joints of x form a loop", read_urdf, written(tmp_path, *chain("base", ["j"]), link("x"), joint("k", "x", "x")))
    held = chain("base", ["j1"], limits=""), chain("j1_link", ["j2"])
    assert read_urdf(written(tmp_path, *held), locked={"j1": 1.0}).joint_names == ("j2",)


def test_limits_beyond_all_measure_stand_for_none(tmp_path: Path) -> None:
    """Regression: iCub (1e9 rad/s), and wheels and propellers, continuous or revolute, with 1e16 rad or inf were refused."""
    endless = chain("base", ["j"], kind="continuous", limits='lower="-1e+16" upper="inf"')
    assert read_urdf(written(tmp_path, endless)).upper == [CONTINUOUS_LIMIT]
    fast = chain("base", ["j"]).replace('velocity="2"', 'velocity="1e+9"')
    propeller = link("propeller") + joint("turn", "base", "propeller", limits='lower="0.5" upper="1e+16"')
    robot = read_urdf(written(tmp_path, fast, propeller), tip="j_link")
    assert robot.velocity == [1.0] and robot.locked == {"turn": 0.0} and "no velocity limit for j; 1 assumed" in robot.notes


def test_soft_limits_are_noted(tmp_path: Path) -> None:
    soft = '<safety_controller k_velocity="20" soft_lower_limit="-1" soft_upper_limit="1"/>'
    [note] = read_urdf(written(tmp_path, chain("base", ["j"], more=soft))).notes
    assert note.startswith("joint j: the soft limits") and "lower -1, upper 1" in note
    same = chain("base", ["j"], limits='lower="-1" upper="1"', more=soft)
    assert not any("soft" in note for note in read_urdf(written(tmp_path, same)).notes), "they are the limits themselves"


def test_a_mesh_without_volume_is_noted(tmp_path: Path) -> None:
    trimesh.Trimesh([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0.1, 0.1, 0]], [[0, 1, 2], [1, 3, 2]]).export(tmp_path / "plate.stl")
    plate = '<collision><geometry><mesh filename="plate.stl"/></geometry></collision>'
    robot = read_urdf(written(tmp_path, chain("base", ["j"]), link("end", plate), joint("k", "j_link", "end")))
    assert "link end has collision geometry without volume, made 1 mm thick" in robot.notes


def test_preparations_of_one_urdf_that_differ_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Regression: the first robot by alphabet was used, and a motion through the arm itself was called valid."""
    monkeypatch.setenv("ROBOTDIFFUSE_ROBOTS", str(tmp_path / "robots"))
    file = written(tmp_path, chain("base", row("j", 3)))
    with coarse_grids():
        for name in ("plain", "same"):
            add_robot(file, name=name, settings=QUICK)
        assert load_robot(file).joint_names == ("j1", "j2", "j3")
        limits = tmp_path / "limits.yaml"
        limits.write_text("joint_limits: {j1: {max_velocity: 1}}")
        add_robot(file, name="limited", limits=limits, settings=QUICK)
    refuses("was added as limited, plain, same, which differ", load_robot, file)


@pytest.mark.parametrize("given", [True, False])
def test_a_robot_whose_srdf_changed_is_to_be_made_again(given: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Regression: a URDF was loaded with the poses and exclusions of its former SRDF."""
    monkeypatch.setenv("ROBOTDIFFUSE_ROBOTS", str(tmp_path / "robots"))
    file = written(tmp_path, chain("base", row("j", 3)))
    srdf = tmp_path / "made.srdf"
    srdf.write_text("<robot name='made'/>")
    other = tmp_path / "other.srdf"
    other.write_text("<robot name='made'> </robot>")
    with coarse_grids():
        made = add_robot(file, settings=QUICK, srdf=srdf if given else None).robot
        same(load_robot(file), made)
        srdf.write_text("<robot name='made'><group_state name='up'><joint name='j1' value='1'/></group_state></robot>")
        refuses(r"SRDF of .* has changed since .*by this name, or .*robot add .*made.urdf --name made", load_robot, file)
        same(load_robot("made"), made)
        add_robot(file, settings=QUICK, name="again", srdf=srdf if given else None)
        assert load_robot(file).poses == {"up": {"j1": 1.0}}
        add_robot(file, settings=QUICK, name="again", srdf=other)
    assert load_robot(file).poses == {}, "a robot with another SRDF does not depend on this one"


@pytest.mark.parametrize("name", ["panda", "my.urdf", "two\nlines"])
def test_names_by_which_an_added_robot_could_not_be_loaded_are_refused(name: str, tmp_path: Path) -> None:
    """Regression: the bundled panda was used in place of an added robot with this name."""
    file = written(tmp_path, chain("base", ["j"]))
    message = r".*without a file ending, and not that of a bundled robot: give --name NAME"
    refuses(message, add_robot, file, name=name, settings=QUICK)


@pytest.mark.parametrize(
    ("how", "message"),
    [
        ({"allow": [("base", "base")]}, "allow has the entry .*it must name two links"),
        ({"srdf": "arm.urdf"}, "its root <robot> must be a <robot> without <link>"),
        ({"srdf": "other.srdf"}, "is for another robot: it names no link"),
    ],
)
def test_pairs_of_another_robot_and_of_one_link_are_refused(how: dict, message: str, tmp_path: Path) -> None:
    """Regression: they were ignored."""
    file = written(tmp_path, chain("base", ["j"]))
    (tmp_path / "arm.urdf").write_text(file.read_text())
    (tmp_path / "other.srdf").write_text('<robot name="o"><disable_collisions link1="x" link2="y"/></robot>')
    if "srdf" in how:
        how = {"srdf": tmp_path / how["srdf"]}
    refuses(message, add_robot, file, name="arm", settings=QUICK, **how)


@pytest.mark.parametrize("tag", ["origin", "axis", "limit"])
def test_a_joint_has_each_element_once(tag: str, tmp_path: Path) -> None:
    """Regression: all but the first were ignored."""
    file = written(tmp_path, chain("base", ["j"]))
    file.write_text(file.read_text().replace("</joint>", 2 * f'<{tag} xyz="0 0 1"/>' + "</joint>"))
    refuses(f"a <joint> must have one <{tag}>, not more", read_urdf, file)


def test_a_robot_that_is_written_again_is_never_a_mixture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Regression: new meshes with the old robot.json, if `robot add` was interrupted or ran twice at once."""
    robot = load_robot("ur5")

    def interrupted(file: Path, *rest: object) -> None:
        core_files.write_atomically(file, *rest)  # type: ignore[arg-type]
        if file.name == "meshes.npz":
            raise KeyboardInterrupt

    write_robot_folder(robot, tmp_path, {})
    monkeypatch.setattr(robot_folder, "write_atomically", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_robot_folder(robot, tmp_path, {})
    assert not (tmp_path / "robot.json").exists()
    with core_files.lock_folder(tmp_path), pytest.raises(rd.InputError, match="another process is filling"):
        write_robot_folder(robot, tmp_path, {})


def surfaces(file: Path, shape: str, origin: str = "") -> tuple[Surface, ...]:
    link = f'<link name="arm"><collision>{origin}<geometry>{shape}</geometry></collision></link>'
    file.write_text(f'<robot name="arm">{link}</robot>')
    return UrdfTree(file, {}).surfaces("arm")


@pytest.mark.parametrize(
    ("shape", "volume", "extents"),
    [
        ('<box size="0.1 0.2 0.3"/>', 0.006, [0.1, 0.2, 0.3]),
        ('<sphere radius="0.1"/>', 4 / 3 * np.pi * 1e-3, [0.2] * 3),
        ('<cylinder radius="0.1" length="0.5"/>', np.pi * 5e-3, [0.2, 0.2, 0.5]),
        ('<capsule radius="0.1" length="0.5"/>', np.pi * (5e-3 + 4 / 3 * 1e-3), [0.2, 0.2, 0.7]),
    ],
)
def test_polyhedra_lie_closely_around_primitives(tmp_path: Path, shape: str, volume: float, extents: list[float]) -> None:
    [surface] = surfaces(tmp_path / "arm.urdf", shape)
    solid = trimesh.Trimesh(surface.vertices, surface.faces, process=False)
    assert solid.is_watertight and -1e-9 < solid.volume / volume - 1 < 0.06 and (solid.extents > np.array(extents) - 1e-9).all()
    np.testing.assert_allclose(solid.extents, extents, rtol=0.03)


def test_meshes_by_package_relative_and_scaled(tmp_path: Path) -> None:
    package = mesh(tmp_path / "my_arm")
    (package / "urdf").mkdir()
    for name in ("package://my_arm/meshes/ring.stl", "../meshes/ring.stl", "../meshes/ring.glb"):  # glTF is not turned
        trimesh.creation.annulus(0.02, 0.03, 0.1).export(package / "meshes" / Path(name).name)
        [ring] = surfaces(package / "urdf" / "arm.urdf", f'<mesh filename="{name}" scale="2 2 1"/>', '<origin xyz="0 0 1"/>')
        assert np.linalg.norm(ring.vertices[:, :2], axis=1).max() == pytest.approx(0.06)
        np.testing.assert_allclose(ring.vertices[:, 2].mean(), 1.0, atol=1e-6)
    assert surfaces(tmp_path / "arm.urdf", '<box size="0 0 0.0"/>') == (), "as of Jaco's root"


@pytest.mark.parametrize(
    ("shape", "message"),
    [
        ("", "link arm: a <collision> has 0 shapes"),
        ('<box size="1 1 1"/><sphere radius="3"/>', "link arm: a <collision> has 2 shapes"),
        ('<torus size="1"/>', "shape <torus> is not supported; known: box, capsule, cylinder, mesh, sphere"),
        ('<cylinder radius="0" length="1"/>', "link arm: cylinder radius is '0'; it must be at least 1e-9"),
        ('<mesh filename="a.stl" scale="1 0 1"/>', "link arm: mesh scale is '1 0 1'; numbers must be beyond"),
    ],
)
def test_what_is_no_shape_is_refused_by_one_line(shape: str, message: str, tmp_path: Path) -> None:
    trimesh.creation.box([1, 1, 1]).export(tmp_path / "a.stl")
    assert refuses(message, surfaces, tmp_path / "arm.urdf", shape).count(str(tmp_path / "arm.urdf")) == 1


NAME = "package://some_arm/meshes/box.stl"
MESH = f'<collision><geometry><mesh filename="{NAME}"/></geometry></collision>'
PARTS = chain("base", row("j", 3)) + link("end", MESH) + joint("j4", "j3_link", "end")


def mesh(folder: Path) -> Path:
    (folder / "meshes").mkdir(parents=True)
    trimesh.creation.box([0.1, 0.1, 0.1]).export(folder / "meshes" / "box.stl")
    return folder


def test_packages_by_option_environment_and_upwards(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    far = mesh(tmp_path / "ws" / "src" / "some_arm")
    file = written(tmp_path / "elsewhere", PARTS)
    assert NAME in refuses("ROS_PACKAGE_PATH, or robot add --package some_arm=FOLDER", read_urdf, file)
    assert "end" in read_urdf(file, packages={"some_arm": far}).meshes
    assert UrdfTree(file, {"some_arm": far}).digest
    for variable, folder in (
        ("ROS_PACKAGE_PATH", far.parent),
        ("ROS_PACKAGE_PATH", far),
        ("AMENT_PREFIX_PATH", mesh(tmp_path / "install" / "share" / "some_arm").parents[1]),
    ):
        with monkeypatch.context() as patch:
            patch.setenv(variable, f"/nowhere:{folder}")
            assert "end" in read_urdf(file).meshes
    file = written(far / "urdf", PARTS)
    assert "end" in read_urdf(file).meshes
    (far / "meshes" / "box.stl").unlink()
    refuses(f"does not exist .the package is {far}.; give", read_urdf, file)


def xacro(folder: Path, content: str, name: str = "made.urdf.xacro") -> Path:
    folder.mkdir(exist_ok=True)
    file = folder / name
    file.write_text(f'<robot name="made" xmlns:xacro="http://www.ros.org/wiki/xacro">{content}</robot>')
    return file


def test_xacro_is_compiled_with_what_it_includes(tmp_path: Path) -> None:
    pytest.importorskip("xacrodoc")
    part = mesh(tmp_path / "some_arm")
    macro = '<xacro:macro name="solid" params="name"><link name="${name}">' + BALL + "</link></xacro:macro>"
    xacro(part / "urdf", macro, "solid.xacro")
    content = (
        '<xacro:include filename="$(find some_arm)/urdf/solid.xacro"/><xacro:property name="n" value="3"/>'
        '<xacro:solid name="base"/>' + PARTS.replace('name="j3"', 'name="j${n}"')
    )
    file = xacro(tmp_path / "top", content)
    robot = read_urdf(file)
    assert robot.joint_names == ("j1", "j2", "j3", "j4") and "end" in robot.meshes and "runs the code" in robot.notes[0]
    digest = UrdfTree(file, {}, compile_xacro=True).digest
    xacro(part / "urdf", macro.replace("0.04", "0.05"), "solid.xacro")
    assert UrdfTree(file, {}, compile_xacro=True).digest != digest  # of the compiled URDF, not of the file


def test_xacro_includes_files_beside_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In any working directory. A file named .urdf can also contain xacro."""
    pytest.importorskip("xacrodoc")
    folder = mesh(tmp_path / "some_arm")
    xacro(folder / "part", PARTS, "arm.xacro")
    file = xacro(folder, link("base") + '<xacro:include filename="part/arm.xacro"/>', "made.urdf")
    monkeypatch.chdir("/")
    assert read_urdf(file).dof == 4


def test_prefixes_of_simulators_need_no_declaration(tmp_path: Path) -> None:
    more = '<drake:group name="a:b"><drake:member link="x"/></drake:group><!-- see http://a.b -->'
    file = written(tmp_path, chain("base", row("j", 3)), more)
    file.write_text(file.read_text().replace('velocity="2"', 'velocity="2" drake:acceleration="3"'))
    assert read_urdf(file).dof == 3


def test_xacro_that_cannot_be_compiled_says_what_helps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("xacrodoc")
    for content, message in (
        ('<xacro:include filename="$(find lost)/a.xacro"/>', "'lost' is not found; .*--package lost="),
        (link("$(arg prefix)"), r"xacro cannot compile it \(.*\); compile it with its arguments: xacro"),
        ('<xacro:nothing name="a"/>', r"xacro cannot compile it \([^;]*\)$"),
    ):
        refuses(message, read_urdf, xacro(tmp_path, content))
    monkeypatch.setitem(sys.modules, "xacrodoc", None)
    refuses(r"pip install 'robotdiffuse\[xacro\]'", read_urdf, xacro(tmp_path, PARTS))


def test_only_robot_add_compiles_xacro(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Regression: a problem, result or certificate that names a URDF ran the code in the URDF's expressions."""
    monkeypatch.setenv("ROBOTDIFFUSE_ROBOTS", str(tmp_path / "robots"))
    for name, content in (
        ("named.urdf.xacro", PARTS),
        ("arm.XACRO.xml", PARTS),
        ("prefix.urdf", '<xacro:property name="a" value="1"/>' + PARTS),
        ("namespace.urdf", '<x:property xmlns:x="http://www.ros.org/wiki/xacro" name="a" value="1"/>' + PARTS),
        ("expression.urdf", PARTS.replace('name="j1"', 'name="${[].clear()}"')),
        ("argument.urdf", PARTS.replace('name="j1"', 'name="$(arg prefix)"')),
    ):
        file = xacro(tmp_path, link("base") + content, name)
        refuses(r"is a xacro file.* robotdiffuse robot add .*--name", rd.load_robot, file)
    # a URDF that xacro wrote still declares its namespace
    mesh(tmp_path)
    assert UrdfTree(xacro(tmp_path, link("base") + PARTS, "made.urdf"), {}).robot().dof == 4


def test_blanks_of_file_names_may_be_escaped(tmp_path: Path) -> None:
    trimesh.creation.box([0.1, 0.1, 0.1]).export(tmp_path / "my box.stl")
    for name in ("my%20box.stl", "file://my%20box.stl", "package://some_arm/my%20box.stl"):
        assert "end" in read_urdf(written(tmp_path, PARTS.replace(NAME, name))).meshes


def test_limits_of_acceleration_and_jerk_count(tmp_path: Path) -> None:
    limits = 'lower="-1" upper="1" acceleration="5" deceleration="3" jerk="7"'
    robot = read_urdf(written(tmp_path, chain("base", ["j"], limits=limits)))
    assert (robot.acceleration, robot.jerk) == ([3.0], [7.0])
