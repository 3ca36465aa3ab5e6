"""Reads and writes problem files: YAML or JSON with one problem, JSON lines with many.

Also reads folders of MotionBenchMaker, which hold MoveIt files.
"""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from numbers import Integral
from pathlib import Path
from typing import Any

import yaml

from robotdiffuse.core.errors import InputError, check_name, check_type, counted, located, shown
from robotdiffuse.core.input_files import (
    file_name,
    known_ending,
    no_files,
    parse_json,
    parse_yaml,
    read_text,
    read_yaml,
)
from robotdiffuse.core.output_files import append_line, write_atomically
from robotdiffuse.core.settings import Number, converted
from robotdiffuse.core.transforms import pose_entry
from robotdiffuse.problems.fields import (
    FIELDS,
    SETUP,
    Setting,
    equipment_entries,
    equipped,
    read_pose,
    rounded,
)
from robotdiffuse.problems.moveit import (
    MoveItRequest,
    moveit_frames,
    moveit_model,
    moveit_request,
    moveit_scene,
    scene_robot_notes,
)
from robotdiffuse.problems.problem import Goal, JointGoal, PoseGoal, Problem, moved
from robotdiffuse.robots import FILE_ENDINGS, ROBOTS, load_robot
from robotdiffuse.robots.robot import MIMIC_SLACK, MOVING_KINDS, Robot
from robotdiffuse.scenes.files import check_fields, read_scene
from robotdiffuse.scenes.scene import Scene


@dataclass(frozen=True, eq=False)
class ProblemEntry:
    """One of many problems: the problem, or the reason why it cannot be used."""

    name: str
    problem: Problem | None
    error: str = ""

    def load(self) -> Problem:
        """The problem. Raises InputError with the reason if it cannot be used."""
        if self.problem is None:
            raise InputError(self.error)
        return self.problem


def load_problem(file: str | Path, index: int = 0, ignore_joints: bool = False) -> Problem:
    """Read a problem file.

    Args:
        file: A .yaml, .yml, .json or .jsonl file. File names in it are relative to its folder. `scene` may
            name a MoveIt planning scene, and `request` a motion plan request, which replaces start and goal.
        index: The problem of a .jsonl file, from 0.
        ignore_joints: Whether joints of MoveIt files that the robot lacks are ignored, with a note, instead
            of refused.

    Returns:
        The problem, with its robot loaded.

    Raises:
        InputError: For a file that cannot be read and a wrong index; and, with one line that names the file
            and the field, for unknown or missing fields and shapes, values of the wrong type, and what
            `rd.Problem` does not accept.

    Examples:
        >>> rd.load_problem("examples/ball.yaml").scene
        Scene(1 shape: ball)
    """
    file = file_name(file, "problem file")
    check_type("index", index, Integral, "a whole number from 0 on")
    if file.is_dir():
        raise InputError(f"{file} is a folder; give a file in it, or the folder to `robotdiffuse bench run`")
    known_ending(file, "problem file", WRITERS)
    text = read_text(file)
    if file.suffix.lower() == ".jsonl":
        lines = _lines(text)
        if not 0 <= index < len(lines):
            raise InputError(
                f"index is {index}; {file} holds {counted(len(lines), 'problem')}, counted from 0"
            )
        return _problem_of_line(file, *lines[index], ignore_joints)
    if index != 0:
        raise InputError(f"index is {index}; {file} holds one problem, and only .jsonl files hold more")
    data = parse_json(text, str(file)) if file.suffix.lower() == ".json" else parse_yaml(text, str(file))
    return _problem(str(file), data, file.parent, ignore_joints=ignore_joints)


def load_problems(file: str | Path, ignore_joints: bool = False) -> list[ProblemEntry]:
    """All problems of a .jsonl file or a MotionBenchMaker folder, or the one problem of another file.

    In a .jsonl file, each line is a problem as in `load_problem`, named after the file and its line number;
    the first wrong line raises InputError with its number. For folders see `load_motion_bench_maker`;
    `ignore_joints` as in `load_problem`.
    """
    file = file_name(file, "problem file")
    if file.is_dir():
        return load_motion_bench_maker(file, ignore_joints=ignore_joints)
    if file.suffix.lower() != ".jsonl":
        return [ProblemEntry(file.stem, load_problem(file, ignore_joints=ignore_joints))]
    return [
        ProblemEntry(f"{file.stem}:{number}", _problem_of_line(file, number, line, ignore_joints))
        for number, line in _lines(read_text(file))
    ]


def _problem_of_line(file: Path, number: int, line: str, ignore_joints: bool) -> Problem:
    location = f"{file}, line {number}"
    return _problem(location, parse_json(line, location), file.parent, ignore_joints=ignore_joints)


def _lines(text: str) -> list[tuple[int, str]]:
    """The lines that are not blank, with their numbers, counted from 1."""
    return [(i, line) for i, line in enumerate(text.split("\n"), start=1) if line.strip()]


def problem_record(
    problem: Problem, folder: str | Path | None = None, robot: str | None = None
) -> dict[str, object]:
    """Convert a problem to JSON values. Numbers are kept exactly, but transformed poses have 12 decimals.

    Args:
        problem: The problem.
        folder: Files in it or below it are named relative to it, others by their full path.
        robot: The name of the robot, or the path of its URDF, to write; None: the name or path from which
            the robot was loaded.

    Returns:
        The content of a problem file.

    Raises:
        InputError: For a robot that is neither bundled nor loaded from a file.
    """
    if robot is None:
        robot = problem.robot.source or problem.robot.name
        if problem.robot.source is None and robot not in ROBOTS:
            raise InputError(
                f"robot {shown(robot)} is neither bundled nor read from a file; give the path of its URDF as "
                "robot"
            )
    folder = None if folder is None else Path(folder)
    T = problem.T_world_base
    scene = problem.known_scene
    record: dict[str, object] = {"robot": robot, "locked": problem.robot.locked}
    if T is not None:
        record["base"] = rounded(pose_entry(T))
    record |= equipment_entries(problem.robot, folder)
    for name, field in FIELDS.items():
        value = scene if name in ("scene", "allowed_contacts") else getattr(problem, name)
        if value is None:
            continue
        if field.in_world and T is not None:
            entry = rounded(field.write(moved(value, T), folder))
        else:
            entry = field.write(value, folder)
        if name == "scene" or entry not in (None, [], {}):
            record[name] = entry
    return record


def problem_from_record(record: object, robots: Mapping[str, Robot] | None = None) -> Problem:
    """The problem of a record of `problem_record`. Raises InputError as `load_problem` does.

    robots: robots by name, the only ones that the record may name. If they are given, the record may not name
    any file: this is for records from people who may not read files on this machine.
    """
    if robots is None:
        return _problem("problem", record, Path())
    with no_files():
        return _problem("problem", record, Path(), robots)


def save_problem(problem: Problem, file: str | Path, robot: str | None = None) -> None:
    """Write a problem to .yaml, .yml or .json (atomically), or append it as a line to .jsonl.

    `robot` as in `problem_record`. Raises InputError as `problem_record` does, and if the file cannot be
    written.
    """
    file = file_name(file, "problem file")
    ending = known_ending(file, "problem file", WRITERS)
    text = WRITERS[ending](problem_record(problem, file.parent, robot))
    write = append_line if ending == ".jsonl" else write_atomically
    write(file, text)


def _yaml(data: dict[str, object]) -> str:
    return yaml.dump(data, Dumper=yaml.CSafeDumper, sort_keys=False, default_flow_style=None, width=110)


WRITERS: dict[str, Callable[[dict[str, object]], str]] = {
    ".yaml": _yaml,
    ".yml": _yaml,
    ".json": lambda data: json.dumps(data, indent=1),
    ".jsonl": json.dumps,
}


def load_motion_bench_maker(
    folder: str | Path, robot: Robot | None = None, ignore_joints: bool = False
) -> list[ProblemEntry]:
    """The problems of a folder with pairs of files sceneNNNN.yaml and requestNNNN.yaml, in order.

    robot: None stands for the bundled or added robot that the scene's robot_model_name names. Joints that are
    not planned (fingers) are locked at the values of the request's start state. An invalid problem becomes an
    entry with an error, e.g. if its goal is out of limits or, unless `ignore_joints`, if it has joints that
    the robot lacks. Raises InputError if the folder holds no scene.
    """
    folder = Path(folder)
    scenes = sorted(folder.glob("scene*.yaml"))
    if not scenes:
        raise InputError(
            f"{folder} has no files scene*.yaml; it must be a folder written by MotionBenchMaker"
        )
    entries = []
    for scene_file in scenes:
        name = f"{folder.resolve().name}/{scene_file.stem.removeprefix('scene')}"
        try:
            record = {
                "robot": robot.name if robot else moveit_model(read_yaml(scene_file)),
                "scene": scene_file.name,
                "request": scene_file.name.replace("scene", "request", 1),
            }
            robots = {robot.name: robot} if robot else None
            problem = _problem(str(scene_file), record, folder, robots, ignore_joints)
        except InputError as error:
            entries.append(ProblemEntry(name, None, str(error)))
        else:
            entries.append(ProblemEntry(name, problem))
    return entries


def _requested(
    robot: Robot, scene: Scene, request: MoveItRequest, notes: list[str], options: dict[str, Any]
) -> Problem:
    """The problem of a MoveIt request. Joints that are not planned are locked at its start state."""
    unplanned = {j.name for j in robot.joints if j.kind in MOVING_KINDS and j.mimic is None}
    unplanned -= {*robot.joint_names}
    robot = robot.with_locked({name: value for name, value in request.start.items() if name in unplanned})
    notes = [*request.notes, *notes]
    for joint in robot.joints:
        locked = robot.locked.get(joint.name)
        if joint.mimic is None or locked is None:
            continue
        start_value = request.start.get(joint.name, locked)
        if abs(locked - start_value) > MIMIC_SLACK:
            implied = f"it mimics {joint.mimic.joint}: held at {locked:g}"
            notes.append(f"start_state: {joint.name} is {start_value:g}, but {implied}")

    start = robot.planned_values("start_state", request.start)
    for attached in request.attached:
        robot = attached.held_by(robot, start)
    if request.pose_goal is not None:
        goal: Goal = PoseGoal(*request.pose_goal)
    else:
        goals = enumerate(request.joint_goals)
        goal = JointGoal([robot.planned_values(f"goal_constraints[{i}]", values) for i, values in goals])
    return Problem(robot, scene, start, goal, notes=tuple(notes), **options)


def _problem(
    where: str,
    data: object,
    folder: Path,
    robots: Mapping[str, Robot] | None = None,
    ignore_joints: bool = False,
) -> Problem:
    with located(where):
        if isinstance(data, dict) and {"status", "planner"} <= data.keys():
            raise InputError(
                "it is a result, not a problem; `robotdiffuse view` draws it and `robotdiffuse verify` "
                "validates it"
            )
        requested = isinstance(data, dict) and "request" in data
        required = ("robot", "scene", *(("request",) if requested else ("start", "goal")))
        values = check_fields("problem", data, required, SETUP | FIELDS)
        robot = _robot(values["robot"], values.get("locked", {}), folder, robots)
        notes = list[str]()
        robot = equipped(robot, values, folder, notes)
        base = read_pose("base", values["base"]) if "base" in values else None
        from_moveit = isinstance(values["scene"], str)
        if base is not None and (requested or from_moveit):
            raise InputError(
                "base cannot be combined with MoveIt files, which contain the pose of their robot's base"
            )
        scene_place = folder / values["scene"] if from_moveit else where
        request_place = folder / str(values["request"]) if requested else where
        with located(scene_place):
            content = read_yaml(scene_place) if from_moveit else {}
            notes += scene_robot_notes(content, robot, ignore_joints)
            frames = moveit_frames(content, robot)
        request = None
        names = robot.link_names
        if requested:
            for name, field in FIELDS.items():
                if name in values and not field.with_request:
                    raise InputError(f"{name} cannot be combined with request")
            with located(request_place):
                request = moveit_request(read_yaml(request_place), frames, folder)
            names += tuple(attached.name for attached in request.attached)
        contacts = values.get("allowed_contacts", {})
        check_type("allowed_contacts", contacts, dict, "a mapping of obstacles to lists of links, or to all")
        if from_moveit:
            with located(scene_place):
                scene = moveit_scene(content, frames, Path(scene_place).parent, names, contacts)
        else:
            scene, scene_notes = read_scene(values["scene"], folder, contacts)
            notes += scene_notes
        setting = Setting(robot, scene, folder, notes)
        options = {
            name: field.read(values[name], setting)
            for name, field in FIELDS.items()
            if name in values and name not in ("scene", "allowed_contacts")
        }
        if request is not None:
            with located(request_place):
                notes += request.robot_notes(robot, moveit_model(content), ignore_joints)
                return _requested(robot, scene, request, notes, options)
        if base is None:
            return Problem(robot, scene, notes=tuple(notes), **options)
        return Problem.in_world(base, robot, scene, notes=tuple(notes), **options)


def _robot(name: object, locked: object, folder: Path, robots: Mapping[str, Robot] | None = None) -> Robot:
    if robots is not None:
        check_name("robot", name, robots)
    if not isinstance(name, str) or not name:
        raise InputError(
            f"robot is {shown(name)}; it must be a name ({', '.join(ROBOTS)}, or added) or a robot's file"
        )
    if name not in ROBOTS and (name.endswith(FILE_ENDINGS) or "/" in name):
        name = str((folder / name).absolute())
    values = converted("locked", dict[str, Number], locked)
    return load_robot(name, locked=values) if robots is None else robots[name].with_locked(values)
