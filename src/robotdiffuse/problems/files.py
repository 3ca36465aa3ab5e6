"""Reads and writes problem files: YAML or JSON with one problem, JSON lines with many.

Also reads folders of MotionBenchMaker, which hold MoveIt files.

Held-out problems for evaluation are numbered random problems of each family, none of which is in a data set.
A problem is trivial if the straight line from the start to a goal configuration passes the validator. It is
hard if it is not trivial and a search solves it. `CaseFile` keeps them in JSON lines of its own, which also
store whether each problem is trivial, and the length of its shortest known path.
"""

import itertools
import json
from collections.abc import Callable, Collection, Mapping
from dataclasses import replace
from numbers import Integral
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from robotdiffuse.core.errors import (
    InputError,
    check_name,
    check_type,
    counted,
    filled_text,
    located,
    repeated,
    shown,
)
from robotdiffuse.core.files import (
    JsonLines,
    JsonObject,
    append_line,
    file_name,
    known_ending,
    no_files,
    parse_json,
    parse_yaml,
    read_text,
    read_yaml,
    write_atomically,
)
from robotdiffuse.core.settings import Number, converted
from robotdiffuse.core.transforms import pose_entry
from robotdiffuse.core.types import Configuration, frozen_dataclass
from robotdiffuse.core.types import Path as Waypoints
from robotdiffuse.problems.families import FAMILIES, load_family
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
    at_state,
    joint_notes,
    moveit_frames,
    moveit_model,
    moveit_request,
    moveit_scene,
    scene_robot_notes,
    scene_state,
)
from robotdiffuse.problems.problem import Goal, JointGoal, PoseGoal, Problem, moved
from robotdiffuse.robots import FILE_ENDINGS, ROBOTS, load_robot
from robotdiffuse.robots.robot import MIMIC_SLACK, Robot, robot_fingerprint
from robotdiffuse.scenes.files import check_fields, read_scene
from robotdiffuse.scenes.scene import Scene


@frozen_dataclass
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
        InputError: For a file that cannot be read and a wrong index. Also for unknown or missing fields and
            shapes, values of the wrong type, and what `rd.Problem` does not accept; the message is then a
            line that names the file and the field.

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

    In a .jsonl file, each line is a problem as in `load_problem`, or one that `robotdiffuse bench` wrote. It
    is named after the file and its line number; the first wrong line raises InputError with its number. For
    folders see `load_motion_bench_maker`; `ignore_joints` as in `load_problem`.
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
    value = parse_json(line, location)
    if isinstance(value, dict) and {"name", "family", "problem"} <= value.keys():  # as a bench writes it
        value = value["problem"]
    return _problem(location, value, file.parent, ignore_joints=ignore_joints)


def _lines(text: str) -> list[tuple[int, str]]:
    """The lines that are not blank, with their numbers, counted from 1."""
    return [(i, line) for i, line in enumerate(text.split("\n"), start=1) if line.strip()]


def problem_record(
    problem: Problem, folder: str | Path | None = None, robot: str | None = None
) -> dict[str, object]:
    """Convert a problem to JSON values.

    Numbers are kept exactly, except for two kinds, which are rounded to 15 decimals: the poses of base and
    tool; and, if the problem has a base, all fields in the frame of the world.

    Args:
        problem: The problem.
        folder: Files of shapes and views in it or below it are named relative to it, others by their full
            path.
        robot: The name of the robot, or the path of its URDF, to write; None: the name or path from which
            the robot was loaded.

    Returns:
        The content of a problem file.

    Raises:
        InputError: Without `robot`: for a robot that is neither bundled nor loaded from a file, or that was
            changed since.
    """
    if robot is None:
        robot = problem.robot.source or problem.robot.name
        if problem.robot.source is None and robot not in ROBOTS:
            raise InputError(
                f"robot {shown(robot)} is neither bundled nor read from a file; give the path of its URDF as "
                "robot"
            )
        arm = problem.robot.arm
        loaded = load_robot(robot, dict(arm.locked))
        if loaded is not arm and (
            robot_fingerprint(loaded) != robot_fingerprint(arm) or (loaded.effort != arm.effort).any()
        ):
            raise InputError(
                f"robot was changed after it was read from {shown(robot)}; give the file of the changed robot"
            )
    folder = None if folder is None else Path(folder)
    T = problem.T_world_base
    scene = problem.known_scene
    record: dict[str, object] = {"robot": str(robot), "locked": dict(problem.robot.locked)}
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

    `robot` as in `problem_record`. Raises InputError as `problem_record` does, for another ending, and if the
    file cannot be written.
    """
    file = file_name(file, "problem file")
    ending = known_ending(file, "problem file", WRITERS)
    text = WRITERS[ending](problem_record(problem, file.parent, robot))
    (append_line if ending == ".jsonl" else write_atomically)(file, text)


class _Dumper(yaml.CSafeDumper):
    """Also writes NumPy's texts, such as names from an array."""


_Dumper.add_multi_representer(str, lambda dumper, text: dumper.represent_str(str(text)))


def _yaml(data: dict[str, object]) -> str:
    return yaml.dump(data, Dumper=_Dumper, sort_keys=False, default_flow_style=None, width=110)


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
    robot: Robot,
    scene: Scene,
    request: MoveItRequest,
    notes: list[str],
    stated: Collection[str],
    options: dict[str, Any],
) -> Problem:
    """The problem of a MoveIt request. Joints that are not planned are locked at its start state, except
    those that the problem states as `locked` (`stated`)."""
    robot = at_state(robot, request.start, stated)
    notes = [*request.notes, *notes]
    for joint in robot.joints:
        locked = robot.locked.get(joint.name)
        if locked is None:
            continue
        start_value = request.start.get(joint.name, locked)
        if abs(locked - start_value) > MIMIC_SLACK:
            why = f"mimics {joint.mimic.joint} and is" if joint.mimic else "is"
            notes.append(f"start_state: {joint.name} is {start_value:g}, but it {why} held at {locked:g}")

    for place, values in request.joint_goals.items():
        for name, value in values.items():
            locked_value = robot.locked.get(name, value)
            if abs(locked_value - value) > MIMIC_SLACK:
                notes.append(f"{place}: {name} is {value:g}, but it is held at {locked_value:g}")
    start = robot.planned_values("start_state", request.start)
    for attached in request.attached:
        robot = attached.held_by(robot, start)
    if request.pose_goal is not None:
        goal: Goal = PoseGoal(*request.pose_goal)
    else:
        goals = request.joint_goals.items()
        goal = JointGoal([robot.planned_values(place, values) for place, values in goals])
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
        stated = values.get("locked", {})
        robot = _robot(values["robot"], stated, folder, robots)
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
            robot = at_state(robot, scene_state(content), stated)
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
                scene = moveit_scene(content, frames, Path(scene_place).parent, names, contacts.items())
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
                states = {"start_state.joint_state": request.start, **request.joint_goals}
                for place, state in states.items():
                    notes += joint_notes(place, state, robot, moveit_model(content), ignore_joints)
                # as in MoveIt, joints that the request leaves out start where the scene has them
                mimics = {joint.name for joint in robot.joints if joint.mimic is not None}
                current = {name: value for name, value in scene_state(content).items() if name not in mimics}
                request = replace(request, start=current | request.start)
                return _requested(robot, scene, request, notes, stated, options)
        if base is None:
            return Problem(robot, scene, notes=tuple(notes), **options)
        return Problem.in_world(base, robot, scene, notes=tuple(notes), **options)


def _robot(name: object, locked: object, folder: Path, robots: Mapping[str, Robot] | None) -> Robot:
    if robots is not None:
        check_name("robot", name, robots)
    wanted = f"a robot's file, or the name of an added robot or of a bundled one: {', '.join(ROBOTS)}"
    name = filled_text("robot", name, wanted)
    if robots is None and name not in ROBOTS and (name.lower().endswith(FILE_ENDINGS) or "/" in name):
        name = str((folder / name).absolute())
    values = converted("locked", dict[str, Number], locked)
    return load_robot(name, locked=values) if robots is None else robots[name].with_locked(values)


SEED = 20261121
"""Seed of the held-out problems; data sets use other seed sequences."""

Validator = Callable[[Problem, Waypoints], bool]
"""A function that says whether a path solves a problem."""
Search = Callable[[Problem], float | None]
"""A function that searches for paths of a problem and returns the length of the shortest path [rad], or None
if it finds no path."""
Progress = Callable[[str], None]
"""A function that receives progress messages."""
REPORT_EVERY = 20
"""Number of problems between two progress messages."""


def goal_of(problem: Problem) -> Configuration:
    """The first goal configuration of a problem whose goal is a JointGoal."""
    assert isinstance(problem.goal, JointGoal)
    return problem.goal.positions[0]


@frozen_dataclass
class Case:
    """A problem of an evaluation, with what is known about its solutions."""

    name: str
    """Unique name in the problem set; rop/17 is number 17 of the family rop."""
    family: str
    """Group in plots and tables: the random family, or the folder or file of the problem."""
    problem: Problem
    trivial: bool
    """Whether the straight line to a goal configuration passes the validator."""
    reference: float | None = None
    """Length of the shortest known path [rad]: of the straight line if trivial, else of a search's path; None
    if no search ran, or if it found no path."""
    problem_set: str = ""
    """Name of the problem set: the name of a family, or of a file or folder without its ending."""

    @property
    def key(self) -> tuple[str, str]:
        """Unique among several problem sets."""
        return self.problem_set, self.name

    @property
    def hard(self) -> bool:
        """Whether the problem is not trivial and a search solves it."""
        return not self.trivial and self.reference is not None


def held_out_problem(family: str, number: int) -> Problem:
    """Problem `number` of a family, for the Panda. Some problems are trivial, others unsolvable."""
    FAMILIES.entry(family)
    index = list(FAMILIES).index(family)
    # the seeds of the published problems
    rng = np.random.default_rng([SEED, number] if index == 0 else [SEED, 10 + index, number])
    if index > 1:
        rng.random()  # the code that made the published problems drew one number more
    robot = load_robot("panda")
    return load_family(family).draw(robot, rng).problem(robot)


def line_length(problem: Problem, validator: Validator) -> float | None:
    """Length of the shortest straight line, from the start to a goal configuration, that passes the validator
    [rad]; None if no such line does."""
    robot = problem.robot
    goals = problem.goal.positions if isinstance(problem.goal, JointGoal) else np.zeros((0, robot.dof))
    goals = goals - robot.whole_turns(goals - problem.start)
    lines = [Waypoints(problem.robot.joint_names, np.stack([problem.start, goal])) for goal in goals]
    return min((line.length for line in lines if validator(problem, line)), default=None)


ROW_FIELDS = {"name", "family", "trivial", "searched", "reference", "problem"}
"""Fields of a line of a file: the fields of a case, whether a search for the reference length has run, and
the record of the problem."""


class CaseFile:
    """Cases by name, in the order of their addition, stored in a file or, if no file is given, in memory."""

    def __init__(self, file: Path | None) -> None:
        """Reads the file. Raises InputError, which names file and line, for a line that does not hold the
        fields of a row. The problems are checked when cases are made of them."""
        self._lines = JsonLines(file)
        self._rows = dict[str, JsonObject]()
        for number, row in enumerate(self._lines.rows, start=1):
            if row.keys() != ROW_FIELDS:
                raise InputError(
                    f"{file}, line {number} has {', '.join(row)} instead of {', '.join(sorted(ROW_FIELDS))}; "
                    "remove the file to generate its problems again"
                )
            self._rows[row["name"]] = row  # a later line on the same problem adds the search's result

    def __len__(self) -> int:
        return len(self._rows)

    def cases(self, hard: bool = False) -> list[Case]:
        """All cases, or only the cases that are known to be hard."""
        return [_case(row) for row in self._rows.values() if not hard or _is_hard(row)]

    def fill(self, cases: list[Case]) -> None:
        """Replaces all cases atomically. Raises InputError if two have the same name."""
        twice = repeated(case.name for case in cases)
        if twice:
            raise InputError(f"two problems are called {twice[0]}; rename one of their files")
        self._lines.replace([_row(case) for case in cases])
        self._rows = {row["name"]: row for row in self._lines.rows}

    def held_out(
        self,
        family: str,
        count: int,
        validator: Validator,
        search: Search | None = None,
        report: Progress = lambda text: None,
    ) -> list[Case]:
        """The first `count` held-out problems of a family; with a search, the first `count` hard problems.

        Problems that are not in the file yet are generated and added; with a search, problems that are
        neither trivial nor searched yet are searched.
        """
        case_rows = list[JsonObject]()
        numbers = itertools.count()
        while len(case_rows) < count:
            number = next(numbers)
            row = self._rows.get(f"{family}/{number}")
            if row is None:
                problem = held_out_problem(family, number)
                line = line_length(problem, validator)
                row = self._add(_row(Case(f"{family}/{number}", family, problem, line is not None, line)))
            if search is not None and not (row["trivial"] or row["searched"]):
                row = self._add(row | {"searched": True, "reference": search(_case(row).problem)})
            if search is None or _is_hard(row):
                case_rows.append(row)
                if len(case_rows) % REPORT_EVERY == 0 or len(case_rows) == count:
                    report(f"problems: {len(case_rows)} of {count} of {family}")
        return [_case(row) for row in case_rows]

    def _add(self, row: JsonObject) -> JsonObject:
        self._lines.append(row)
        self._rows[row["name"]] = row
        return row


def _is_hard(row: JsonObject) -> bool:
    return not row["trivial"] and row["reference"] is not None


def _case(row: JsonObject) -> Case:
    with located(f"the stored problem {shown(row['name'])}"):
        problem = problem_from_record(row["problem"])
    return Case(row["name"], row["family"], problem, row["trivial"], row["reference"])


def _row(case: Case) -> JsonObject:
    return {
        "name": case.name,
        "family": case.family,
        "trivial": case.trivial,
        "searched": False,
        "reference": case.reference,
        "problem": problem_record(case.problem),
    }
