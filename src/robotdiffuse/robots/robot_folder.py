"""Reads and writes robot folders: robot.json (human-readable), meshes.npz (convex collision meshes) and,
if links graze each other, surfaces.npz.

surfaces.npz contains the mesh surfaces of grazing links (`Robot.grazing`). The file is optional and not part
of a robot's identity. Surfaces can only make more configurations count as free: those in which convex
parts overlap but surfaces do not. So data, weights and proofs that were made without the file stay valid.
"""

import hashlib
import io
import json
import os
import re
from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from tempfile import TemporaryFile
from typing import TypeVar

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.core.errors import (
    MAX_COORDINATE,
    MAX_RATE,
    MIN_RATE,
    InputError,
    reading,
    shown,
    unit_quaternion,
    within,
)
from robotdiffuse.core.files import (
    JsonObject,
    is_file,
    lock_folder,
    read_arrays,
    read_json,
    write_atomically,
    writing,
)
from robotdiffuse.core.transforms import pose_entry, rotation_from_quaternion, transform
from robotdiffuse.robots.bodies import ConvexMesh, Surface, inertia_of
from robotdiffuse.robots.kinematic_tree import CONTINUOUS_LIMIT, LIMITS, MOVING_KINDS, Joint, Mimic
from robotdiffuse.robots.robot import LinkPairTable, Robot


def user_robots() -> Path:
    """The folder of added robots: $ROBOTDIFFUSE_ROBOTS, or robotdiffuse/robots in the user's data
    directory."""
    chosen = os.environ.get("ROBOTDIFFUSE_ROBOTS")
    if chosen:
        return Path(chosen)
    # without a home, as in a container: a folder in /, not one named ~ in the working folder
    data = os.environ.get("XDG_DATA_HOME") or os.path.expanduser("~/.local/share").lstrip("~")
    return Path(data, "robotdiffuse", "robots")


M = TypeVar("M", bound=Surface)
SURFACE_FILE = "surfaces.npz"
FORMAT = 2
"""Version of the format."""
AXIS_LENGTH_TOLERANCE = 1e-3
"""A joint axis in a file may differ from unit length by at most this."""
ROBOT_FILE = "robot.json"
DATA = Path(__file__).parent / "data"
ROBOTS = tuple(sorted(file.parent.name for file in DATA.glob(f"*/{ROBOT_FILE}")))
"""Names of the bundled robots."""
FILE_ENDINGS = (".urdf", ".xacro", ".xml", ".sdf", ".usd", ".usda", ".usdc", ".usdz")
"""Endings of robot descriptions: URDF, xacro and MuJoCo models; also SDF and USD, which are refused."""
MESH_FILE = "meshes.npz"


def write_robot_folder(robot: Robot, folder: Path, source: JsonObject) -> None:
    """Write meshes.npz, for grazing links surfaces.npz, and robot.json into a folder. Each file is written
    atomically; other files in the folder stay.

    `source` describes the robot's origin by the keys urdf, sha256 and license. Unless another SRDF than the
    one that belongs to the URDF was given, it also has srdf, the digest of that SRDF ("" if there is none).
    If preparation measured them, it also has `free`, the fraction of configurations that are free, and
    `refused`, the fraction of the free configurations in which covering spheres collide falsely. Raises
    InputError if the folder cannot be written.
    """
    arrays = _packed([(link, mesh) for link, meshes in robot.meshes.items() for mesh in meshes])
    files = {MESH_FILE: _npz(arrays)}
    if robot.grazing:
        arrays = _packed([*robot.surfaces.items()])
        arrays |= {
            "vertices": arrays["vertices"].astype(np.float32),  # relative error of at most 6e-8
            "faces": arrays["faces"].astype(np.int32),
            "grazing": np.array(sorted(sorted(pair) for pair in robot.grazing), np.str_),
            "of": np.array(_digest(robot)),
        }
        files[SURFACE_FILE] = _npz(arrays)
    # last: without this file, a folder that was written in part is not read
    files[ROBOT_FILE] = f"{_dump(_to_json(robot, source))}\n".encode()
    with writing(folder), lock_folder(folder):
        with TemporaryFile(dir=folder) as trial:  # on a full disk, existing files stay
            trial.writelines(files.values())
        for file in (ROBOT_FILE, SURFACE_FILE):  # existing files may belong to other meshes
            (folder / file).unlink(missing_ok=True)
        for file, content in files.items():
            write_atomically(folder / file, content)


def _npz(arrays: dict[str, ndarray]) -> bytes:
    content = io.BytesIO()
    np.savez_compressed(content, allow_pickle=False, **arrays)
    return content.getvalue()


def read_robot_folder(folder: Path) -> Robot:
    """Read the robot in a folder; raises InputError that names the file if one is missing or damaged."""
    data = _read_json(folder / ROBOT_FILE)
    meshes = dict[str, tuple[ConvexMesh, ...]]()
    arrays = read_arrays(folder / MESH_FILE)
    with reading(folder / MESH_FILE):
        for link, mesh in _unpacked(arrays, ConvexMesh):
            meshes[link] = (*meshes.get(link, ()), mesh)
    with reading(folder / ROBOT_FILE):
        robot = _from_json(data, meshes)
        _check_tree(robot)
        if robot.dof == 0 or not {*robot.spheres, *robot.inertias} <= {*robot.link_names}:
            raise ValueError("no planned joints, or spheres or inertias of an unknown link")
    file = folder / SURFACE_FILE
    if not is_file(file):
        return robot
    arrays = read_arrays(file)
    with reading(file):
        if str(arrays["of"]) != _digest(robot):
            raise ValueError("it belongs to other convex meshes; create the robot again")
        surfaces = dict(_unpacked(arrays, Surface))
        grazing = frozenset(frozenset(map(str, pair)) for pair in arrays["grazing"])
        if {link for pair in grazing for link in pair} != {*surfaces} or not {*surfaces} <= {*meshes}:
            raise ValueError("grazing pairs and surfaces must name the same links of the robot")
        robot = replace(robot, surfaces=surfaces, grazing=grazing)
    return robot


def _digest(robot: Robot) -> str:
    digest = hashlib.sha256()
    for link in sorted(robot.meshes):
        for mesh in robot.meshes[link]:
            digest.update(link.encode() + np.ascontiguousarray(mesh.vertices, np.float64).tobytes())
    return digest.hexdigest()


def _check_tree(robot: Robot) -> None:
    """Raise ValueError if the joints do not form a tree, or if other entries do not fit the tree."""
    links = {robot.base}
    for joint in robot.joints:
        if joint.parent not in links or joint.child in links:
            raise ValueError(f"joint {joint.name} is not part of a tree with parents before children")
        links.add(joint.child)
    leaders = {joint.name: joint.mimic.joint for joint in robot.joints if joint.mimic is not None}
    for name in leaders:
        visited = set[str]()
        while name in leaders:
            if name in visited:
                raise ValueError(f"joint {name} mimics itself")
            visited.add(name)
            name = leaders[name]
    table_links = {link for table in robot.tables for link in table.links}
    if not {*robot.tips, *robot.meshes, *table_links} <= links:
        raise ValueError("the tip, a mesh or a table names a link that no joint has")
    for link, rows in robot.spheres.items():
        if (rows[:, 3] <= 0).any():
            raise ValueError(f"spheres of {link}: a radius is {rows[:, 3].min():g}; it must be positive")


def read_source(folder: Path) -> JsonObject:
    """The `source` of a robot folder, as given to `write_robot_folder`."""
    source = _read_json(folder / ROBOT_FILE).get("source", {})
    return source if isinstance(source, dict) else {}


def _to_json(robot: Robot, source: JsonObject) -> dict:
    return {
        "format": FORMAT,
        "name": robot.name,
        "source": source,
        "units": "meters, radians, seconds, kilograms; quaternions wxyz; spheres are x y z radius in the "
        "link's frame; inertias are: mass; x y z of the center of mass; xx xy xz yy yz zz about it, along "
        "the link's axes",
        "base": robot.base,
        "tip": robot.tip,
        **({"other_tips": robot.other_tips} if robot.other_tips else {}),
        "root": robot.root or robot.base,
        "above": {link: pose_entry(T_base_link) for link, T_base_link in robot.above.items()},
        "locked": robot.locked,
        "poses": robot.poses,
        "joints": [_joint_to_json(joint) for joint in robot.joints],
        "spheres": {link: np.round(spheres, 6).tolist() for link, spheres in robot.spheres.items()},
        "inertias": {link: inertia.values for link, inertia in robot.inertias.items()},
        "allowed_collisions": sorted(sorted(pair) for pair in robot.allowed_collisions),
        **({"tables": [_table_to_json(table) for table in robot.tables]} if robot.tables else {}),
        "notes": robot.notes,
    }


def _table_to_json(table: LinkPairTable) -> dict:
    """JSON entry of a table. Cells along the last joint are packed as bits; each row is a hexadecimal
    string."""
    rows = np.packbits(np.atleast_2d(table.apart), axis=1)
    return asdict(table) | {"apart": [row.tobytes().hex() for row in rows]}


def _table_from_json(data: dict) -> LinkPairTable:
    joints = tuple(map(str, data["joints"]))
    separated = np.array([np.frombuffer(bytes.fromhex(row), np.uint8) for row in data["apart"]])
    separated = np.unpackbits(separated, axis=1).astype(bool)
    lower, upper = (tuple(map(float, data[end])) for end in ("lower", "upper"))
    dimensions = {len(joints), len(lower), len(upper), 1 if len(separated) == 1 else 2}
    spans = np.subtract(upper, lower)
    if len(dimensions) > 1 or not within(spans) or not (spans > 0).all():
        raise ValueError("a table over one or two joints expected, lower below upper")
    a, b = map(str, data["links"])
    return LinkPairTable((a, b), joints, lower, upper, separated[0] if len(joints) == 1 else separated)


def _joint_to_json(joint: Joint) -> dict:
    data: JsonObject = {name: getattr(joint, name) for name in ("name", "kind", "parent", "child")}
    data |= pose_entry(joint.T_parent_joint)
    if joint.movable:
        data |= {"axis": joint.axis.tolist()} | {name: getattr(joint, name) for name in LIMITS}
    if joint.effort:
        data["effort"] = joint.effort
    if joint.mimic is not None:
        data["mimic"] = joint.mimic
    return data


def _dump(data: dict) -> str:
    """Indented JSON text in which innermost lists, such as spheres and pairs of links, are on one line."""
    text = json.dumps(data, indent=1, allow_nan=False)
    return re.sub(r"\[[^\[\]{}]+\]", lambda innermost: " ".join(innermost[0].split()), text)


def _read_json(file: Path) -> dict:
    data = read_json(file)
    if not isinstance(data, dict) or data.get("format") != FORMAT:
        raise InputError(
            f"{file} is not a robot of format {FORMAT}; create it again with: robotdiffuse robot add"
        )
    return data


def _from_json(data: dict, meshes: dict[str, tuple[ConvexMesh, ...]]) -> Robot:
    return Robot(
        name=str(data["name"]),
        base=str(data["base"]),
        tip=str(data["tip"]),
        root=str(data["root"]),
        other_tips=tuple(map(str, data.get("other_tips", ()))),
        joints=tuple(_joint_from_json(joint) for joint in data["joints"]),
        spheres={str(link): _array(rows, 4, f"spheres of {link}") for link, rows in data["spheres"].items()},
        meshes=meshes,
        allowed_collisions=frozenset(frozenset(map(str, pair)) for pair in data["allowed_collisions"]),
        tables=tuple(_table_from_json(table) for table in data.get("tables", ())),
        locked={str(name): float(value) for name, value in data["locked"].items()},
        notes=tuple(map(str, data["notes"])),
        above={str(link): _pose_from_json(pose, f"above: {link}") for link, pose in data["above"].items()},
        poses={
            str(name): {str(joint): float(value) for joint, value in pose.items()}
            for name, pose in data.get("poses", {}).items()
        },
        inertias={str(link): inertia_of(row) for link, row in data.get("inertias", {}).items()},
    )


def _joint_from_json(data: dict) -> Joint:
    name = str(data["name"])
    kind = str(data["kind"])
    ends = (name, kind, str(data["parent"]), str(data["child"]), _pose_from_json(data, f"joint {name}"))
    if kind == "fixed":
        return Joint(*ends)
    if kind not in MOVING_KINDS:
        raise ValueError(f"joint {name} is of kind {shown(kind)}")
    axis = _array([data["axis"]], 3, f"joint {name}: axis")[0]
    limits = {limit: float(data[limit]) for limit in LIMITS}
    lower, upper, *rates = limits.values()
    if not (
        -MAX_COORDINATE <= lower <= upper <= MAX_COORDINATE and MIN_RATE <= min(rates) <= max(rates) < np.inf
    ):
        raise ValueError(
            f"joint {name} has {limits}; they must be finite, in order and at least {MIN_RATE:g} for rates"
        )
    if not abs(np.linalg.norm(axis) - 1) < AXIS_LENGTH_TOLERANCE:
        raise ValueError(f"joint {name}: an axis of length 1 expected")
    if kind == "continuous":
        limits |= {"lower": -CONTINUOUS_LIMIT, "upper": CONTINUOUS_LIMIT}
    mimic = None
    if "mimic" in data:
        master, multiplier, offset = data["mimic"]
        mimic = Mimic(str(master), float(multiplier), float(offset))
    effort = float(data.get("effort", 0.0))
    if not 0 <= effort <= MAX_RATE:
        raise ValueError(f"joint {name}: effort is {effort:g}; it must be from 0 to {MAX_RATE:g}")
    return Joint(*ends, axis, **limits, mimic=mimic, effort=effort)


def _pose_from_json(data: dict, what: str) -> Float[ndarray, "4 4"]:
    xyz = _array([data["xyz"]], 3, f"{what}: xyz")[0]
    return transform(xyz, rotation_from_quaternion(unit_quaternion(what, data["wxyz"])))


def _array(rows: object, width: int, what: str) -> Float[ndarray, "n w"]:
    array = np.asarray(rows, np.float64)
    if array.ndim != 2 or array.shape[1] != width or not within(array):
        raise ValueError(f"{what}: {width} finite numbers within ±{MAX_COORDINATE:g} in each row expected")
    return array


def _packed(meshes: Sequence[tuple[str, Surface]]) -> dict[str, ndarray]:
    """Meshes of links, joined in four arrays, which are read faster than many small ones."""
    return {
        "links": np.array([link for link, _ in meshes], np.str_),
        "sizes": np.array([(len(mesh.vertices), len(mesh.faces)) for _, mesh in meshes], np.int64).reshape(
            -1, 2
        ),
        "vertices": np.concatenate([np.zeros((0, 3)), *(mesh.vertices for _, mesh in meshes)]),
        "faces": np.concatenate([np.zeros((0, 3), np.int64), *(mesh.faces for _, mesh in meshes)]),
    }


def _unpacked(arrays: dict[str, ndarray], kind: type[M]) -> Iterator[tuple[str, M]]:
    """Links and meshes from the arrays that `_packed` made."""
    links, sizes, vertices, faces = (arrays[key] for key in ("links", "sizes", "vertices", "faces"))
    end_indices = np.cumsum(sizes, axis=0)
    if len(links) and (end_indices[-1] != (len(vertices), len(faces))).any():
        raise ValueError("sizes do not add up")
    for link, (v, f), (v_end, f_end) in zip(links, sizes, end_indices, strict=True):
        corners = _array(vertices[v_end - v : v_end], 3, f"vertices of {link}")
        indices = np.asarray(faces[f_end - f : f_end], np.int64)
        if indices.shape[1:] != (3,) or not ((indices >= 0) & (indices < len(corners))).all():
            raise ValueError(f"faces of {link}: indices of its {len(corners)} vertices expected")
        yield str(link), kind(corners, indices)
