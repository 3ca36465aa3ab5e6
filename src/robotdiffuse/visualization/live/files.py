"""Problems and replays as the page opens and hands them out, and what it begins with."""

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

DEMO = "shelf.yaml"
FAMILY = "shelf"
LARGEST_UPLOAD = 5_000_000
"""Of a problem file [bytes]."""
ON_DISK = ("file", "request", "views")
"""Fields that name files of the machine that the page runs on."""
TRIES = 1000
"""Random configurations among which a free start and goal are looked for."""


def first_problem(file: str | None, robot: str | None) -> Problem:
    """What the page begins with: a problem file, a robot's first problem, or the demo.

    Raises InputError for both at once, and for whatever is wrong with either.
    """
    if file is not None and robot is not None:
        raise InputError(f"{file} names its robot; give a problem or --robot {robot}, not both")
    if file is not None:
        return load_problem(file)
    if robot is not None:
        return problem_for(load_robot(robot))
    with as_file(files("robotdiffuse") / "examples" / DEMO) as demo:
        return load_problem(demo)


def problem_for(robot: Robot) -> Problem:
    """Between shelves that are drawn for the arm; where none suit it, between two free configurations."""
    rng = np.random.default_rng(0)
    try:
        return load_family(FAMILY).draw(robot, rng).problem(robot)
    except InputError:
        pass
    lower, upper = (np.clip(limit, -np.pi, np.pi) for limit in (robot.lower, robot.upper))
    free: list[np.ndarray] = []
    for q in rng.uniform(lower, upper, (TRIES, robot.dof)):
        alone = Problem(robot, Scene(), q, JointGoal(q))
        if verify(alone, JointPath(robot.joint_names, q[None])).valid:
            free.append(q)
        if len(free) == 2:
            return Problem(robot, Scene(), free[0], JointGoal(free[1]))
    raise InputError(f"of {TRIES} random configurations of {robot.name} fewer than 2 are free")


def uploaded_problem(content: bytes, name: str, robot: Robot) -> Problem:
    """The problem of a file that a browser sent.

    It may name robots that are known and the one on the page, and nothing else of this machine. Raises
    InputError, one line that begins with the name of the file.
    """
    if len(content) > LARGEST_UPLOAD:
        raise InputError(f"{name} has {len(content)} bytes; at most {LARGEST_UPLOAD} are read")
    try:
        text = content.decode("utf-8")
    except UnicodeDecodeError:
        raise InputError(f"{name} is not a text in UTF-8") from None
    data = parse_json(text, name) if name.lower().endswith(".json") else parse_yaml(text, name)
    try:
        _check_contained(data, robot)
        return problem_from_record(data)
    except InputError as error:
        raise InputError(f"{name}: {str(error).removeprefix('problem: ')}") from None


def _check_contained(data: object, robot: Robot) -> None:
    """Raises InputError if the data of a problem file names files."""
    if not isinstance(data, dict):
        return  # refused by the reader of problems
    given, known = data.get("robot"), known_robots()
    if isinstance(given, str) and given not in known and given != robot.source:
        raise unknown_name("robot", given, known)
    if isinstance(data.get("scene"), str):
        raise InputError(f"scene is {shown(data['scene'])}; {_OPEN}")
    parts: list[object] = [data]
    while parts:
        part = parts.pop()
        if isinstance(part, dict):
            for field in ON_DISK:
                if field in part:
                    raise InputError(f"{field} is {shown(part[field])}; {_OPEN}")
            parts += part.values()
        elif isinstance(part, list):
            parts += part


_OPEN = "the page reads no other files: open such a problem by `robotdiffuse live PROBLEM`"


def problem_text(problem: Problem) -> bytes:
    """The problem as a file in YAML."""
    with TemporaryDirectory() as folder:
        file = Path(folder) / "problem.yaml"
        save_problem(problem, file)
        return file.read_bytes()


def replay_page(problem: Problem, result: PlanResult, candidates: tuple[JointPath, ...] = ()) -> bytes:
    """The motion of a solved result in its scene, as an HTML page that holds all that it needs."""
    motion = result.trajectory or result.path
    assert motion is not None
    robot, scene = problem.standing()
    with TemporaryDirectory() as folder:
        file = Path(folder) / "replay.html"
        write_replay(robot, scene, motion, file, result=result, candidates=candidates)
        return file.read_bytes()
