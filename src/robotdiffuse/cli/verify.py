"""robotdiffuse verify, robotdiffuse certificate check"""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from robotdiffuse.cli.arguments import IGNORE_JOINTS, natural
from robotdiffuse.cli.console import clearances
from robotdiffuse.core.errors import InputError

if TYPE_CHECKING:
    from robotdiffuse.core import types
    from robotdiffuse.problems.problem import Problem

HELD, NOT_HELD = 0, 1


def add_verify(commands: argparse._SubParsersAction) -> None:
    parser = commands.add_parser(
        "verify",
        help="validate anybody's motion, and certify it",
        description="Validate a motion, whoever planned it: a result of ours, CSV, JSON, YAML of a ROS "
        "JointTrajectory or MoveIt RobotTrajectory, a ROS 2 bag or MCAP. Exit status: 0 valid, 1 not valid, "
        "2 bad input.",
    )
    parser.add_argument(
        "motion", metavar="MOTION", help="file (.json, .csv, .yaml, .mcap), or the folder of a ROS 2 bag"
    )
    where = parser.add_mutually_exclusive_group()
    where.add_argument(
        "--problem",
        metavar="FILE",
        help="problem file (default: the one that a result or an .mcap of ours holds)",
    )
    where.add_argument(
        "--scene",
        metavar="FILE",
        help="MoveIt planning scene; start and goal are the motion's own. Needs --robot",
    )
    parser.add_argument(
        "--index", type=natural, default=0, help="which problem of a .jsonl file (default: 0)"
    )
    parser.add_argument("--robot", metavar="NAME", help="bundled name or URDF, beside --scene")
    parser.add_argument("--ignore-joints", action="store_true", help=IGNORE_JOINTS)
    parser.add_argument("--topic", metavar="NAME", help="of a bag or MCAP file that holds several motions")
    parser.add_argument(
        "--all", action="store_true", help="print all that is wrong, not only what comes first"
    )
    parser.add_argument(
        "--certificate",
        metavar="FILE.json",
        help="write a proof of a valid motion, for `robotdiffuse certificate check`",
    )
    parser.set_defaults(run=run_verify)


def add_certificate(commands: argparse._SubParsersAction) -> None:
    parser = commands.add_parser(
        "certificate",
        help="re-check certificates of motions",
        description="Re-check certificates of motions.",
    )
    actions = parser.add_subparsers(title="actions", metavar="ACTION", required=True)
    check = actions.add_parser(
        "check",
        help="re-check a certificate, without search",
        description="Re-check a certificate by code that shares nothing with the validator. Exit status: 0 it "
        "holds, 1 it does not, 2 bad input.",
    )
    check.add_argument("file", metavar="FILE", help="certificate of `robotdiffuse verify --certificate`")
    check.add_argument(
        "--problem", metavar="FILE", help="for this problem file (default: the problem that it holds)"
    )
    check.set_defaults(run=run_check)


def run_verify(arguments: argparse.Namespace) -> int:
    from robotdiffuse.core.output_files import check_output

    out = None if arguments.certificate is None else check_output(arguments.certificate, (".json",))
    problem, motions, notes = _asked(arguments)
    for note in notes:
        print(f"note: {note}")
    valid = all([_validated(problem, what, motion, arguments.all) for what, motion in motions.items()])
    if out is not None and valid:
        from robotdiffuse.certificates.search import certify

        certificate = certify(problem, list(motions.values())[-1])
        certificate.save(out)
        proof = certificate.proof
        print(f"wrote {out}: {len(proof.stretches.claim)} stretches, {len(proof.planes)} planes")
    return HELD if valid else NOT_HELD


def run_check(arguments: argparse.Namespace) -> int:
    from robotdiffuse.certificates.proof import load_certificate
    from robotdiffuse.problems.files import load_problem

    certificate = load_certificate(arguments.file)
    problem = None if arguments.problem is None else load_problem(arguments.problem)
    found = certificate.check(problem).differences
    for line in found:
        print(line)
    if not found:
        scene, itself = 1e3 * certificate.scene_clearance, 1e3 * certificate.self_clearance
        print(f"holds: at least {scene:.1f} mm to the scene, {itself:.1f} mm between links")
    return NOT_HELD if found else HELD


def _validated(
    problem: "Problem", what: str, motion: "types.Path | types.Trajectory", everything: bool
) -> bool:
    from robotdiffuse.core.types import Trajectory
    from robotdiffuse.validation.validator import verify, verify_trajectory

    timed = isinstance(motion, Trajectory)
    report = verify_trajectory(problem, motion) if timed else verify(problem, motion)
    if report.violation is None:
        print(f"{what}: valid, clearance at least {clearances(report)}")
        return True
    found = (report.violation,)
    if everything:
        from robotdiffuse.validation.violations import violations

        found = violations(problem, motion) or found
    for violation in found:
        print(f"{what}: not valid: {violation.message} (at {violation.time:.3f})")
    return False


def _along(file: str) -> "Problem":
    """The problem in a file of ours; InputError if it has none."""
    problem = None
    if file.lower().endswith(".mcap"):
        from robotdiffuse.interop.mcap_file import problem_in

        problem = problem_in(Path(file))
    if problem is None:
        raise InputError(f"{file} holds no problem; give --problem FILE, or --scene FILE and --robot NAME")
    return problem


def _asked(
    arguments: argparse.Namespace,
) -> "tuple[Problem, dict[str, types.Path | types.Trajectory], tuple[str, ...]]":
    """The problem, the motions to validate, and what was changed to read them."""
    from robotdiffuse.core.types import Trajectory
    from robotdiffuse.interop import read_motion
    from robotdiffuse.interop.recorded_motion import fitted, own_problem
    from robotdiffuse.problems.files import load_problem

    if (arguments.scene is None) != (arguments.robot is None):
        raise InputError("--scene and --robot belong together: a planning scene does not say which robot")
    alone = arguments.problem is None and arguments.scene is None
    if alone and arguments.motion.lower().endswith(".json"):
        from robotdiffuse.cli.view import read

        result, problem = read(arguments.motion)
        both = {"path": result.path, "trajectory": result.trajectory}
        return problem, {what: motion for what, motion in both.items() if motion is not None}, ()
    recorded, more = read_motion(arguments.motion, arguments.topic), ()
    if alone:
        problem = _along(arguments.motion)
    elif arguments.problem is not None:
        problem = load_problem(arguments.problem, arguments.index, arguments.ignore_joints)
    else:
        from robotdiffuse.problems.files.moveit import read_noted_moveit_scene
        from robotdiffuse.robots import load_robot

        robot = load_robot(arguments.robot)
        scene, more = read_noted_moveit_scene(str(arguments.scene), robot, arguments.ignore_joints)
        problem = own_problem(recorded, robot, scene)
    try:
        fit = fitted(recorded, problem.robot)
    except InputError as error:
        raise InputError(f"{arguments.motion}: {error}") from None
    what = "trajectory" if isinstance(fit.motion, Trajectory) else "path"
    return problem, {what: fit.motion}, (*more, *fit.notes)
