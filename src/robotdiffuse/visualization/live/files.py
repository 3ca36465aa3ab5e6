"""Problems that the page opens, uploads and saves, and replays that it saves."""

from importlib.resources import as_file, files
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from robotdiffuse.core.errors import InputError, shown, unknown_name
from robotdiffuse.core.input_files import parse_json, parse_yaml
from robotdiffuse.core.results import PlanResult
from robotdiffuse.core.types import Path as JointPath
from robotdiffuse.problems.families import load_family
from robotdiffuse.problems.files import load_problem, problem_from_record, save_problem
from robotdiffuse.problems.problem import JointGoal, Problem
from robotdiffuse.robots import known_robots, load_robot
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.validation.validator import verify
from robotdiffuse.visualization.replay_page import write_replay

DEMO_FILE = "shelf.yaml"
FAMILY = "shelf"
MAX_UPLOAD_SIZE = 5_000_000
"""Largest problem file [bytes]."""
FILE_FIELDS = ("file", "request", "views")
"""Fields of a problem that name files on the server."""
MAX_SAMPLES = 1000
"""Most random configurations that are tried for a free start and goal."""


def first_problem(file: str | None, robot: str | None) -> Problem:
    """The first problem of the page: from a file, for a robot, or the demo.

    Raises InputError if both are given, and for a bad file or robot.
    """
    if file is not None and robot is not None:
        raise InputError(f"{file} names its robot; give a problem or --robot {robot}, not both")
    if file is not None:
        return load_problem(file)
    if robot is not None:
        return problem_for(load_robot(robot))
    with as_file(files("robotdiffuse") / "examples" / DEMO_FILE) as demo:
        return load_problem(demo)


def problem_for(robot: Robot) -> Problem:
    """A problem of the family shelf for the arm; if there is none, between two free configurations in an
    empty scene."""
    rng = np.random.default_rng(0)
    try:
        return load_family(FAMILY).draw(robot, rng).problem(robot)
    except InputError:
        pass
    lower, upper = (np.clip(limit, -np.pi, np.pi) for limit in (robot.lower, robot.upper))
    free: list[np.ndarray] = []
    for q in rng.uniform(lower, upper, (MAX_SAMPLES, robot.dof)):
        alone = Problem(robot, Scene(), q, JointGoal(q))
        if verify(alone, JointPath(robot.joint_names, q[None])).valid:
            free.append(q)
        if len(free) == 2:
            return Problem(robot, Scene(), free[0], JointGoal(free[1]))
    raise InputError(f"of {MAX_SAMPLES} random configurations of {robot.name} fewer than 2 are free")


def uploaded_problem(content: bytes, name: str, robot: Robot) -> Problem:
    """The problem in an uploaded file.

    It may name known robots and the one on the page, but no files on the server. Raises InputError, which
    begins with the name of the file.
    """
    if len(content) > MAX_UPLOAD_SIZE:
        raise InputError(f"{name} has {len(content)} bytes; at most {MAX_UPLOAD_SIZE} are read")
    try:
        text = content.decode("utf-8")
    except UnicodeDecodeError:
        raise InputError(f"{name} is not UTF-8 text") from None
    data = parse_json(text, name) if name.lower().endswith(".json") else parse_yaml(text, name)
    try:
        _check_contained(data, robot)
        return problem_from_record(data)
    except InputError as error:
        raise InputError(f"{name}: {str(error).removeprefix('problem: ')}") from None


def _check_contained(data: object, robot: Robot) -> None:
    """Raises InputError if the data of a problem file names files."""
    if not isinstance(data, dict):
        return  # the problem reader rejects it
    given, known = data.get("robot"), known_robots()
    if isinstance(given, str) and given not in known and given != robot.source:
        raise unknown_name("robot", given, known)
    if isinstance(data.get("scene"), str):
        raise InputError(f"scene is {shown(data['scene'])}; {_NO_FILES}")
    parts: list[object] = [data]
    while parts:
        part = parts.pop()
        if isinstance(part, dict):
            for field in FILE_FIELDS:
                if field in part:
                    raise InputError(f"{field} is {shown(part[field])}; {_NO_FILES}")
            parts += part.values()
        elif isinstance(part, list):
            parts += part


_NO_FILES = "the page reads no other files; open this problem with `robotdiffuse live PROBLEM`"


def problem_text(problem: Problem) -> bytes:
    """The problem as a YAML file."""
    with TemporaryDirectory() as folder:
        file = Path(folder) / "problem.yaml"
        save_problem(problem, file)
        return file.read_bytes()


def replay_page(problem: Problem, result: PlanResult, candidates: tuple[JointPath, ...] = ()) -> bytes:
    """The replay of a solved result as a self-contained HTML page."""
    motion = result.trajectory or result.path
    assert motion is not None
    with TemporaryDirectory() as folder:
        file = Path(folder) / "replay.html"
        write_replay(*problem.standing(), motion, file, result=result, candidates=candidates)
        return file.read_bytes()
