"""The commands on results: `robotdiffuse verify`, `certificate check`, `export` and `publish`."""

import math
from pathlib import Path

from robotdiffuse.cli.arguments import Namespace
from robotdiffuse.cli.console import clearances
from robotdiffuse.core.errors import InputError, counted, joined, located
from robotdiffuse.core.files import check_output
from robotdiffuse.core.types import NO_PROBLEM, PlanResult, Trajectory, load_result
from robotdiffuse.core.types import Path as Waypoints
from robotdiffuse.interop import check_export, read_motion, write_motion
from robotdiffuse.interop.recorded_motion import motion_of_robot, problem_of_motion, publish
from robotdiffuse.problems.files import load_problem, problem_from_record
from robotdiffuse.problems.moveit import read_moveit_scene
from robotdiffuse.problems.problem import Problem
from robotdiffuse.robots import DATA, ROBOTS, load_robot
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene import contact_notes
from robotdiffuse.validation.validator import verify, violations


def run_verify(arguments: Namespace) -> int:
    out = arguments.certificate
    if out:
        out = check_output(out, (".json",), arguments.motion, arguments.problem, arguments.scene)
    problem, motions, notes = _read(arguments)
    for note in (*problem.notes, *notes, *contact_notes(problem.scene)):
        print(f"note: {note}")
    if problem.moving and "trajectory" not in motions:
        print("note: the motion has no times: contacts with moving obstacles are not checked")
    valid = all([_validated(problem, label, motion, arguments.all) for label, motion in motions.items()])
    if out and valid:
        from robotdiffuse.certificates.search import certify

        certificate = certify(problem, list(motions.values())[-1])
        certificate.save(out)
        proof = certificate.proof
        print(
            f"wrote {out}: {counted(len(proof.stretches.claim), 'stretch', 'stretches')}, "
            f"{counted(len(proof.planes), 'plane')}"
        )
    return 0 if valid else 1


def _validated(problem: Problem, what: str, motion: Waypoints | Trajectory, everything: bool) -> bool:
    """Whether the motion is valid; prints its clearance, or its violations."""
    report = verify(problem, motion)
    if report.violation is None:
        jerk = "" if report.jerk_share is None else f"; {_jerk(report.jerk_share)}"
        print(f"{what}: valid, clearance certified {clearances(report)}{jerk}")
        return True
    shown_violations = (report.violation,)
    if everything:
        shown_violations = violations(problem, motion) or shown_violations
    for violation in shown_violations:
        print(f"{what}: not valid: {violation.line}")
    return False


def _jerk(share: float) -> str:
    """A text about the largest jerk. share: its largest fraction of a joint's limit; infinite if an
    acceleration jumps."""
    if math.isinf(share):
        return "accelerations jump at the ends, which some controllers refuse"
    return f"jerk at most {100 * share:.0f} % of the limits"


def read_result(file: str) -> tuple[PlanResult, Problem]:
    """The result in a file, and its problem. Raises InputError if the file holds no problem."""
    saved = load_result(file)
    if saved.problem is None:
        why = [f" ({note})" for note in saved.result.notes if note.startswith(NO_PROBLEM)]
        raise InputError(
            f"{file} holds no problem{''.join(why)}; write it with `robotdiffuse plan PROBLEM --out "
            "FILE.json`, or with `save` of a result of rd.plan"
        )
    return saved.result, problem_from_record(saved.problem)


def read_solved(file: str) -> tuple[PlanResult, Problem]:
    """The solved result in a file, and its problem. Raises InputError if the file holds no motion or
    problem."""
    result, problem = read_result(file)
    if not result.solved:
        raise InputError(f"{file} holds no motion: its status is {result.status.value} ({result.reason})")
    return result, problem


def _stored_problem(file: str) -> Problem:
    """The problem stored in an .mcap file. Raises InputError if there is none."""
    problem = None
    if file.lower().endswith(".mcap"):
        from robotdiffuse.interop.ros2 import problem_in

        problem = problem_in(Path(file))
    if problem is None:
        raise InputError(f"{file} holds no problem; give --problem FILE, or --scene FILE and --robot NAME")
    return problem


NO_TOPICS = (".json", ".csv", ".yaml", ".yml")
"""Endings of files of motions that have no topics."""


def _read(
    arguments: Namespace,
) -> tuple[Problem, dict[str, Waypoints | Trajectory], tuple[str, ...]]:
    """The problem, the motions to validate with their labels, and notes on what was changed in reading."""
    if (arguments.scene is None) != (arguments.robot is None):
        option, lacking = ("--robot", "--scene") if arguments.scene is None else ("--scene", "--robot")
        raise InputError(
            f"--scene and --robot belong together: {option} is given without {lacking}; give both or neither"
        )
    ending = Path(arguments.motion).suffix.lower()
    if arguments.topic is not None and ending in NO_TOPICS:
        raise InputError(f"--topic is for bags and MCAP files; {arguments.motion} has no topics")
    if arguments.index and arguments.problem is None:
        raise InputError("--index says which problem of --problem FILE; give --problem too, or no --index")
    only_motion = arguments.problem is None and arguments.scene is None
    if only_motion and arguments.ignore_joints:
        raise InputError(
            "--ignore-joints is for MoveIt files; give --problem or --scene too, or leave it out"
        )
    if only_motion and ending == ".json":
        result, problem = read_solved(arguments.motion)
        motions = {"path": result.path, "trajectory": result.trajectory}
        return problem, {label: motion for label, motion in motions.items() if motion is not None}, ()
    recorded = read_motion(arguments.motion, arguments.topic)
    scene_notes = ()
    if only_motion:
        problem = _stored_problem(arguments.motion)
    elif arguments.problem:
        problem = load_problem(arguments.problem, arguments.index, arguments.ignore_joints)
    else:
        robot = load_robot(arguments.robot)
        scene, robot, scene_notes = read_moveit_scene(str(arguments.scene), robot, arguments.ignore_joints)
        problem = problem_of_motion(recorded, robot, scene)
    with located(arguments.motion):
        converted = motion_of_robot(recorded, problem.robot, problem)
    label = "trajectory" if isinstance(converted.motion, Trajectory) else "path"
    return problem, {label: converted.motion}, (*scene_notes, *converted.notes)


MAX_CHANGES = 4
"""Largest number of differences from the bundled robot that one line of output lists."""


def run_check(arguments: Namespace) -> int:
    from robotdiffuse.certificates.certificate import load_certificate
    from robotdiffuse.certificates.requirements import not_checked

    certificate = load_certificate(arguments.file)
    problem = None
    if arguments.problem:
        problem = load_problem(arguments.problem)
    elif certificate.problem is not None:
        problem = problem_from_record(certificate.problem)
    for note in () if problem is None else contact_notes(problem.scene):
        print(f"note: {note}")
    differences = certificate.check(problem).differences
    if problem is not None:
        print(f"robot: {described(problem.robot)}")
        print(f"problem: {arguments.problem or 'the one in the certificate'}")
        print(f"not checked: {'; '.join(not_checked(problem, certificate.motion))}")
    for line in differences:
        print(line)
    if not differences:
        print(f"holds: {clearances(certificate)}")
    return 1 if differences else 0


def described(robot: Robot) -> str:
    """The robot's name, its source, and whether it is the bundled one."""
    from robotdiffuse.certificates.proof import differences, robot_parts

    name = robot.name if robot.source is None else f"{robot.name} from {robot.source}"
    if robot.name not in ROBOTS:
        return f"{name}, not bundled: the proof holds for the shapes and joints in its files"
    bundled = load_robot(DATA / robot.name, robot.locked)
    changes = differences("robot", robot_parts(bundled), robot_parts(robot))
    if not changes:
        return f"{name}, the bundled one"
    listed = joined([line.removeprefix("robot: ") for line in changes], MAX_CHANGES)
    return f"{name}, not the bundled one: {listed}"


def run_export(arguments: Namespace) -> None:
    outputs = [check_export(file, arguments.result) for file in arguments.out]
    problem, trajectory = validated_motion(arguments.result, arguments.rate)
    for file in outputs:
        write_motion(problem, trajectory, file)
        print(f"wrote {file}")


def validated_motion(file: str, rate: float | None = None) -> tuple[Problem, Trajectory]:
    """The problem and the motion of a result file, resampled at `rate` [Hz] if it is given.

    Raises InputError if the file holds no problem or no timed motion, and if the validator rejects the
    motion, because other programs may execute it.
    """

    result, problem = read_solved(file)
    if result.trajectory is None:
        raise InputError(f"{file} holds a path without times; plan again to get a trajectory")
    trajectory = result.trajectory if rate is None else result.trajectory.resample(rate)
    violation = verify(problem, trajectory).violation
    if violation is not None:
        rows = "" if rate is None else f" with rows at {rate:g} Hz"
        raise InputError(f"{file} is refused: its motion{rows} is not valid: {violation.message}")
    return problem, trajectory


def run_publish(arguments: Namespace) -> None:
    host, port = arguments.to
    _, trajectory = validated_motion(arguments.result)
    publish(trajectory, host, port, arguments.topic, arguments.timeout)
    print(f"published {counted(len(trajectory.times), 'row')} on {arguments.topic} at {host}:{port}")
