"""Fuzzing: files that were damaged at random give an answer or a one-line error, in bounded time.

    python benchmarks/fuzz.py [--seconds 600] [--seed 0] [--only problem,urdf]

Prints the report that is kept in benchmarks/results/fuzz.txt. An input is a kind and a seed; `one(kind, seed,
folder)` does it again. Texts are changed value by value, line by line or byte by byte, all others by bytes.
Inputs run in a process of their own, which is started anew when one does not end or kills it.
Run it a minute before where no compiled code is kept yet: compiling counts as slow, and as memory that grows.
"""

import argparse
import copy
import json
import multiprocessing
import os
import resource
import shutil
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable
from functools import cache
from multiprocessing.connection import Connection
from pathlib import Path as FilePath
from typing import Any

import numpy as np

LIMIT = 5.0
"""Longest processor time of an input [s]; of a request to a server see fuzz_socket.py."""
PATIENCE = 60.0
"""Until an input that does not end is given up [s]."""
MEMORY = 12 * 2**30
"""Of the process that runs inputs [bytes]."""
LONGEST = 1000
"""Characters of a message: names of files and lists of what is known."""
NASTY: tuple[Any, ...] = (
    *(
        None,
        True,
        False,
        0,
        -1,
        1,
        2**31,
        2**63,
        10**25,
        -0.0,
        0.5,
        1e-300,
        1e-9,
        1e4,
        1e5,
        1e20,
        1e39,
        1e308,
    ),
    *(
        float("inf"),
        float("nan"),
        "",
        "x",
        "x" * 5000,
        "\0",
        "\ud800",
        "../..",
        "/dev/zero",
        "panda",
        "a/b.urdf",
    ),
    *([], {}, [[]], [[1, 2, 3]], [[1, 2], [3]], {"x": 1}, [None] * 7, [0.0] * 7, [1e200] * 4, [0, 0, 0, 0]),
    *({"file": "x" * 300}, {"file": "\0.stl"}, {"sphere": None}, [{"a": []}], "2001-13-45", "1_000", "0x"),
)
"""What a value is replaced by."""
TOKENS = (
    *(
        b"[",
        b"{",
        b"]" * 3,
        b"}",
        b"[" * 3000,
        b"{a: " * 200,
        b"- " * 300,
        b"&a ",
        b"*a",
        b"!!int foo",
        b"!x ",
    ),
    *(b"9" * 5000, b"1e400", b"nan", b"-inf", b"\0", b"\xff\xfe", b"'", b'"', b":", b"\n", b"\t", b"%", b"#"),
    *(
        b"2001-13-45",
        b"<<: ",
        b"|",
        b"<a>" * 100,
        b"&lt;",
        b"<!DOCTYPE a>",
        b'encoding="utf-7"',
        b"1e308",
        b"0",
    ),
)
"""What bytes are replaced by."""

Make = Callable[[np.random.Generator, FilePath], Callable[[], object]]


def outcome(call: Callable[[], object]) -> tuple[str, str]:
    """answer, error or fault; and what was said."""
    from robotdiffuse.core.errors import InputError

    try:
        call()
    except InputError as error:
        text = str(error)
        good = text and "\n" not in text and len(text) <= LONGEST
        return ("error" if good else "fault"), text[: 2 * LONGEST]
    except BaseException as error:
        place = traceback.extract_tb(error.__traceback__)[-1]
        return "fault", f"{type(error).__name__}: {str(error)[:200]} ({place.filename}:{place.lineno})"
    return "answer", ""


def one(kind: str, seed: int, folder: FilePath) -> tuple[str, str]:
    """The outcome of an input; its files are written to the folder."""
    rng = np.random.default_rng([seed, *kind.encode()])
    return outcome(KINDS[kind](rng, folder))


def mutated(rng: np.random.Generator, value: Any) -> Any:
    """Plain data with one to three of its values, keys or rows changed."""
    value = json.loads(json.dumps(value))
    for _ in range(rng.integers(1, 4)):
        places = list(_places(value))
        if not places:
            return _nasty(rng)
        owner, key = places[rng.integers(len(places))]
        action = rng.integers(9)
        if action < 3:
            owner[key] = _nasty(rng)
        elif action == 3:
            del owner[key]
        elif action == 4 and isinstance(owner, dict):
            owner[str(_nasty(rng))[:100]] = owner.pop(key)
        elif isinstance(owner, list):
            owner.insert(key, owner[key])
        elif isinstance(owner[key], int | float):
            by = rng.normal(scale=0.1) if rng.random() < 0.7 else rng.uniform(-30, 30)
            owner[key] *= float(10.0**by)
    return value


def _places(value: Any) -> Any:
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, inner in list(items):
        yield value, key
        yield from _places(inner)


def _nasty(rng: np.random.Generator) -> Any:
    return copy.deepcopy(NASTY[rng.integers(len(NASTY))])


def damaged(rng: np.random.Generator, content: bytes) -> bytes:
    """Bytes with one to four changes: flipped, cut, doubled, or replaced by a token."""
    for _ in range(rng.integers(1, 5)):
        at, action = int(rng.integers(len(content) + 1)), rng.integers(5)
        size = int(rng.integers(1, 30))
        token = TOKENS[rng.integers(len(TOKENS))]
        if action == 0:
            content = content[:at] + bytes(rng.integers(0, 256, size, np.uint8)) + content[at + size :]
        elif action == 1:
            content = content[:at] + token + content[at + size :]
        elif action == 2:
            content = content[:at] + token + content[at:]
        elif action == 3:
            content = content[:at] + content[at + int(rng.integers(1, 200)) :]
        else:
            content = content[:at] if rng.random() < 0.3 else content[:at] + content[at // 2 :]
    return content


def text_of(rng: np.random.Generator, data: Any, ending: str) -> bytes:
    """Plain data as JSON or YAML, its values changed, or its bytes."""
    import yaml

    by_value = rng.random() < 0.6
    data = mutated(rng, data) if by_value else data
    if ending in (".yaml", ".yml"):
        text = yaml.dump(data, Dumper=yaml.SafeDumper, default_flow_style=None, allow_unicode=False)
    else:
        text = json.dumps(data)
    content = text.encode("utf-8", "surrogatepass")
    return content if by_value else damaged(rng, content)


PROBLEM: dict[str, Any] = {
    "robot": "panda",
    "locked": {"panda_finger_joint1": 0.04, "panda_finger_joint2": 0.04},
    "scene": [
        {"sphere": {"center": [0.5, 0.3, 0.6], "radius": 0.25, "name": "ball"}},
        {"box": {"center": [0.0, 0.6, 0.4], "size": [0.2, 0.2, 0.2], "wxyz": [1, 0, 0, 0]}},
        {"cylinder": {"center": [0.4, -0.6, 0.2], "radius": 0.05, "height": 0.4, "wxyz": [1, 0, 0, 0]}},
        {"capsule": {"center": [0.4, -0.6, 0.9], "radius": 0.05, "height": 0.4}},
        {"mesh": {"vertices": [[1, 1, 0], [1, 2, 0], [2, 1, 0]], "faces": [[0, 1, 2]], "xyz": [0, 0, 1]}},
        {"point_cloud": {"points": [[1, 1, 1], [1, 1, 1.1]], "point_radius": 0.01}},
    ],
    "start": [0, -0.785, 0, -2.356, 0, 1.571, 0.785],
    "goal": {"joints": [0.4, -0.785, 0, -2.356, 0, 1.571, 0.785]},
    "clearance": 0.01,
}
POSE = {"frame": "panda_hand", "xyz": [0.5, 0, 0.5], "wxyz": [0, 1, 0, 0]}
VIEW = {"cloud": [[1, 0, 1], [1, 0.1, 1]], "camera": {"xyz": [0, 0, 1], "wxyz": [0.5, 0.5, 0.5, 0.5]}}
EQUIPPED: dict[str, Any] = {
    "base": {"xyz": [0.0, 0.0, 0.7], "wxyz": [1, 0, 0, 0]},
    "tool": {
        "link": "panda_hand",
        "name": "sucker",
        "xyz": [0, 0, 0.14],
        "shapes": [{"cylinder": {"center": [0, 0, 0.09], "radius": 0.012, "height": 0.1}}],
    },
    "attached": [
        {"link": "sucker", "box": {"center": [0, 0, 0.06], "size": [0.1, 0.1, 0.1], "name": "parcel"}}
    ],
    "goal": {"pose": {"frame": "parcel", "xyz": [0.45, 0.3, 1.0], "wxyz": [0, 1, 0, 0]}},
    "waypoints": [{"joints": [0.2, -0.785, 0, -2.356, 0, 1.571, 0.785]}],
}
CONSTRAINED: dict[str, Any] = {
    "constraints": [
        {"axis_cone": {"frame": "panda_hand", "axis": [0, 0, 1], "direction": [0, 0, -1], "angle": 0.17}},
        {"position_box": {"frame": "panda_hand", "low": [0, -1, 0], "high": [1, 1, 1], "xyz": [0, 0, 0.1]}},
        {"on_plane": {"frame": "panda_hand", "point": [0, 0, 0.4], "normal": [0, 0, 1], "tolerance": 0.1}},
        {"on_line": {"frame": "panda_hand", "point": [0.5, 0, 0.4], "direction": [0, 1, 0], "tolerance": 1}},
        {"cartesian_line": {"frame": "panda_hand", "tolerance": 0.1, "angle": 0.5, "speed": 0.1}},
    ],
    "goal": {"pose": POSE | {"xyz_tolerance": [0.1, 0.1, 0], "rpy_tolerance": [0, 0, 3.1]}},
}
MOVING: dict[str, Any] = {
    "moving": [
        {"sphere": {"center": [0.5, -0.6, 0.5], "radius": 0.1}, "velocity": [0, 0.3, 0]},
        {
            "box": {"center": [0.6, 0, 0.3], "size": [0.2, 0.2, 0.2]},
            "times": [0, 2],
            "poses": [{"xyz": [0.6, 0, 0.3]}, {"xyz": [0.6, 1, 0.3], "wxyz": [1, 0, 0, 0]}],
        },
        {"sphere": {"center": [0.5, 0.6, 0.5], "radius": 0.1, "name": "hand"}, "max_speed": 0.5},
    ],
}
IN_MOTION: dict[str, Any] = {"start_velocity": [0.1, 0, 0, 0, 0, 0, 0]}
MOVEIT = {
    "name": "",
    "robot_model_name": "panda",
    "fixed_frame_transforms": [
        {
            "header": {"frame_id": "world"},
            "child_frame_id": "table",
            "transform": {"translation": [0, 0, 0], "rotation": [0, 0, 0, 1]},
        }
    ],
    "world": {
        "collision_objects": [
            {
                "header": {"frame_id": "world"},
                "id": "Can",
                "primitives": [
                    {"type": "cylinder", "dimensions": [0.2, 0.03]},
                    {"type": 1, "dimensions": [1, 1, 1]},
                ],
                "primitive_poses": [{"position": [1, 1, 1], "orientation": [0, 0, 0, 1]}] * 2,
                "meshes": [{"vertices": [[1, 1, 0], [1, 2, 0], [2, 1, 0]], "triangles": [[0, 1, 2]]}],
                "mesh_poses": [{"position": {"x": 0, "y": 0, "z": 0}, "orientation": [0, 0, 0, 1]}],
            }
        ]
    },
}
JOINTS = [f"panda_joint{i}" for i in range(1, 8)]
HELD = {
    "link_name": "panda_hand",
    "touch_links": ["panda_leftfinger"],
    "object": {
        "header": {"frame_id": "panda_hand"},
        "id": "cup",
        "primitives": [{"type": 3, "dimensions": [0.2, 0.03]}],
        "primitive_poses": [{"position": [0, 0, 0.15], "orientation": [0, 0, 0, 1]}],
    },
}
REQUEST: dict[str, Any] = {
    "start_state": {"joint_state": {"name": JOINTS, "position": PROBLEM["start"]}},
    "goal_constraints": [
        {
            "joint_constraints": [
                {"joint_name": n, "position": p} for n, p in zip(JOINTS, PROBLEM["start"], strict=True)
            ]
        }
    ],
}
URDF = b"""<?xml version="1.0"?>
<robot name="two">
<link name="base"><collision><origin xyz="0 0 0" rpy="0 0 0"/>
<geometry><box size="0.1 0.1 0.1"/></geometry></collision></link>
<link name="upper"><collision><geometry><cylinder radius="0.03" length="0.3"/></geometry></collision></link>
<link name="lower"><collision><geometry><mesh filename="part.stl" scale="1 1 1"/></geometry>
</collision></link>
<link name="finger"><visual><geometry><sphere radius="0.01"/></geometry></visual></link>
<joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/>
<origin xyz="0 0 0.1" rpy="0 0 0"/><axis xyz="0 0 1"/><limit lower="-2" upper="2" velocity="1"/></joint>
<joint name="elbow" type="continuous"><parent link="upper"/><child link="lower"/>
<axis xyz="0 1 0"/><limit velocity="1"/></joint>
<joint name="grip" type="prismatic"><parent link="lower"/><child link="finger"/>
<limit lower="0" upper="0.1" velocity="1"/><mimic joint="elbow" multiplier="0.5" offset="0"/></joint>
</robot>"""
SRDF = b"""<robot name="two">
<group name="arm"><chain base_link="base" tip_link="lower"/><group name="other"/></group>
<group name="other"><joint name="grip"/></group>
<group_state name="home" group="arm"><joint name="elbow" value="0.3"/></group_state>
<passive_joint name="grip"/><disable_collisions link1="base" link2="upper" reason="Adjacent"/>
</robot>"""
LIMITS = {
    "joint_limits": {"shoulder": {"max_velocity": 2.0, "max_acceleration": 3.0, "has_jerk_limits": False}}
}
MESHES = ("stl", "obj", "ply", "off", "glb", "dae")
CLOUDS = ("ply", "pcd", "xyz", "csv", "npy", "npz")


def _problem(rng: np.random.Generator, folder: FilePath) -> Callable[[], object]:
    data = dict(PROBLEM)
    if rng.random() < 0.2:
        data["goal"] = {"pose": POSE}
    if rng.random() < 0.1:
        data["views"], data["unknown"] = [VIEW], "optimistic"
    else:
        data |= (*({},) * 3, EQUIPPED, CONSTRAINED, MOVING, IN_MOTION)[rng.integers(7)]
    ending = (".yaml", ".json", ".jsonl")[rng.integers(3)]
    file = folder / f"problem{ending}"
    file.write_bytes(text_of(rng, data, ending))
    return lambda: _validated(file)


def _validated(file: FilePath) -> None:
    """A problem that is read is validated: its straight line, if it has a goal configuration."""
    from robotdiffuse.core.types import Path
    from robotdiffuse.problems.files import load_problem, problem_from_record, problem_record
    from robotdiffuse.problems.problem import JointGoal
    from robotdiffuse.validation.validator import Verifier

    problem = load_problem(file)
    problem_from_record(problem_record(problem))
    if isinstance(problem.goal, JointGoal):
        rows = np.stack([problem.start, problem.goal.positions[0]])
        Verifier(problem).path(Path(problem.robot.joint_names, rows))


def _moveit(rng: np.random.Generator, folder: FilePath) -> Callable[[], object]:
    from robotdiffuse.problems.files import load_motion_bench_maker

    asked = copy.deepcopy(REQUEST)
    if rng.random() < 0.3:
        asked["start_state"]["attached_collision_objects"] = [HELD]
    scene, request = (yaml_text(rng, data, i) for i, data in enumerate((MOVEIT, asked)))
    (folder / "scene0001.yaml").write_bytes(scene)
    (folder / "request0001.yaml").write_bytes(request)

    def read() -> None:
        [entry] = load_motion_bench_maker(folder)
        entry.load()

    return read


def yaml_text(rng: np.random.Generator, data: Any, other: int) -> bytes:
    return text_of(rng, data, ".yaml") if rng.random() < 0.6 + 0.1 * other else json.dumps(data).encode()


def _cloud(rng: np.random.Generator, folder: FilePath) -> Callable[[], object]:
    import io

    from robotdiffuse.scenes.point_cloud import read_points
    from robotdiffuse.scenes.shapes import PointCloud

    ending = CLOUDS[rng.integers(len(CLOUDS))]
    points = rng.normal(size=(5, 3)).astype(np.float32)
    if rng.random() < 0.2:
        points[0, 0] = (np.inf, 1e38, 0)[rng.integers(3)]
    stream = io.BytesIO()
    if ending in ("xyz", "csv"):
        np.savetxt(stream, points, delimiter="," if ending == "csv" else " ")
    elif ending == "npy":
        np.save(stream, points)
    elif ending == "npz":
        np.savez_compressed(stream, points=points)
    elif ending == "pcd":
        head = b"VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nPOINTS 5\nDATA "
        binary = rng.random() < 0.5
        stream.write(head + (b"binary\n" + points.tobytes() if binary else b"ascii\n"))
        if not binary:
            np.savetxt(stream, points)
    else:
        import trimesh

        stream.write(trimesh.PointCloud(points).export(file_type="ply"))  # type: ignore[arg-type]
    file = folder / f"cloud.{ending}"
    file.write_bytes(damaged(rng, stream.getvalue()))
    return lambda: PointCloud(read_points(file)[0])


def mesh_file(rng: np.random.Generator, folder: FilePath, name: str, ending: str) -> FilePath:
    """A small mesh with its bytes damaged."""
    import trimesh

    content = trimesh.creation.box((0.1, 0.2, 0.3)).export(file_type=ending)
    content = content.encode() if isinstance(content, str) else bytes(content)
    file = folder / f"{name}.{ending}"
    file.write_bytes(damaged(rng, content))
    return file


def _mesh(rng: np.random.Generator, folder: FilePath) -> Callable[[], object]:
    file = mesh_file(rng, folder, "part", MESHES[rng.integers(len(MESHES))])
    problem = PROBLEM | {"scene": [{"mesh": {"file": file.name, "xyz": [2, 2, 2]}}]}
    (folder / "problem.json").write_text(json.dumps(problem))
    return lambda: _validated(folder / "problem.json")


def _urdf(rng: np.random.Generator, folder: FilePath) -> Callable[[], object]:
    import trimesh

    from robotdiffuse.robots.parsing.joint_limits import read_limits, with_limits
    from robotdiffuse.robots.parsing.srdf import read_srdf
    from robotdiffuse.robots.parsing.urdf import UrdfTree

    part = bytes(trimesh.creation.box((0.1, 0.05, 0.3)).export(file_type="stl"))  # type: ignore[arg-type]
    (folder / "part.stl").write_bytes(damaged(rng, part) if rng.random() < 0.2 else part)
    files = {name: folder / name for name in ("two.urdf", "two.srdf", "limits.yaml")}
    which = rng.integers(4)
    files["two.urdf"].write_bytes(numbers_changed(rng, URDF) if which < 2 else URDF)
    files["two.srdf"].write_bytes(numbers_changed(rng, SRDF) if which == 2 else SRDF)
    files["limits.yaml"].write_bytes(
        text_of(rng, LIMITS, ".yaml") if which == 3 else json.dumps(LIMITS).encode()
    )

    def read() -> None:
        srdf = read_srdf(files["two.srdf"])
        tree = UrdfTree(files["two.urdf"], {})
        robot = tree.robot(None, "lower", None, None, srdf)
        assert tree.digest
        with_limits(robot, read_limits(files["limits.yaml"]))

    return read


def numbers_changed(rng: np.random.Generator, content: bytes) -> bytes:
    """XML with bytes damaged or with attributes replaced."""
    import re

    if rng.random() < 0.4:
        return damaged(rng, content)
    values = list(re.finditer(rb'"[^"]*"', content))
    for match in [values[i] for i in rng.integers(len(values), size=rng.integers(1, 3))]:
        new = str(_nasty(rng)).encode("utf-8", "surrogatepass")
        content = content.replace(match.group(), b'"' + new.replace(b'"', b"'").replace(b"<", b"") + b'"', 1)
    return content


def _result(rng: np.random.Generator, folder: FilePath) -> Callable[[], object]:
    from robotdiffuse.core.results import load_result
    from robotdiffuse.problems.files import problem_from_record
    from robotdiffuse.validation.validator import Verifier

    rows = np.linspace(PROBLEM["start"], PROBLEM["goal"]["joints"], 3).tolist()
    record = {
        "status": "solved",
        "reason": "solved by hand",
        "planner": "hand",
        "robot": "panda",
        "joint_names": JOINTS,
        "planning_time": 0.1,
        "verified": True,
        "seed": 0,
        "waypoints": rows,
        "times": [0.0, 1.0, 2.0],
        "positions": rows,
        "velocities": [[0.0] * 7, [0.3] + [0.0] * 6, [0.0] * 7],
        "accelerations": [[0.0] * 7] * 3,
        "progress": [[0.1, 0.4]],
        "problem": PROBLEM | {"scene": PROBLEM["scene"][:1]},
    }
    file = folder / "result.json"
    file.write_bytes(text_of(rng, record, ".json"))

    def read() -> None:
        saved = load_result(file)
        if saved.problem is not None and saved.result.path is not None:
            validator = Verifier(problem_from_record(saved.problem))
            validator.path(saved.result.path)
            if saved.result.trajectory is not None:
                validator.trajectory(saved.result.trajectory)

    return read


def _bundle(rng: np.random.Generator, folder: FilePath) -> Callable[[], object]:
    from robotdiffuse.robots import DATA, read_bundle
    from robotdiffuse.robots.kinematics import link_pose

    source = DATA / "panda"
    text, meshes = (source / "robot.json").read_text(), (source / "meshes.npz").read_bytes()
    damage = rng.random() < 0.7
    content = text_of(rng, json.loads(text), ".json") if damage else text.encode()
    (folder / "robot.json").write_bytes(content)
    if not damage and rng.random() < 0.7:
        import io

        stream, arrays = io.BytesIO(), dict(np.load(source / "meshes.npz"))
        name = ("sizes", "vertices", "faces")[rng.integers(3)]
        flat = arrays[name] = arrays[name].copy()
        row = rng.integers(len(flat))
        wrong = (np.nan, 1e30, np.inf) if name == "vertices" else (-1, 10**7, 10**12)
        flat[row, 0] = wrong[rng.integers(3)]
        np.savez(stream, **arrays)
        meshes = stream.getvalue()
    elif not damage:
        meshes = damaged(rng, meshes)
    (folder / "meshes.npz").write_bytes(meshes)

    def read() -> None:
        robot = read_bundle(folder)
        link_pose(robot, (robot.lower + robot.upper) / 2, robot.tip)

    return read


def asked(rng: np.random.Generator, right: float = 0.0) -> tuple[str, bytes]:
    """What a request over HTTP is for, and its body; as often as `right` says it is not damaged."""
    rows = np.linspace(PROBLEM["start"], PROBLEM["goal"]["joints"], 3).tolist()
    problem = (
        PROBLEM | {"scene": PROBLEM["scene"][: rng.integers(7)]} | (EQUIPPED if rng.random() < 0.1 else {})
    )
    plan = {"problem": problem, "planner": "rrt_connect", "time_limit": 0.05, "seed": 1, "until": "first"}
    plan |= {"velocity_scaling": 0.5, "acceleration_scaling": 0.5, "clearance": 0.01}
    motion = {"joint_names": JOINTS, "positions": rows}
    rates = {"velocities": [[0.0] * 7] * 3, "accelerations": [[0.0] * 7] * 3}
    validated = {
        "problem": problem,
        "path": motion,
        "trajectory": motion | {"times": [0.0, 1.0, 2.0]} | rates,
    }
    what = "verify" if rng.random() < 0.5 else "plan"
    body = validated if what == "verify" else plan
    if right and rng.random() < right:
        return what, json.dumps(body).encode()
    return what, text_of(rng, body, ".json")


def _http(rng: np.random.Generator, folder: FilePath) -> Callable[[], object]:
    """Bodies of requests, read and answered as a worker of `robotdiffuse serve` does."""
    from robotdiffuse.core.errors import InputError
    from robotdiffuse.robots import load_robot
    from robotdiffuse.server import worker

    what, body = asked(rng)

    def ask() -> None:
        worker.accept({"panda": load_robot("panda")}, 0.1, worker.Shared())
        answer = worker.respond(1, what, body)
        if answer.code == 400:
            raise InputError(json.loads(answer.body)["error"])
        assert answer.code == 200, answer.body.decode()

    return ask


def _socket(rng: np.random.Generator, folder: FilePath) -> Callable[[], object]:
    """Requests to a running `robotdiffuse serve`; the server itself is checked now and then."""
    import fuzz_socket

    from robotdiffuse.core.errors import InputError

    (what, body), (_, other) = asked(rng, 0.5), asked(rng, 0.5)
    sent = fuzz_socket.sent(rng, fuzz_socket.draft(rng, what, body, other), damaged)
    looks = rng.random() < 1 / fuzz_socket.EVERY

    def ask() -> None:
        server = fuzz_socket.server()
        said = fuzz_socket.exchange(server.address, sent)
        if looks:
            server.check()
        if said:
            raise InputError(said)

    return ask


def _motion(rng: np.random.Generator, folder: FilePath) -> Callable[[], object]:
    from robotdiffuse.core.types import Trajectory
    from robotdiffuse.interop import read_motion, write_motion
    from robotdiffuse.interop.plain_messages import joint_trajectory
    from robotdiffuse.interop.recorded_motion import fitted
    from robotdiffuse.problems.files import problem_from_record
    from robotdiffuse.validation.validator import Verifier

    problem = problem_from_record(PROBLEM | {"scene": PROBLEM["scene"][:1]})
    rows = np.linspace(PROBLEM["start"], PROBLEM["goal"]["joints"], 3)
    times, still = np.array([0.0, 10.0, 20.0]), np.zeros_like(rows)
    trajectory = Trajectory(problem.robot.joint_names, times, rows, still, still)
    ending = (".json", ".yaml", ".csv", ".mcap", ".rosbag2")[rng.integers(5)]
    file = folder / f"motion{ending}"
    if ending == ".json" and rng.random() < 0.3:
        trajectory.save(file)
        file.write_bytes(text_of(rng, json.loads(file.read_text()), ending))
    elif ending in (".json", ".yaml"):
        forms = (
            lambda r: r,
            lambda r: {"joint_trajectory": r},
            lambda r: {"trajectory": [{"joint_trajectory": r}]},
        )
        record = forms[rng.integers(3)](joint_trajectory(trajectory.joint_names, trajectory))
        file.write_bytes(text_of(rng, record, ending))
    else:
        write_motion(problem, trajectory, file)
        part = file if ending != ".rosbag2" else sorted(file.iterdir())[rng.integers(2)]
        part.write_bytes(damaged(rng, part.read_bytes()))

    def read() -> None:
        motion = fitted(read_motion(file), problem.robot).motion
        validator = Verifier(problem)
        validator.trajectory(motion) if isinstance(motion, Trajectory) else validator.path(motion)

    return read


@cache
def _certificate_record() -> dict[str, Any]:
    import tempfile

    from robotdiffuse.certificates.search import certify
    from robotdiffuse.core.types import Path
    from robotdiffuse.problems.files import problem_from_record

    start = PROBLEM["start"]
    rows = np.array([start, start])
    rows[1, 0] += 0.05
    problem = problem_from_record(PROBLEM | {"scene": [], "goal": {"joints": rows[1].tolist()}})
    with tempfile.TemporaryDirectory() as folder:
        certify(problem, Path(problem.robot.joint_names, rows)).save(f"{folder}/c.json")
        return json.loads(FilePath(f"{folder}/c.json").read_text())


def _certificate(rng: np.random.Generator, folder: FilePath) -> Callable[[], object]:
    from robotdiffuse.certificates.certificate import load_certificate

    file = folder / "certificate.json"
    file.write_bytes(text_of(rng, _certificate_record(), ".json"))
    return lambda: load_certificate(file).check()


def _depth(rng: np.random.Generator, folder: FilePath) -> Callable[[], object]:
    """Depth images, and the views that name them."""
    from PIL import Image

    ending, image = (".png", ".npy", ".npz")[rng.integers(3)], rng.integers(0, 3000, (6, 8)).astype(np.uint16)
    file = folder / f"depth{ending}"
    if ending == ".png":
        Image.fromarray(image).save(file)
    else:
        (np.save if ending == ".npy" else np.savez)(file, image if rng.random() < 0.5 else image / 1000)
    if rng.random() < 0.6:
        file.write_bytes(damaged(rng, file.read_bytes()))
    view = VIEW | {"depth": file.name, "intrinsics": [6.0, 6.0, 4, 3], "scale": 0.001}
    del view["cloud"]
    problem = PROBLEM | {"scene": PROBLEM["scene"][:1], "views": [view], "unknown": "padded"}
    (folder / "problem.json").write_bytes(
        text_of(rng, problem, ".json") if rng.random() < 0.5 else json.dumps(problem).encode()
    )
    return lambda: _validated(folder / "problem.json")


def _upload(rng: np.random.Generator, folder: FilePath) -> Callable[[], object]:
    """Problem files that browsers send to the live page."""
    from robotdiffuse.robots import load_robot
    from robotdiffuse.visualization.live.files import problem_text, uploaded_problem
    from robotdiffuse.visualization.live.session import Session

    problem = PROBLEM | ({}, EQUIPPED, CONSTRAINED, MOVING)[rng.integers(4)]
    ending = (".yaml", ".json")[rng.integers(2)]
    content = text_of(rng, problem, ending)

    def read() -> None:
        problem = uploaded_problem(content, f"p{ending}", load_robot("panda"))
        Session(problem).close()
        problem_text(problem)

    return read


def _head(rng: np.random.Generator, folder: FilePath) -> Callable[[], object]:
    """Heads of requests, at the door of the live page: handed on or not, never an error."""
    from robotdiffuse.visualization.live.access import admitted

    token = ("", "abc")[rng.integers(2)]
    host = (b"localhost:8080", b"[::1]:1", b"a.example")[rng.integers(3)]
    head = b"GET /abc/?x=1 HTTP/1.1\r\nHost: %s\r\nOrigin: http://%s\r\nUpgrade: websocket" % (host, host)
    head = damaged(rng, head)
    return lambda: admitted(head, token)


def _settings(rng: np.random.Generator, folder: FilePath) -> Callable[[], object]:
    """What --set says of planners, and settings of trainings."""
    from robotdiffuse.learning.training.config import PlannerTraining
    from robotdiffuse.planning import PLANNERS, planner_settings

    if rng.random() < 0.5:
        data = mutated(rng, PlannerTraining(data="d", encoder="e").to_json())
        return lambda: PlannerTraining.from_json(data, "settings")
    names = [*PLANNERS]
    name = names[rng.integers(len(names))]
    fields = ("range", "guidance.margin", "search.iterations", "samples", "weights", "", "a.b.c")
    value = str(_nasty(rng))
    said = f"{fields[rng.integers(len(fields))]}={value}" if rng.random() < 0.8 else value
    return lambda: planner_settings(name, [said])


def _weights(rng: np.random.Generator, folder: FilePath) -> Callable[[], object]:
    """Folders with the weights of a network."""
    from robotdiffuse.learning.checkpoint import BUNDLED, load_network
    from robotdiffuse.robots import load_robot

    about, tensors = (BUNDLED / "panda" / f"mpinets.{ending}" for ending in ("json", "safetensors"))
    whole = rng.random() < 0.8
    text = text_of(rng, json.loads(about.read_text()), ".json") if whole else about.read_bytes()
    (folder / about.name).write_bytes(text)
    if whole:
        (folder / tensors.name).symlink_to(tensors)
    else:
        (folder / tensors.name).write_bytes(damaged(rng, tensors.read_bytes()[: 10 ** rng.integers(2, 7)]))
    return lambda: load_network("mpinets", folder, load_robot("panda"))


def _npz(rng: np.random.Generator, folder: FilePath) -> Callable[[], object]:
    """The authors' data sets."""
    import io

    from robotdiffuse.datasets.robot_npz import import_npz

    stream, x = io.BytesIO(), np.zeros((2, 254, 7), np.float32)
    x += np.array(PROBLEM["start"], np.float32)
    y = np.concatenate([x[:, 0], x[:, -1], np.ones((2, 9), np.float32)], axis=1)
    if rng.random() < 0.3:
        y[0, rng.integers(y.shape[1])] = (np.nan, 1e30, np.inf)[rng.integers(3)]
    np.savez(stream, x_train=x, y_train=y)
    file = folder / "robot.npz"
    file.write_bytes(damaged(rng, stream.getvalue()) if rng.random() < 0.8 else stream.getvalue())
    return lambda: import_npz(file, folder / "set")


KINDS: dict[str, Make] = {
    "problem": _problem,
    "moveit": _moveit,
    "cloud": _cloud,
    "mesh": _mesh,
    "urdf": _urdf,
    "result": _result,
    "bundle": _bundle,
    "http": _http,
    "socket": _socket,
    "motion": _motion,
    "certificate": _certificate,
    "depth": _depth,
    "upload": _upload,
    "head": _head,
    "settings": _settings,
    "weights": _weights,
    "npz": _npz,
}


def _work(pipe: Connection, seed: int, count: int, kinds: tuple[str, ...]) -> None:
    """Inputs from a seed on, kinds in turn, one message each."""
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    quiet = os.open(os.devnull, os.O_WRONLY)
    os.dup2(quiet, 2)
    with tempfile.TemporaryDirectory() as folder:
        for i in range(seed, seed + count):
            kind = kinds[i % len(kinds)]
            clock = time.monotonic if kind == "socket" else time.process_time
            begun = clock()
            inner = FilePath(folder) / str(i)
            inner.mkdir()
            pipe.send((*one(kind, i, inner), clock() - begun))
            shutil.rmtree(inner)


def run(seconds: float, seed: int, kinds: tuple[str, ...]) -> tuple[Counter, list[str], dict[str, float]]:
    """Numbers by kind and outcome, faults, and the longest times, of as many inputs as there is time for."""
    counts: Counter[tuple[str, str]] = Counter()
    faults: list[str] = []
    slowest = dict.fromkeys(kinds, 0.0)
    context, until, number = multiprocessing.get_context("spawn"), time.monotonic() + seconds, seed
    while time.monotonic() < until:
        ours, theirs = context.Pipe()
        worker = context.Process(target=_work, args=(theirs, number, 10**9, kinds), daemon=True)
        worker.start()
        theirs.close()
        ended, first = False, True
        while not ended and time.monotonic() < until:
            kind, took = kinds[number % len(kinds)], 0.0
            try:
                ended = not ours.poll(PATIENCE)
                result, said, took = ("fault", "it does not end", PATIENCE) if ended else ours.recv()
            except EOFError:
                worker.join()
                ended, result, said = True, "fault", f"the process ended with {worker.exitcode}"
            took = 0.0 if first else took  # which loads compiled code
            if took > LIMIT and kind != "socket":
                result, said = "fault", f"{took:.1f} s"
            counts[kind, result] += 1
            slowest[kind] = max(slowest[kind], took)
            if result == "fault":
                faults.append(f"{kind} {number}: {said}")
            number, first = number + 1, False
        worker.kill()
        worker.join()
    return counts, faults, slowest


def main() -> None:
    from report import header, print_table

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--seconds", type=float, default=600)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default=",".join(KINDS))
    arguments = parser.parse_args()
    kinds = tuple(arguments.only.split(","))
    counts, faults, slowest = run(arguments.seconds, arguments.seed, kinds)
    rows = []
    for kind in kinds:
        found = [counts[kind, what] for what in ("answer", "error", "fault")]
        rows.append([kind, f"{sum(found):,}", *(f"{n:,}" for n in found), f"{slowest[kind]:.2f}"])
    print(header("numpy", "trimesh", "coal"), "\n")
    columns = ["kind", "inputs", "answers", "one-line errors", "anything else", "slowest, s"]
    print_table(f"{counts.total():,} damaged inputs, from seed {arguments.seed}", columns, rows)
    for fault in faults[:200]:
        print(fault)


if __name__ == "__main__":
    main()
