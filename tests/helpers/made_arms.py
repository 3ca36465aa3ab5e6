"""Generated URDFs: arms put together from single joints, with balls as links, which spheres fit at once."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from robotdiffuse.robots.parsing.urdf import UrdfTree
from robotdiffuse.robots.robot import Robot

BALL = '<collision><geometry><sphere radius="0.04"/></geometry></collision>'


def link(name: str, content: str = BALL) -> str:
    return f'<link name="{name}">{content}</link>'


def joint(
    name: str,
    parent: str,
    child: str,
    kind: str = "revolute",
    xyz: str = "0 0 0.1",
    axis: str = "0 1 0",
    limits: str = 'lower="-2" upper="2"',
    more: str = "",
) -> str:
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{xyz}"/><axis xyz="{axis}"/><limit {limits} velocity="2" effort="1"/>{more}</joint>'
    )


def chain(base: str, names: Iterable[str], **how: str) -> str:
    """Joints in a row, beginning at an existing base; the link of each joint is named after the joint, with `_link`."""
    parts = []
    parent = base
    for i, name in enumerate(names):
        axis = "0 0 1" if i % 2 == 0 else "0 1 0"
        parts += [link(f"{name}_link"), joint(name, parent, f"{name}_link", **({"axis": axis} | how))]
        parent = f"{name}_link"
    return "".join(parts)


def robot(*parts: str, name: str = "made") -> str:
    return f'<robot name="{name}">{link("base")}{"".join(parts)}</robot>'


def row(prefix: str, count: int) -> list[str]:
    return [f"{prefix}{i}" for i in range(1, count + 1)]


def written(folder: Path, *parts: str, file: str = "made.urdf", name: str = "made") -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / file).write_text(robot(*parts, name=name), encoding="utf-8")
    return folder / file


def read_urdf(path: Path, packages: dict[str, str | Path] | None = None, **how: Any) -> Robot:
    return UrdfTree(path, packages or {}, compile_xacro=True).robot(**how)
