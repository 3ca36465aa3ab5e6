"""Reads a URDF for a test, without the preparation of `robot add`."""

from pathlib import Path

from robotdiffuse.robots.parsing.srdf import Srdf
from robotdiffuse.robots.parsing.urdf import UrdfTree
from robotdiffuse.robots.robot import Robot


def read_urdf(
    path: str | Path,
    base: str | None = None,
    tip: str | None = None,
    locked: dict[str, float] | None = None,
    group: str | None = None,
    srdf: Srdf | None = None,
    packages: dict[str, str | Path] | None = None,
) -> Robot:
    return UrdfTree(Path(path), packages or {}, compile_xacro=True).robot(base, tip, locked, group, srdf)
