"""robotdiffuse planners"""

import argparse


def add(commands: argparse._SubParsersAction) -> None:
    parser = commands.add_parser("planners", help="list the planners", description="List the planners.")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    from robotdiffuse.evaluation.tables import Column, Table, show
    from robotdiffuse.planners import PLANNERS

    rows = [(name, entry.description) for name, entry in PLANNERS.items()]
    show(Table.of("", ("planner", Column("what it does", left=True)), rows))
    return 0
