"""Problem files: one problem in YAML or JSON, many in JSON lines or a MotionBenchMaker folder."""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from numbers import Integral
from pathlib import Path

import yaml

from robotdiffuse.core.bounds import numbers
from robotdiffuse.core.errors import InputError, check_type, shown, unknown_name
from robotdiffuse.core.input_files import file_name, no_files, parse_json, parse_yaml, read_text, read_yaml
from robotdiffuse.core.output_files import write_atomically
from robotdiffuse.core.transforms import pose_entry
from robotdiffuse.perception.depth_view import DepthView
from robotdiffuse.perception.depth_view_files import read_views, view_entry
from robotdiffuse.problems.constraint_files import constraint_entry, read_constraints
from robotdiffuse.problems.goal_files import goal_entry, read_goal, read_waypoints
from robotdiffuse.problems.moveit import (
    MoveItRequest,
    holding_at,
    moveit_frames,
    moveit_model,
    moveit_request,
    moveit_scene,
    request_robot_notes,
    scene_robot_notes,
)
from robotdiffuse.problems.moving_obstacle_files import moving_entry, read_moving
from robotdiffuse.problems.problem import (
    OPTIMISTIC,
    JointGoal,
    PoseGoal,
    Problem,
    check_clearance,
    moved_goal,
)
from robotdiffuse.problems.robot_setup_files import (
    equipment_entries,
    equipped,
    payload_entry,
    read_payload,
    read_pose,
    rounded,
)
from robotdiffuse.robots import ROBOTS, load_robot
from robotdiffuse.robots.robot import MIMIC_SLACK, MOVING_KINDS, Robot
from robotdiffuse.scenes.files import check_fields, read_scene, scene_entries
from robotdiffuse.scenes.scene import Scene

FIELDS = ("robot", "scene", "start", "goal")
OPTIONAL = (
    *("locked", "base", "tool", "attached", "waypoints", "constraints", "clearance", "views", "unknown"),
    *("moving", "start_velocity", "blend", "payload"),
)


@dataclass(frozen=True, eq=False)
class ProblemEntry:
    """One of many problems: the problem, or what is wrong with it."""

    name: str
    problem: Problem | None
    error: str = ""

    def load(self) -> Problem:
        """The problem; InputError if it is not usable."""
        if self.problem is None:
            raise InputError(self.error)
        return self.problem


def load_problem(file: str | Path, index: int = 0, ignore_joints: bool = False) -> Problem:
    """The problem in a .yaml, .yml or .json file, or the one at `index` (from 0) in a .jsonl file.

    Files named in it are looked up from its folder. `scene` may name a MoveIt planning scene, and `request` a
    MoveIt motion plan request in place of start and goal. Raises InputError, one line that names the file
    and the field: unknown or missing fields and shapes, wrong kinds of values, all that `Problem` refuses.

    ignore_joints: joints of MoveIt files that the robot lacks are a note rather than an error.
    """
    file = file_name(file, "problem file")
    check_type("index", index, Integral, "a whole number from 0 on")
    if file.suffix.lower() not in WRITERS:
        raise unknown_name(f"problem file format of {file}:", file.suffix, WRITERS)
    text = read_text(file)
    if file.suffix.lower() == ".jsonl":
        lines = _lines(text)
        if not 0 <= index < len(lines):
            raise InputError(f"index is {index}; {file} holds {len(lines)} problems, counted from 0")
        number, line = lines[index]
        where = f"{file}, line {number}"
        return _problem(where, parse_json(line, where), file.parent, ignore_joints=ignore_joints)
    if index != 0:
        raise InputError(f"index is {index}; {file} holds one problem, and only .jsonl files hold more")
    data = parse_json(text, str(file)) if file.suffix.lower() == ".json" else parse_yaml(text, str(file))
    return _problem(str(file), data, file.parent, ignore_joints=ignore_joints)


def load_problems(file: str | Path, ignore_joints: bool = False) -> list[ProblemEntry]:
    """All problems of a .jsonl file, of a MotionBenchMaker folder, or the one of any other problem file.

    In a .jsonl file, each line is a problem as in `load_problem`, named after the file and its line; the
    first wrong line raises InputError with its number. For folders see `load_motion_bench_maker`;
    `ignore_joints` as in `load_problem`.
    """
    file = file_name(file, "problem file")
    if file.is_dir():
        return load_motion_bench_maker(file, ignore_joints=ignore_joints)
    if file.suffix.lower() != ".jsonl":
        return [ProblemEntry(file.stem, load_problem(file, ignore_joints=ignore_joints))]
    entries = []
    for number, line in _lines(read_text(file)):
        where = f"{file}, line {number}"
        problem = _problem(where, parse_json(line, where), file.parent, ignore_joints=ignore_joints)
        entries.append(ProblemEntry(f"{file.stem}:{number}", problem))
    return entries


def _lines(text: str) -> list[tuple[int, str]]:
    """The lines that are not blank, with their numbers from 1."""
    return [(i, line) for i, line in enumerate(text.split("\n"), start=1) if line.strip()]


def problem_record(
    problem: Problem, folder: str | Path | None = None, robot: str | None = None
) -> dict[str, object]:
    """The problem as the plain data of a problem file; numbers are kept exactly.

    `robot` is what stands for the robot: a bundled name or a path to its URDF; by default where it was read
    from. Files are named relative to `folder` if they are in it or below, otherwise by their full path.
    Raises InputError for a robot that could not be found again.
    """
    if robot is None:
        robot = problem.robot.source or problem.robot.name
        if problem.robot.source is None and robot not in ROBOTS:
            raise InputError(
                f"robot {shown(robot)} is neither bundled nor read from a file; give the path of its URDF as "
                f"robot"
            )
    folder = None if folder is None else Path(folder)
    scene, goal, views, T = problem.known_scene, problem.goal, problem.views, problem.T_world_base
    record: dict[str, object] = {"robot": robot, "locked": problem.robot.locked}
    if T is not None:
        scene, goal, views = scene.moved(T), moved_goal(goal, T), [view.moved(T) for view in views]
        record["base"] = rounded(pose_entry(T))
    as_given = rounded if T is not None else lambda data: data
    record |= equipment_entries(problem.robot, folder)
    record |= {
        "scene": as_given(scene_entries(scene, folder)),
        "start": problem.start.tolist(),
        "goal": as_given(goal_entry(goal)),
    }
    if problem.waypoints:
        way = problem.waypoints if T is None else [moved_goal(goal, T) for goal in problem.waypoints]
        record["waypoints"] = as_given([goal_entry(goal) for goal in way])
    if any(problem.blend):
        record["blend"] = list(problem.blend)
    if problem.constraints:
        kept = [one if T is None else one.moved(T) for one in problem.constraints]
        record["constraints"] = as_given([constraint_entry(one) for one in kept])
    if problem.moving:
        moving = problem.moving if T is None else [one.moved(T) for one in problem.moving]
        record["moving"] = as_given([moving_entry(one, folder) for one in moving])
    if problem.start_velocity is not None:
        record["start_velocity"] = problem.start_velocity.tolist()
    if problem.payload is not None:
        record["payload"] = payload_entry(problem.payload)
    if problem.clearance is not None:
        record["clearance"] = problem.clearance
    if views:
        record["views"] = as_given([view_entry(view, folder) for view in views])
    if problem.unknown != OPTIMISTIC:
        record["unknown"] = problem.unknown
    return record


def problem_from_record(record: object, robots: Mapping[str, Robot] | None = None) -> Problem:
    """The problem of `problem_record`; InputError as in `load_problem`.

    With `robots`, by their names, it may have no other robot, and no file that it names is read: for records
    of people who may not read files here.
    """
    if robots is None:
        return _problem("problem", record, Path())
    with no_files():
        return _problem("problem", record, Path(), robots)


def save_problem(problem: Problem, file: str | Path, robot: str | None = None) -> None:
    """Write a problem to .yaml, .yml or .json (atomically), or append it as a line to .jsonl.

    `robot` as in `problem_record`. Raises InputError for a place that cannot be written to.
    """
    file = file_name(file, "problem file")
    ending = file.suffix.lower()
    if ending not in WRITERS:
        raise unknown_name(f"problem file format of {file}:", file.suffix, WRITERS)
    text = WRITERS[ending](problem_record(problem, file.parent, robot))
    if ending != ".jsonl":
        write_atomically(file, text)
        return
    try:
        with file.open("a", encoding="utf-8") as stream:
            stream.write(text + "\n")
    except OSError as error:
        raise InputError(f"{file} cannot be written: {error.strerror}") from None


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
    """The problems of a folder with pairs of files sceneNNNN.yaml and requestNNNN.yaml, in their order.

    The robot is the bundled one named by the scenes' robot_model_name, unless one is given. Its joints that
    are not planned (fingers) are held at the values of the request's start state. A problem that is wrong,
    e.g. its goal is out of limits or it has joints that the robot lacks (unless `ignore_joints`), becomes an
    entry with an error. Raises InputError if there is no pair.
    """
    folder = Path(folder)
    scenes = sorted(folder.glob("scene*.yaml"))
    if not scenes:
        raise InputError(
            f"{folder} has no files scene*.yaml; it must be a folder as MotionBenchMaker writes it"
        )
    entries = []
    for scene_file in scenes:
        name = f"{folder.resolve().name}/{scene_file.stem.removeprefix('scene')}"
        try:
            problem = _moveit_problem(scene_file, robot, ignore_joints)
        except InputError as error:
            entries.append(ProblemEntry(name, None, str(error)))
        else:
            entries.append(ProblemEntry(name, problem))
    return entries


def _moveit_problem(scene_file: Path, robot: Robot | None, ignore_joints: bool) -> Problem:
    request_file = scene_file.with_name(scene_file.name.replace("scene", "request", 1))
    where = scene_file
    try:
        data = read_yaml(scene_file)
        if robot is None:
            robot_name = data.get("robot_model_name") if isinstance(data, dict) else None
            robot = _robot(robot_name, {}, scene_file.parent)
        notes = scene_robot_notes(data, robot, ignore_joints)
        frames = moveit_frames(data, robot)
        scene = moveit_scene(data, frames, scene_file.parent)
        where = request_file
        request = moveit_request(read_yaml(request_file), frames, scene_file.parent)
        notes += request_robot_notes(request, robot, moveit_model(data), ignore_joints)
        return _requested(robot, scene, replace(request, notes=(*request.notes, *notes)))
    except InputError as error:
        prefix = "" if str(error).startswith(str(where)) else f"{where}: "
        raise InputError(f"{prefix}{error}") from None


def _requested(
    robot: Robot,
    scene: Scene,
    request: MoveItRequest,
    clearance: float | None = None,
    views: tuple[DepthView, ...] = (),
    unknown: str = OPTIMISTIC,
) -> Problem:
    held = {j.name for j in robot.joints if j.kind in MOVING_KINDS and j.mimic is None}
    held -= {*robot.joint_names}
    locked = {name: value for name, value in request.start.items() if name in held}
    robot = robot.with_locked(locked)
    notes = (*request.notes, *_follower_notes(robot, request.start))

    def values(where: str, positions: dict[str, float]) -> list[float]:
        missing = [name for name in robot.joint_names if name not in positions]
        if missing:
            raise InputError(f"{where} has no value for {', '.join(missing)}")
        return [positions[name] for name in robot.joint_names]

    start = values("start_state", request.start)
    for held in request.attached:
        robot = holding_at(robot, held, start)
    if request.pose_goal is not None:
        goal = PoseGoal(*request.pose_goal)
        return Problem(robot, scene, start, goal, notes, clearance, views, unknown)
    goals = [values(f"goal_constraints[{i}]", goal) for i, goal in enumerate(request.joint_goals)]
    return Problem(robot, scene, start, JointGoal(goals), notes, clearance, views, unknown)


def _follower_notes(robot: Robot, start: dict[str, float]) -> tuple[str, ...]:
    """Notes on mimic joints that a start state does not put where the joints that they follow do."""
    mimics = {joint.name: joint.mimic.joint for joint in robot.joints if joint.mimic is not None}
    return tuple(
        f"start_state: {name} is {start[name]:g}; planned at {robot.locked[name]:g}, where {master} puts it"
        for name, master in mimics.items()
        if name in start and name in robot.locked and abs(robot.locked[name] - start[name]) > MIMIC_SLACK
    )


def _problem(
    where: str,
    data: object,
    folder: Path,
    robots: Mapping[str, Robot] | None = None,
    ignore_joints: bool = False,
) -> Problem:
    try:
        requested = isinstance(data, dict) and "request" in data
        values = check_fields(
            "problem", data, ("robot", "scene", "request") if requested else FIELDS, OPTIONAL
        )
        robot = _robot(values["robot"], values.get("locked", {}), folder, robots)
        robot, notes = equipped(robot, values.get("tool"), values.get("attached"), folder)
        base = read_pose("base", values["base"]) if "base" in values else None
        if base is not None and (requested or isinstance(values["scene"], str)):
            raise InputError(
                "base is for scenes in the file itself: MoveIt scenes say where their robot stands"
            )
        clearance = check_clearance("clearance", values["clearance"]) if "clearance" in values else None
        frames, model = moveit_frames({}, robot), ""
        if isinstance(values["scene"], str):
            file = folder / values["scene"]
            content = read_yaml(file)
            notes += scene_robot_notes(content, robot, ignore_joints)
            frames, model = moveit_frames(content, robot), moveit_model(content)
            scene = moveit_scene(content, frames, file.parent)
        else:
            scene, more = read_scene(values["scene"], folder)
            notes += more
        views, more = read_views(values.get("views", []), folder)
        unknown = values.get("unknown", OPTIMISTIC)
        for name in ("waypoints", "blend", "moving", "start_velocity"):
            if requested and name in values:
                raise InputError(f"{name} is for problems with start and goal in the file, not a request")
        kept = read_constraints(values.get("constraints", []))
        payload = read_payload(values["payload"]) if "payload" in values else None
        if requested:
            request = moveit_request(read_yaml(folder / str(values["request"])), frames, folder)
            notes += request_robot_notes(request, robot, model, ignore_joints)
            request = replace(request, notes=(*request.notes, *notes, *more))
            asked = _requested(robot, scene, request, clearance, views, unknown)
            return replace(asked, constraints=kept, payload=payload) if kept or payload else asked
        goal, notes = read_goal("goal", values["goal"], scene), (*notes, *more)
        asked = robot, scene, values["start"], goal, notes, clearance, views, unknown
        more = {
            "waypoints": read_waypoints(values.get("waypoints", []), scene),
            "constraints": kept,
            "moving": read_moving(values.get("moving", []), folder),
            "start_velocity": values.get("start_velocity"),
            "blend": values.get("blend", ()),
            "payload": payload,
        }
        if base is None:
            return Problem(*asked, **more)
        return Problem.in_world(base, *asked, **more)
    except InputError as error:
        raise InputError(f"{where}: {error}") from None


def _robot(name: object, locked: object, folder: Path, robots: Mapping[str, Robot] | None = None) -> Robot:
    if robots is not None and (not isinstance(name, str) or name not in robots):
        raise unknown_name("robot", name, robots)
    if not isinstance(name, str) or not name:
        raise InputError(
            f"robot is {shown(name)}; it must be a bundled name ({', '.join(ROBOTS)}) or a URDF file"
        )
    if name not in ROBOTS and (name.endswith((".urdf", ".xacro", ".xml")) or "/" in name):
        name = str((folder / name).absolute())
    if not isinstance(locked, dict):
        raise InputError(f"locked is {shown(locked)}; it must map names of joints to values")
    values = {}
    for joint, value in locked.items():
        array = numbers(value)
        if not isinstance(joint, str) or array is None or array.ndim != 0:
            raise InputError(f"locked: {shown(joint)} is {shown(value)}; it must be a number")
        values[joint] = float(array)
    return load_robot(name, locked=values) if robots is None else robots[name].with_locked(values)
