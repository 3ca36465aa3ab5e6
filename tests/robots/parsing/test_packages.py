"""Mesh files, packages and xacro files."""

import sys
from pathlib import Path

import pytest
import trimesh

import robotdiffuse as rd
from helpers.made_arms import BALL, chain, joint, link, read_urdf, row, written
from robotdiffuse.robots.parsing.urdf import UrdfTree

NAME = "package://some_arm/meshes/box.stl"
MESH = f'<collision><geometry><mesh filename="{NAME}"/></geometry></collision>'
PARTS = chain("base", row("j", 3)) + link("end", MESH) + joint("j4", "j3_link", "end")


def mesh(folder: Path) -> Path:
    (folder / "meshes").mkdir(parents=True)
    trimesh.creation.box([0.1, 0.1, 0.1]).export(folder / "meshes" / "box.stl")
    return folder


def test_packages_by_option_environment_and_upwards(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    far = mesh(tmp_path / "ws" / "src" / "some_arm")
    (tmp_path / "elsewhere").mkdir()
    file = written(tmp_path / "elsewhere", PARTS)
    with pytest.raises(rd.InputError, match="--package some_arm=FOLDER, or ROS_PACKAGE_PATH") as error:
        read_urdf(file)
    assert NAME in str(error.value) and "\n" not in str(error.value)
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
    (far / "urdf").mkdir()
    assert "end" in read_urdf(written(far / "urdf", PARTS)).meshes


def xacro(folder: Path, content: str, name: str = "made.urdf.xacro") -> Path:
    file = folder / name
    file.write_text(f'<robot name="made" xmlns:xacro="http://www.ros.org/wiki/xacro">{content}</robot>')
    return file


def test_xacro_is_compiled_with_what_it_includes(tmp_path: Path) -> None:
    pytest.importorskip("xacrodoc")
    part = mesh(tmp_path / "some_arm")
    macro = '<xacro:macro name="solid" params="name"><link name="${name}">' + BALL + "</link></xacro:macro>"
    (part / "urdf").mkdir()
    xacro(part / "urdf", macro, "solid.xacro")
    (tmp_path / "top").mkdir()
    content = (
        '<xacro:include filename="$(find some_arm)/urdf/solid.xacro"/><xacro:property name="n" value="3"/>'
        '<xacro:solid name="base"/>' + PARTS.replace('name="j3"', 'name="j${n}"')
    )
    file = xacro(tmp_path / "top", content)
    robot = read_urdf(file)
    assert robot.joint_names == ("j1", "j2", "j3", "j4") and "end" in robot.meshes
    assert "runs the code" in robot.notes[0]
    digest = UrdfTree(file, {}, compile_xacro=True).digest
    xacro(part / "urdf", macro.replace("0.04", "0.05"), "solid.xacro")
    assert UrdfTree(file, {}, compile_xacro=True).digest != digest  # of the compiled URDF, not of the file


def test_xacro_includes_files_beside_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In any working directory; a file named .urdf can contain xacro."""
    pytest.importorskip("xacrodoc")
    mesh(tmp_path / "some_arm")
    (tmp_path / "some_arm" / "part").mkdir()
    xacro(tmp_path / "some_arm" / "part", PARTS, "arm.xacro")
    content = link("base") + '<xacro:include filename="part/arm.xacro"/>'
    file = xacro(tmp_path / "some_arm", content, "made.urdf")
    monkeypatch.chdir("/")
    assert read_urdf(file).dof == 4


def test_prefixes_of_simulators_need_no_declaration(tmp_path: Path) -> None:
    more = '<drake:group name="a:b"><drake:member link="x"/></drake:group><!-- see http://a.b -->'
    file = written(tmp_path, chain("base", row("j", 3)), more)
    file.write_text(file.read_text().replace('velocity="2"', 'velocity="2" drake:acceleration="3"'))
    assert read_urdf(file).dof == 3


def test_xacro_that_cannot_be_compiled_says_what_helps(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("xacrodoc")
    for content, message in (
        ('<xacro:include filename="$(find lost)/a.xacro"/>', "'lost' is not found; .*--package lost="),
        ('<xacro:nothing name="a"/>', "xacro cannot compile it .*; compile it with its arguments: xacro"),
    ):
        with pytest.raises(rd.InputError, match=message) as raised:
            read_urdf(xacro(tmp_path, content))
        assert "\n" not in str(raised.value)
    monkeypatch.setitem(sys.modules, "xacrodoc", None)
    with pytest.raises(rd.InputError, match=r"pip install 'robotdiffuse\[xacro\]'"):
        read_urdf(xacro(tmp_path, PARTS))


def test_only_robot_add_compiles_xacro(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A problem, a result or a certificate that names a URDF ran the code in its expressions."""
    monkeypatch.setenv("ROBOTDIFFUSE_ROBOTS", str(tmp_path / "robots"))
    namespace = "http://www.ros.org/wiki/xacro"
    property_ = f'<x:property xmlns:x="{namespace}" name="a" value="1"/>'
    for name, content in (
        ("named.urdf.xacro", PARTS),
        ("arm.XACRO.xml", PARTS),
        ("prefix.urdf", '<xacro:property name="a" value="1"/>' + PARTS),
        ("namespace.urdf", property_ + PARTS),
        ("expression.urdf", PARTS.replace('name="j1"', 'name="${[].clear()}"')),
        ("argument.urdf", PARTS.replace('name="j1"', 'name="$(arg prefix)"')),
    ):
        file = xacro(tmp_path, link("base") + content, name)
        with pytest.raises(
            rd.InputError, match=r"is a xacro file.* robotdiffuse robot add .*--name"
        ) as raised:
            rd.load_robot(file)
        assert "\n" not in str(raised.value)


def test_a_urdf_that_xacro_wrote_is_no_xacro(tmp_path: Path) -> None:
    """It still declares the namespace."""
    mesh(tmp_path)
    file = xacro(tmp_path, link("base") + PARTS, "made.urdf")
    assert UrdfTree(file, {}).robot().dof == 4


def test_blanks_of_file_names_may_be_escaped(tmp_path: Path) -> None:
    trimesh.creation.box([0.1, 0.1, 0.1]).export(tmp_path / "my box.stl")
    for name in ("my%20box.stl", "file://my%20box.stl", "package://some_arm/my%20box.stl"):
        assert "end" in read_urdf(written(tmp_path, PARTS.replace(NAME, name))).meshes
