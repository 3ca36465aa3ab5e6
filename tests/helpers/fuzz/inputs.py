"""Damaged inputs of seventeen kinds: each must give an answer or a one-line error, in bounded time.

An input is a kind and a seed; `outcome_of(kind, seed, folder)` makes the same one again.
"""

import copy
import io
import json
import re
import tempfile
import traceback
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
import yaml
from PIL import Image

import robotdiffuse as rd
from helpers.fuzz import examples, server
from helpers.point_files import FORMS, write_points
from robotdiffuse.interop import read_motion, write_motion
from robotdiffuse.interop.recorded_motion import joint_trajectory, motion_of_robot
from robotdiffuse.problems.files import load_motion_bench_maker, load_problem, problem_from_record, problem_record
from robotdiffuse.robots import DATA, load_robot, read_robot_folder
from robotdiffuse.robots.parsing.srdf import read_srdf
from robotdiffuse.robots.parsing.urdf import UrdfTree, read_limits, with_limits
from robotdiffuse.scenes.point_cloud import read_points
from robotdiffuse.validation.validator import Verifier

MAX_MESSAGE_LENGTH = 1000
"""Characters of an error message; names of files and lists of known names make some long."""
Make = Callable[[np.random.Generator, Path], Callable[[], object]]
"""Writes the files of an input to a folder and returns the call that reads them."""
NASTY: tuple[Any, ...] = (
    *(None, True, False, 0, -1, 1, 2**31, 2**63, 10**25, -0.0, 0.5, 1e-300, 1e-9, 1e4, 1e5, 1e20, 1e39),
    *(1e308, float("inf"), float("nan"), "", "x", "x" * 5000, "\0", "\ud800", "../..", "/dev/zero", "panda"),
    *("a/b.urdf", [], {}, [[]], [[1, 2, 3]], [[1, 2], [3]], {"x": 1}, [None] * 7, [0.0] * 7, [1e200] * 4),
    *([0, 0, 0, 0], {"file": "x" * 300}, {"file": "\0.stl"}, {"sphere": None}, [{"a": []}], "2001-13-45"),
    *("1_000", "0x"),
)
"""Replacements of values."""
TOKENS = (
    *(b"[", b"{", b"]" * 3, b"}", b"[" * 3000, b"{a: " * 200, b"- " * 300, b"&a ", b"*a", b"!!int foo"),
    *(b"!x ", b"9" * 5000, b"1e400", b"nan", b"-inf", b"\0", b"\xff\xfe", b"'", b'"', b":", b"\n", b"\t"),
    *(b"%", b"#", b"2001-13-45", b"<<: ", b"|", b"<a>" * 100, b"&lt;", b"<!DOCTYPE a>", b'encoding="utf-7"'),
    *(b"1e308", b"0"),
)
"""Replacements of bytes."""


def mutated(rng: np.random.Generator, value: Any) -> Any:
    """Plain data with one to three of its values, keys or rows changed."""
    value = json.loads(json.dumps(value))
    for _ in range(rng.integers(1, 4)):
        places = list(_places(value))
        if not places:
            return nasty(rng)
        owner, key = places[rng.integers(len(places))]
        action = rng.integers(9)
        if action < 3:
            owner[key] = nasty(rng)
        elif action == 3:
            del owner[key]
        elif action == 4 and isinstance(owner, dict):
            owner[str(nasty(rng))[:100]] = owner.pop(key)
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


def nasty(rng: np.random.Generator) -> Any:
    return copy.deepcopy(NASTY[rng.integers(len(NASTY))])


def damaged(rng: np.random.Generator, content: bytes) -> bytes:
    """Bytes with one to four changes: flipped, cut, doubled, or replaced by a token."""
    for _ in range(rng.integers(1, 5)):
        at = int(rng.integers(len(content) + 1))
        action = rng.integers(5)
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
    """Plain data as JSON or YAML, with changed values or with damaged bytes."""
    by_value = rng.random() < 0.6
    data = mutated(rng, data) if by_value else data
    if ending in (".yaml", ".yml"):
        text = yaml.dump(data, Dumper=yaml.SafeDumper, default_flow_style=None, allow_unicode=False)
    else:
        text = json.dumps(data)
    content = text.encode("utf-8", "surrogatepass")
    return content if by_value else damaged(rng, content)


def numbers_changed(rng: np.random.Generator, content: bytes) -> bytes:
    """XML with damaged bytes or with replaced attributes."""
    if rng.random() < 0.4:
        return damaged(rng, content)
    values = list(re.finditer(rb'"[^"]*"', content))
    for match in [values[i] for i in rng.integers(len(values), size=rng.integers(1, 3))]:
        new = str(nasty(rng)).encode("utf-8", "surrogatepass")
        content = content.replace(match.group(), b'"' + new.replace(b'"', b"'").replace(b"<", b"") + b'"', 1)
    return content


def outcome(call: Callable[[], object]) -> tuple[str, str]:
    """The outcome of an input, `answer`, `error` or `fault`, and the error message."""
    try:
        call()
    except rd.InputError as error:
        text = str(error)
        good = text and "\n" not in text and len(text) <= MAX_MESSAGE_LENGTH
        return ("error" if good else "fault"), text[: 2 * MAX_MESSAGE_LENGTH]
    except BaseException as error:
        place = traceback.extract_tb(error.__traceback__)[-1]
        return "fault", f"{type(error).__name__}: {str(error)[:200]} ({place.filename}:{place.lineno})"
    return "answer", ""


def outcome_of(kind: str, seed: int, folder: Path) -> tuple[str, str]:
    """Make an input, whose files are written to the folder, and return its outcome."""
    return outcome(KINDS[kind](np.random.default_rng([seed, *kind.encode()]), folder))


def _problem(rng: np.random.Generator, folder: Path) -> Callable[[], object]:
    data = dict(examples.PROBLEM)
    if rng.random() < 0.2:
        data["goal"] = {"pose": examples.POSE}
    if rng.random() < 0.1:
        data["views"] = [examples.VIEW]
        data["unknown"] = "optimistic"
    else:
        data |= (*({},) * 3, examples.EQUIPPED, examples.CONSTRAINED, examples.MOVING, examples.IN_MOTION)[rng.integers(7)]
    ending = (".yaml", ".json", ".jsonl")[rng.integers(3)]
    file = folder / f"problem{ending}"
    file.write_bytes(text_of(rng, data, ending))
    return lambda: _validated(file)


def _validated(file: Path) -> None:
    """Read a problem and, if its goal is a configuration, validate the straight line to it."""
    problem = load_problem(file)
    problem_from_record(problem_record(problem))
    if isinstance(problem.goal, rd.JointGoal):
        Verifier(problem).path(rd.Path(problem.robot.joint_names, np.stack([problem.start, problem.goal.positions[0]])))


def _moveit(rng: np.random.Generator, folder: Path) -> Callable[[], object]:
    asked = copy.deepcopy(examples.REQUEST)
    if rng.random() < 0.3:
        asked["start_state"]["attached_collision_objects"] = [examples.HELD]
    scene, request = (yaml_text(rng, data, i) for i, data in enumerate((examples.MOVEIT, asked)))
    (folder / "scene0001.yaml").write_bytes(scene)
    (folder / "request0001.yaml").write_bytes(request)
    return lambda: load_motion_bench_maker(folder)[0].load()


def yaml_text(rng: np.random.Generator, data: Any, other: int) -> bytes:
    return text_of(rng, data, ".yaml") if rng.random() < 0.6 + 0.1 * other else json.dumps(data).encode()


def _cloud(rng: np.random.Generator, folder: Path) -> Callable[[], object]:
    points = rng.normal(size=(5, 3))
    if rng.random() < 0.2:
        points[0, 0] = (np.inf, 1e38, 0)[rng.integers(3)]
    file = write_points(folder, FORMS[rng.integers(len(FORMS))], points)
    file.write_bytes(damaged(rng, file.read_bytes()))
    return lambda: rd.PointCloud(read_points(file)[0])


def _mesh(rng: np.random.Generator, folder: Path) -> Callable[[], object]:
    """A small mesh with its bytes damaged."""
    ending = examples.MESHES[rng.integers(len(examples.MESHES))]
    content = trimesh.creation.box((0.1, 0.2, 0.3)).export(file_type=ending)
    content = content.encode() if isinstance(content, str) else bytes(content)
    (folder / f"part.{ending}").write_bytes(damaged(rng, content))
    problem = examples.PROBLEM | {"scene": [{"mesh": {"file": f"part.{ending}", "xyz": [2, 2, 2]}}]}
    (folder / "problem.json").write_text(json.dumps(problem))
    return lambda: _validated(folder / "problem.json")


def _urdf(rng: np.random.Generator, folder: Path) -> Callable[[], object]:
    part = bytes(trimesh.creation.box((0.1, 0.05, 0.3)).export(file_type="stl"))  # type: ignore[arg-type]
    (folder / "part.stl").write_bytes(damaged(rng, part) if rng.random() < 0.2 else part)
    files = {name: folder / name for name in ("two.urdf", "two.srdf", "limits.yaml")}
    which = rng.integers(4)
    files["two.urdf"].write_bytes(numbers_changed(rng, examples.URDF) if which < 2 else examples.URDF)
    files["two.srdf"].write_bytes(numbers_changed(rng, examples.SRDF) if which == 2 else examples.SRDF)
    limits = text_of(rng, examples.LIMITS, ".yaml") if which == 3 else json.dumps(examples.LIMITS).encode()
    files["limits.yaml"].write_bytes(limits)

    def read() -> None:
        srdf = read_srdf(files["two.srdf"])
        tree = UrdfTree(files["two.urdf"], {})
        robot = tree.robot(None, "lower", None, None, srdf)
        assert tree.digest
        with_limits(robot, read_limits(files["limits.yaml"])[0])

    return read


def _result(rng: np.random.Generator, folder: Path) -> Callable[[], object]:
    record: dict[str, Any] = {"status": "solved", "reason": "solved by hand", "planner": "hand", "robot": "panda"}
    record |= {"joint_names": examples.JOINTS, "planning_time": 0.1, "verified": True, "seed": 0, "waypoints": examples.ROWS}
    record |= {"times": [0.0, 1.0, 2.0], "positions": examples.ROWS}
    record |= {"velocities": [[0.0] * 7, [0.3] + [0.0] * 6, [0.0] * 7], "accelerations": [[0.0] * 7] * 3}
    record |= {"progress": [[0.1, 0.4]], "problem": examples.SMALL}
    file = folder / "result.json"
    file.write_bytes(text_of(rng, record, ".json"))

    def read() -> None:
        saved = rd.load_result(file)
        if saved.problem is not None and saved.result.path is not None:
            validator = Verifier(problem_from_record(saved.problem))
            validator.path(saved.result.path)
            if saved.result.trajectory is not None:
                validator.trajectory(saved.result.trajectory)

    return read


def _bundle(rng: np.random.Generator, folder: Path) -> Callable[[], object]:
    source = DATA / "panda"
    text = (source / "robot.json").read_text()
    meshes = (source / "meshes.npz").read_bytes()
    damage = rng.random() < 0.7
    (folder / "robot.json").write_bytes(text_of(rng, json.loads(text), ".json") if damage else text.encode())
    if not damage and rng.random() < 0.7:
        stream = io.BytesIO()
        arrays = dict(np.load(source / "meshes.npz"))
        name = ("sizes", "vertices", "faces")[rng.integers(3)]
        flat = arrays[name] = arrays[name].copy()
        row = rng.integers(len(flat))
        flat[row, 0] = ((np.nan, 1e30, np.inf) if name == "vertices" else (-1, 10**7, 10**12))[rng.integers(3)]
        np.savez(stream, **arrays)
        meshes = stream.getvalue()
    elif not damage:
        meshes = damaged(rng, meshes)
    (folder / "meshes.npz").write_bytes(meshes)

    def read() -> None:
        robot = read_robot_folder(folder)
        robot.fk((robot.lower + robot.upper) / 2)

    return read


def asked(rng: np.random.Generator, right: float = 0.0) -> tuple[str, bytes]:
    """The endpoint of a request over HTTP, and the request's body, which is undamaged with probability `right`."""
    problem = examples.PROBLEM | {"scene": examples.PROBLEM["scene"][: rng.integers(7)]}
    problem |= examples.EQUIPPED if rng.random() < 0.1 else {}
    plan = {"problem": problem, "planner": "rrt_connect", "time_limit": 0.05, "seed": 1, "until": "first"}
    plan |= {"velocity_scaling": 0.5, "acceleration_scaling": 0.5, "clearance": 0.01}
    motion = {"joint_names": examples.JOINTS, "positions": examples.ROWS}
    rates = {"velocities": [[0.0] * 7] * 3, "accelerations": [[0.0] * 7] * 3}
    validated = {"problem": problem, "path": motion, "trajectory": motion | {"times": [0.0, 1.0, 2.0]} | rates}
    what = "verify" if rng.random() < 0.5 else "plan"
    body = validated if what == "verify" else plan
    if right and rng.random() < right:
        return what, json.dumps(body).encode()
    return what, text_of(rng, body, ".json")


def _http(rng: np.random.Generator, folder: Path) -> Callable[[], object]:
    """Request bodies, answered as a worker of `robotdiffuse serve` answers them."""
    from robotdiffuse.server import worker
    from robotdiffuse.server.settings import ServeSettings

    what, body = asked(rng)

    def ask() -> None:
        worker.accept({"panda": load_robot("panda")}, ServeSettings(max_time_limit=0.1))
        answer = worker.respond(what, body)
        if answer.code == 400:
            raise rd.InputError(json.loads(answer.body)["error"])
        assert answer.code == 200, answer.body.decode()

    return ask


def _socket(rng: np.random.Generator, folder: Path) -> Callable[[], object]:
    """Requests to a running `robotdiffuse serve`. From time to time, the server itself is checked."""
    (what, body), (_, other) = asked(rng, 0.5), asked(rng, 0.5)
    sent = server.sent(rng, server.draft(rng, what, body, other), damaged)
    looks = rng.random() < 1 / server.INPUTS_BETWEEN_CHECKS

    def ask() -> None:
        running = server.running_server()
        said = server.exchange(running.address, sent)
        if looks:
            running.check()
        if said:
            raise rd.InputError(said)

    return ask


def _motion(rng: np.random.Generator, folder: Path) -> Callable[[], object]:
    problem = problem_from_record(examples.SMALL)
    rows = np.array(examples.ROWS)
    still = np.zeros_like(rows)
    trajectory = rd.Trajectory(problem.robot.joint_names, np.array([0.0, 10.0, 20.0]), rows, still, still)
    ending = (".json", ".yaml", ".csv", ".mcap", ".rosbag2")[rng.integers(5)]
    file = folder / f"motion{ending}"
    if ending == ".json" and rng.random() < 0.3:
        trajectory.save(file)
        file.write_bytes(text_of(rng, json.loads(file.read_text()), ending))
    elif ending in (".json", ".yaml"):
        forms = (lambda r: r, lambda r: {"joint_trajectory": r}, lambda r: {"trajectory": [{"joint_trajectory": r}]})
        file.write_bytes(text_of(rng, forms[rng.integers(3)](joint_trajectory(trajectory)), ending))
    else:
        write_motion(problem, trajectory, file)
        part = file if ending != ".rosbag2" else sorted(file.iterdir())[rng.integers(2)]
        part.write_bytes(damaged(rng, part.read_bytes()))

    def read() -> None:
        motion = motion_of_robot(read_motion(file), problem.robot).motion
        validator = Verifier(problem)
        validator.trajectory(motion) if isinstance(motion, rd.Trajectory) else validator.path(motion)

    return read


@cache
def _certificate_record() -> dict[str, Any]:
    start = examples.PROBLEM["start"]
    rows = np.array([start, start])
    rows[1, 0] += 0.05
    problem = problem_from_record(examples.PROBLEM | {"scene": [], "goal": {"joints": rows[1].tolist()}})
    with tempfile.TemporaryDirectory() as folder:
        rd.certify(problem, rd.Path(problem.robot.joint_names, rows)).save(f"{folder}/c.json")
        return json.loads(Path(f"{folder}/c.json").read_text())


def _certificate(rng: np.random.Generator, folder: Path) -> Callable[[], object]:
    file = folder / "certificate.json"
    file.write_bytes(text_of(rng, _certificate_record(), ".json"))
    return lambda: rd.load_certificate(file).check()


def _depth(rng: np.random.Generator, folder: Path) -> Callable[[], object]:
    """Depth images, and the views that name them."""
    ending = (".png", ".npy", ".npz")[rng.integers(3)]
    image = rng.integers(0, 3000, (6, 8)).astype(np.uint16)
    file = folder / f"depth{ending}"
    if ending == ".png":
        Image.fromarray(image).save(file)
    else:
        (np.save if ending == ".npy" else np.savez)(file, image if rng.random() < 0.5 else image / 1000)
    if rng.random() < 0.6:
        file.write_bytes(damaged(rng, file.read_bytes()))
    view = examples.VIEW | {"depth": file.name, "intrinsics": [6.0, 6.0, 4, 3], "scale": 0.001}
    del view["cloud"]
    problem = examples.SMALL | {"views": [view], "unknown": "padded"}
    content = text_of(rng, problem, ".json") if rng.random() < 0.5 else json.dumps(problem).encode()
    (folder / "problem.json").write_bytes(content)
    return lambda: _validated(folder / "problem.json")


def _upload(rng: np.random.Generator, folder: Path) -> Callable[[], object]:
    """Problem files that browsers send to the live page."""
    from robotdiffuse.visualization.live.session import Session, problem_text, uploaded_problem

    problem = examples.PROBLEM | ({}, examples.EQUIPPED, examples.CONSTRAINED, examples.MOVING)[rng.integers(4)]
    ending = (".yaml", ".json")[rng.integers(2)]
    content = text_of(rng, problem, ending)

    def read() -> None:
        problem = uploaded_problem(content, f"p{ending}", load_robot("panda"))
        Session(problem).close()
        problem_text(problem)

    return read


def _head(rng: np.random.Generator, folder: Path) -> Callable[[], object]:
    """Headers of requests to the live page, which accepts or refuses them and never raises an error."""
    from robotdiffuse.visualization.live.server import may_connect

    token = ("", "abc")[rng.integers(2)]
    host = (b"localhost:8080", b"[::1]:1", b"a.example")[rng.integers(3)]
    path, host, origin = (damaged(rng, field).decode("latin-1") for field in (b"/abc/?x=1", host, b"http://" + host))
    return lambda: may_connect(path, host, origin, token)


def _settings(rng: np.random.Generator, folder: Path) -> Callable[[], object]:
    """Values of `--set` for planners, and settings of training runs."""
    from robotdiffuse.learning.training.config import PlannerTraining
    from robotdiffuse.planning import PLANNERS, planner_settings

    if rng.random() < 0.5:
        data = mutated(rng, PlannerTraining(data="d", encoder="e").to_json())
        return lambda: PlannerTraining.from_json(data, "settings")
    names = [*PLANNERS]
    name = names[rng.integers(len(names))]
    fields = ("range", "guidance.margin", "iterations", "samples", "weights", "", "a.b.c")
    value = str(nasty(rng))
    said = f"{fields[rng.integers(len(fields))]}={value}" if rng.random() < 0.8 else value
    return lambda: planner_settings(name, [said])


def _weights(rng: np.random.Generator, folder: Path) -> Callable[[], object]:
    """Folders with the weights of a network."""
    from robotdiffuse.learning.checkpoint import load_network
    from robotdiffuse.learning.weight_files import BUNDLED

    about, tensors = (BUNDLED / "panda" / f"mpinets.{ending}" for ending in ("json", "safetensors"))
    whole = rng.random() < 0.8
    (folder / about.name).write_bytes(text_of(rng, json.loads(about.read_text()), ".json") if whole else about.read_bytes())
    if whole:
        (folder / tensors.name).symlink_to(tensors)
    else:
        (folder / tensors.name).write_bytes(damaged(rng, tensors.read_bytes()[: 10 ** rng.integers(2, 7)]))
    return lambda: load_network("mpinets", folder, load_robot("panda"))


def _npz(rng: np.random.Generator, folder: Path) -> Callable[[], object]:
    """Data sets in the file layout of the paper's authors."""
    from robotdiffuse.datasets.external import import_npz

    stream = io.BytesIO()
    x = np.zeros((2, 254, 7), np.float32) + np.array(examples.PROBLEM["start"], np.float32)
    y = np.concatenate([x[:, 0], x[:, -1], np.ones((2, 9), np.float32)], axis=1)
    if rng.random() < 0.3:
        y[0, rng.integers(y.shape[1])] = (np.nan, 1e30, np.inf)[rng.integers(3)]
    np.savez(stream, x_train=x, y_train=y)
    file = folder / "robot.npz"
    file.write_bytes(damaged(rng, stream.getvalue()) if rng.random() < 0.8 else stream.getvalue())
    return lambda: import_npz(file, folder / "set")


_MAKERS = (_problem, _moveit, _cloud, _mesh, _urdf, _result, _bundle, _http, _socket, _motion, _certificate, _depth, _upload)
KINDS: dict[str, Make] = {make.__name__[1:]: make for make in (*_MAKERS, _head, _settings, _weights, _npz)}
