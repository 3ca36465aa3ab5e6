"""The command `robotdiffuse certificate check`."""

import argparse

HOLDS, FAILS = 0, 1


def add(commands: argparse._SubParsersAction) -> None:
    parser = commands.add_parser(
        "certificate",
        help="re-check a certificate of a motion",
        description="Re-check the certificate of a motion.",
    )
    actions = parser.add_subparsers(title="actions", metavar="ACTION", required=True)
    check = actions.add_parser(
        "check",
        help="re-check a certificate, without search",
        description="Re-check a certificate with code that shares nothing with the validator. Exit status: "
        "0 if it holds, 1 if not, 2 for bad input.",
    )
    check.add_argument("file", metavar="FILE", help="certificate of `robotdiffuse verify --certificate`")
    check.add_argument(
        "--problem",
        metavar="FILE",
        help="problem file to check it for (default: the problem in the certificate)",
    )
    check.set_defaults(run=run_check)


def run_check(arguments: argparse.Namespace) -> int:
    from robotdiffuse.certificates.certificate import load_certificate
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
    for line in found:
        print(line)
    if not found:
        print(f"holds: {clearances(certificate)}")
    return FAILS if found else HOLDS
