"""Robots that the kinematics tests share: four published arms, and some made by hand."""

from functools import cache
from importlib.metadata import distribution
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest

from helpers.made_arms import read_urdf
from robotdiffuse.core.transforms import transform
from robotdiffuse.robots.kinematic_tree import Joint
from robotdiffuse.robots.robot import Robot

TIPS = {"panda": "panda_hand", "iiwa": "lbr_iiwa_link_7", "xarm7": "link7", "ur5": "tool0"}
TIPS |= {"awkward": "tool", "two_arms": "left_hand"}
DESCRIPTIONS = {
    "panda": "panda_description/urdf/panda.urdf",
    "xarm7": "xarm_description/urdf/xarm7.urdf",
    "ur5": "ur_description/urdf/ur5_joint_limited_robot.urdf",
}
AWKWARD = """<robot name="awkward">
  <link name="floor"/> <link name="base"/> <link name="rail"/> <link name="turret"/> <link name="arm"/>
  <link name="bracket"/> <link name="wrist"/> <link name="flange"/> <link name="tool"/> <link name="lid"/>
  <joint name="stand" type="fixed"><parent link="floor"/><child link="base"/>
    <origin xyz="0.1 -0.2 0.3" rpy="0.3 -0.2 0.5"/></joint>
  <joint name="rail_joint" type="prismatic"><parent link="base"/><child link="rail"/>
    <origin xyz="0 0.1 0" rpy="0.1 0.2 0.3"/><axis xyz="1 2 0.5"/>
    <limit lower="-0.4" upper="0.5" velocity="1" effort="1"/></joint>
  <joint name="turret_joint" type="continuous"><parent link="rail"/><child link="turret"/>
    <origin xyz="0 0 0.2" rpy="0 0 1"/><axis xyz="0 0 -1"/><limit velocity="1" effort="1"/></joint>
  <joint name="lid_joint" type="revolute"><parent link="turret"/><child link="lid"/>
    <origin xyz="0.1 0 0"/><axis xyz="0 1 0"/><limit lower="0" upper="1" velocity="1" effort="1"/></joint>
  <joint name="arm_joint" type="revolute"><parent link="turret"/><child link="arm"/>
    <origin xyz="0.05 0 0.1" rpy="-0.4 0 0"/><axis xyz="0 1 0"/>
    <limit lower="-2" upper="1.5" velocity="1" effort="1"/></joint>
  <joint name="bracket_joint" type="fixed"><parent link="arm"/><child link="bracket"/>
    <origin xyz="0.3 0 0.02" rpy="0 0.7 0"/></joint>
  <joint name="wrist_joint" type="revolute"><parent link="bracket"/><child link="wrist"/>
    <origin xyz="0.2 0 0"/><axis xyz="1 -1 1"/>
    <limit lower="-2.5" upper="2.5" velocity="1" effort="1"/></joint>
  <joint name="flange_joint" type="continuous"><parent link="wrist"/><child link="flange"/>
    <origin xyz="0.1 0.02 0" rpy="0 1 0"/><axis xyz="0 0 1"/><limit velocity="1" effort="1"/></joint>
  <joint name="tool_joint" type="revolute"><parent link="flange"/><child link="tool"/>
    <origin xyz="0 0 0.1" rpy="1 0 0"/><axis xyz="1 0 0"/>
    <limit lower="-3" upper="3" velocity="1" effort="1"/></joint>
</robot>
"""
"""Skew axes, a prismatic and two continuous joints, a fixed joint within the chain and a branch beside it."""


def _limb(side: str, y: float, wrist: str) -> str:
    """An arm of three joints of boxes in a row, from the torso on."""
    joints = (
        ("shoulder", "torso", "upper", f"0.05 {y} 0.3", "0.2 -0.1 1", "revolute", 1.8),
        ("elbow", f"{side}_upper", "lower", "0.3 0 0.02", "0 1 0.3", "revolute", 2.2),
        ("wrist", f"{side}_lower", "hand", "0.25 0 0", "1 0 0", wrist, 0.1 if wrist == "prismatic" else 2.5),
    )
    return "".join(
        f'''<link name="{side}_{child}"><collision><origin xyz="{0.12 if child != "hand" else 0.05} 0 0"/>
          <geometry><box size="{0.24 if child != "hand" else 0.1} 0.06 0.08"/></geometry></collision></link>
        <joint name="{side}_{name}" type="{kind}"><parent link="{parent}"/><child link="{side}_{child}"/>
          <origin xyz="{xyz}" rpy="0 0.1 {-2 * y}"/><axis xyz="{axis}"/>
          <limit lower="{-limit}" upper="{limit}" velocity="2" effort="1"/></joint>'''
        for name, parent, child, xyz, axis, kind, limit in joints
    )


TWO_ARMS = f"""<robot name="two_arms">
  <link name="pedestal"><collision><geometry><box size="0.3 0.3 0.1"/></geometry></collision></link>
  <link name="torso"><collision><origin xyz="0 0 0.2"/>
    <geometry><box size="0.16 0.2 0.3"/></geometry></collision></link>
  <link name="lamp_head"/>
  <joint name="waist" type="revolute"><parent link="pedestal"/><child link="torso"/>
    <origin xyz="0 0 0.06"/><axis xyz="0 0 1"/>
    <limit lower="-1.5" upper="1.5" velocity="2" effort="1"/></joint>
  {_limb("left", 0.16, "revolute")} {_limb("right", -0.16, "prismatic")}
  <joint name="lamp" type="revolute"><parent link="pedestal"/><child link="lamp_head"/>
    <origin xyz="0.3 0 0.4"/><axis xyz="0 0 1"/><limit lower="-1" upper="1" velocity="2" effort="1"/></joint>
</robot>
"""
"""Two arms that reach each other, on a torso that a planned joint turns: a tree."""


def urdf_file(name: str, folder: Path) -> Path:
    """The URDF of a robot in TIPS; skips the test if the package that holds it is not installed."""
    if name in ("awkward", "two_arms"):
        file = folder / f"{name}.urdf"
        file.write_text(AWKWARD if name == "awkward" else TWO_ARMS)
        return file
    if name == "iiwa":
        return Path(pytest.importorskip("pybullet_data").getDataPath()) / "kuka_iiwa" / "model.urdf"
    pytest.importorskip("pinocchio")
    data = distribution("example-robot-data").locate_file("cmeel.prefix/share/example-robot-data/robots")
    return Path(str(data)) / DESCRIPTIONS[name]


@cache
def example_robot(name: str) -> Robot:
    with TemporaryDirectory() as folder:
        group, tip = ("both", None) if name == "two_arms" else (None, TIPS[name])
        return read_urdf(urdf_file(name, Path(folder)), base="base" if name == "awkward" else None, tip=tip, group=group)


def planar_arm(*lengths: float) -> Robot:
    """Links of these lengths along x, joints about z."""
    xs = (0.0, *lengths)
    joints = [
        Joint(f"j{i}", "revolute", f"l{i}", f"l{i + 1}", transform(np.array([x, 0, 0])), np.array([0, 0, 1.0]))
        for i, x in enumerate(xs[:-1])
    ]
    tip = Joint("tip", "fixed", f"l{len(lengths)}", "tip", transform(np.array([xs[-1], 0, 0])), np.array([0, 0, 1.0]))
    return Robot("planar", "l0", "tip", (*joints, tip))
