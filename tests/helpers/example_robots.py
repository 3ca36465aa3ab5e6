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
DESCRIPTIONS = {"panda": "panda_description/urdf/panda.urdf", "xarm7": "xarm_description/urdf/xarm7.urdf"}
DESCRIPTIONS |= {"ur5": "ur_description/urdf/ur5_joint_limited_robot.urdf"}
FILES = Path(__file__).parents[1] / "files"
AWKWARD = (FILES / "awkward.urdf").read_text()
"""Skew axes, a prismatic and two continuous joints, a fixed joint within the chain and a branch beside it."""
TWO_ARMS = (FILES / "two_arms.urdf").read_text()
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
    z = np.array([0, 0, 1.0])
    at = [transform(np.array([x, 0, 0])) for x in xs]
    joints = [Joint(f"j{i}", "revolute", f"l{i}", f"l{i + 1}", T, z) for i, T in enumerate(at[:-1])]
    tip = Joint("tip", "fixed", f"l{len(lengths)}", "tip", at[-1], z)
    return Robot("planar", "l0", "tip", (*joints, tip))
