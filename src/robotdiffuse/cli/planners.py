"""robotdiffuse planners"""

import argparse


def add(commands: argparse._SubParsersAction) -> None:
    parser = commands.add_parser("planners", help="list the planners", description="List the planners.")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    from rich.console import Console
    from rich.table import Table

    from robotdiffuse.planners import PLANNERS

    table = Table("planner", "what it does")
    for name, entry in PLANNERS.items():
        table.add_row(name, entry.description)
    Console().print(table)
    return 0
