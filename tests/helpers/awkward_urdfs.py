"""Generated awkward URDFs: some work, the others are refused by a one-line error that says what to do."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import trimesh

from helpers.made_arms import BALL, chain, joint, link, robot, row, written

ARM = chain("base", row("j", 4))


def ending(file: str, more: str = "") -> str:
    """A last link of ARM, which is a mesh."""
    shape = f'<collision><geometry><mesh filename="{file}" {more}/></geometry></collision>'
    return link("end", shape) + joint("last", "j4_link", "end")


def solid(mesh: trimesh.Trimesh | bytes, file: str = "part.stl", more: str = "") -> Callable[[Path], Path]:
    """An arm whose last link is a mesh."""

    def make(folder: Path) -> Path:
        if isinstance(mesh, bytes):
            (folder / file).write_bytes(mesh)
        else:
            mesh.export(folder / file)
        return written(folder, ARM, ending(file, more))

    return make


def arm(*parts: str, **how: str) -> Callable[[Path], Path]:
    return lambda folder: written(folder, *parts, **how)


def text(content: str | bytes, file: str = "made.urdf") -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        (folder / file).write_bytes(content if isinstance(content, bytes) else content.encode())
        return folder / file

    return make


def box() -> trimesh.Trimesh:
    return trimesh.creation.box([0.06, 0.06, 0.06])


def degenerate() -> trimesh.Trimesh:
    """A mesh with triangles of no area, repeated corners, and points that belong to no triangle."""
    mesh = box()
    faces = np.concatenate([mesh.faces, [[0, 0, 1], [2, 2, 2], [0, 1, 0]]])
    return trimesh.Trimesh(np.concatenate([mesh.vertices, mesh.vertices[:2], [[0.0, 0.0, 0.0]]]), faces, process=False)


def fine() -> trimesh.Trimesh:
    """A cube of 200,000 triangles."""
    mesh = box()
    while len(mesh.faces) < 190_000:
        mesh = mesh.subdivide()
    return mesh


VISUAL = '<visual><geometry><box size="0.05 0.05 0.05"/></geometry></visual>'
CAPSULE = '<collision><geometry><capsule radius="0.03" length="0.05"/></geometry></collision>'
XACRO = '<robot name="made" xmlns:xacro="http://www.ros.org/wiki/xacro">{}</robot>'
WORKS: dict[str, tuple[Callable[[Path], Path], int]] = {
    "three joints": (arm(chain("base", row("j", 3))), 3),
    "a gantry": (
        arm(
            chain("base", ["x"], kind="prismatic", axis="1 0 0", limits='lower="-0.5" upper="0.5"'),
            chain("x_link", ["y"], kind="prismatic", axis="0 1 0", limits='lower="-0.5" upper="0.5"'),
            chain("y_link", ["z"], kind="prismatic", axis="0 0 1", limits='lower="0" upper="0.5"'),
        ),
        3,
    ),
    "continuous joints alone": (arm(chain("base", row("j", 5), kind="continuous", limits="")), 5),
    "names in other scripts": (arm(chain("base", ["Gelenk_ß", "关节二", "сустав", "مفصل"]), name="机器人 Ä"), 4),
    "names with slashes and spaces": (arm(chain("base", ["arm/joint 1", "arm/joint 2", "arm/joint 3"])), 3),
    "a joint that cannot move": (arm(chain("base", row("j", 4)).replace('upper="2"', 'upper="-2"', 1)), 3),
    "no upper limits": (arm(chain("base", row("j", 3), limits='lower="-2"')), 3),
    "no velocity limits": (text(robot(ARM).replace('velocity="2"', "")), 4),
    "axes that meet": (arm(ARM, chain("j4_link", row("w", 3), xyz="0 0 0")), 7),
    "capsules": (arm(ARM, link("end", CAPSULE), joint("last", "j4_link", "end")), 5),
    "tiny links": (text(robot(ARM).replace('radius="0.04"', 'radius="0.001"')), 4),
    "visual geometry alone": (text(robot(ARM).replace(BALL, VISUAL)), 4),
    "links without geometry": (text(robot(ARM).replace(link("j3_link"), link("j3_link", ""))), 4),
    "a mesh of 200,000 triangles": (solid(fine()), 5),
    "a mesh with degenerate triangles": (solid(degenerate(), "part.obj"), 5),
    "a mirrored mesh": (solid(box(), more='scale="1 -1 1"'), 5),
    "a mesh with an ending in capitals": (solid(box(), "PART.STL"), 5),
    "another encoding": (text(b'<?xml version="1.0" encoding="latin-1"?>' + robot(ARM, name="Ärmchen").encode("latin-1")), 4),
    "a byte order mark and comments": (text(b"\xef\xbb\xbf" + f"<!-- made -->{robot(ARM)}".encode()), 4),
    "an old base frame above": (text(robot(ARM, link("world", ""), joint("stand", "world", "base", "fixed", xyz="1 2 3"))), 4),
    "xacro": (text(XACRO.format(robot(ARM).split(">", 1)[1][: -len("</robot>")]), "made.urdf.xacro"), 4),
}
"""What is made, and how many joints are planned."""
FLOATING = link("body") + joint("free", "base", "body", "floating")
NO_NUMBERS = b"v nan 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 2 3 4\n"
REFUSED: dict[str, tuple[Callable[[Path], Path], str]] = {
    "a missing mesh": (arm(ARM, ending("a.stl")), "mesh file 'a.stl' does not exist; add it"),
    "no geometry": (text(robot(ARM).replace(BALL, "")), "add <collision> elements"),
    "a floating base": (arm(FLOATING, chain("body", row("j", 6))), "has type 'floating'; .*--base body to plan"),
    "a closed chain": (arm(ARM, joint("close", "base", "j4_link")), "two parent joints .*remove one"),
    "a link that is not there": (arm(ARM, joint("last", "j4_link", "hand")), "'hand'"),
    "no limits": (arm(chain("base", ["j"], limits="")), "j: no <limit lower= upper=>; add it"),
    "an endless motion": (text(robot(ARM).replace('velocity="2"', 'velocity="1e-300"')), "at least 1e-06"),
    "a vector of two numbers": (text(robot(ARM).replace('"0 0 0.1"', '"0 0"')), "origin xyz is '0 0'"),
    "no joint": (text("<robot name='bare'><link name='base'/></robot>"), "no movable joint .*choose another --base or --tip"),
    "loose links": (arm(ARM, link("loose")), r"2 \(base, loose\); connect them with fixed joints"),
    "an empty file": (text(""), "not well-formed XML"),
    "an MJCF file without a robot": (text("<mujoco/>"), "has no robot: no body is moved"),
    "a file of another format": (text("<model/>"), "root element is <model>.*convert"),
    "macros alone": (text("<robot/>"), "has no links; if it only defines macros, add a xacro file that uses them"),
    "a missing mesh of a long name": (arm(ARM, ending(f"{'long_' * 30}name.stl")), "long_name.stl' does not exist; add it"),
    "a folder": (lambda folder: folder, "cannot be read: it is a folder"),
    "an axis of zero length": (arm(chain("base", row("j", 3), axis="0 0 0")), "its axis is zero"),
    "limits that are no numbers": (arm(chain("base", ["j"], limits='lower="nan" upper="1"')), "is 'nan'"),
    "a triangle": (solid(trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])), "has no triangle mesh"),
    "corners that are no numbers": (solid(NO_NUMBERS, "part.obj"), "has no triangle mesh"),
    "a damaged mesh": (solid(b"this is no mesh", "part.dae"), "not well-formed"),
    "two links of one name": (arm(ARM, link("j4_link")), "two links have the name 'j4_link'"),
    "two joints of one name": (arm(ARM, link("end"), joint("j4", "j4_link", "end")), "two joints have the name 'j4'"),
    "two rotations": (text(robot(ARM).replace('xyz="0 0 0.1"', 'rpy="0 0 0" quat_xyzw="0 0 0 1"')), "must have one of them"),
    "a finger with exchanged limits": (
        arm(ARM, chain("j4_link", ["finger"], limits='lower="0" upper="-0.03"')),
        "lower limit 0.0 is above upper -0.03; exchange them",
    ),
    "joints without a range": (arm(chain("base", ["j"], limits='lower="0" upper="0"')), "limits of j leave no"),
    "a floating body": (arm(ARM, FLOATING), "remove it with what it carries"),
    "a hand in mm": (solid(trimesh.creation.box([50, 100, 300])), 'link end is 300 m long; .* scale="0.001 0.001 0.001"'),
    "a name that is a path": (arm(ARM, name="../made"), "give --name NAME"),
}
"""What is made, and what the line says."""
