"""The command `robotdiffuse certificate check`."""

import argparse
from typing import TYPE_CHECKING

from robotdiffuse.cli.arguments import command, option

HOLDS, FAILS = 0, 1
MAX_CHANGES = 4
"""Differences from the bundled robot in a line at most."""

if TYPE_CHECKING:
    from robotdiffuse.robots.robot import Robot


def add(commands: argparse._SubParsersAction) -> None:
    parser = command(
        commands, "certificate", "re-check a certificate of a motion", "Re-check the certificate of a motion."
    )
    actions = parser.add_subparsers(title="actions", metavar="ACTION", required=True)
    check = command(
        actions,
        "check",
        "re-check a certificate, without search",
        "Re-check a certificate with code that shares nothing with the validator. Exit status: "
        "0 if it holds, 1 if not, 2 for bad input.",
        run_check,
    )
    option(check, "file FILE", "certificate of `robotdiffuse verify --certificate`")
    option(check, "--problem FILE", "problem file to check it for (default: the problem in the certificate)")


def run_check(arguments: argparse.Namespace) -> int:
    from robotdiffuse.certificates.certificate import load_certificate
    from robotdiffuse.certificates.requirements import not_checked
    from robotdiffuse.cli.console import clearances
    from robotdiffuse.problems.files import load_problem, problem_from_record
    from robotdiffuse.scenes.scene import contact_notes

    certificate, problem = load_certificate(arguments.file), None
    if arguments.problem is not None:
        problem = load_problem(arguments.problem)
    elif certificate.problem is not None:
        problem = problem_from_record(certificate.problem)
    for note in () if problem is None else contact_notes(problem.scene):
        print(f"note: {note}")
    found = certificate.check(problem).differences
    if problem is not None:
        print(f"robot: {described(problem.robot)}")
        print(f"problem: {arguments.problem or 'the one in the certificate'}")
        print(f"not checked: {'; '.join(not_checked(problem, certificate.motion))}")
    for line in found:
        print(line)
    if not found:
        print(f"holds: {clearances(certificate)}")
    return FAILS if found else HOLDS


def described(robot: "Robot") -> str:
    """The robot's name, its source, and whether it is the bundled one."""
    from robotdiffuse.certificates.content_hashes import differences, robot_parts
    from robotdiffuse.core.errors import joined
    from robotdiffuse.robots import DATA, ROBOTS, load_robot

    name = robot.name if robot.source is None else f"{robot.name} from {robot.source}"
    if robot.name not in ROBOTS:
        return f"{name}, not bundled: the proof holds for the shapes and joints in its files"
    held = {joint: value for joint, value in robot.locked.items() if joint not in robot.joint_names}
    bundled = load_robot(DATA / robot.name, held)
    changes = differences("robot", robot_parts(bundled), robot_parts(robot))
    if not changes:
        return f"{name}, the bundled one"
    listed = joined([line.removeprefix("robot: ") for line in changes], MAX_CHANGES)
    return f"{name}, not the bundled one: {listed}"
