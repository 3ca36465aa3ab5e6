"""The command `robotdiffuse planners`."""

import argparse


def add(commands: argparse._SubParsersAction) -> None:
    parser = commands.add_parser(
        "planners",
        help="list the planners, or the settings of one",
        description="List the planners, or the settings of one for `robotdiffuse plan --set`.",
    )
    parser.add_argument("planner", nargs="?", metavar="NAME", help="list the settings of this planner")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    from robotdiffuse.evaluation.tables import Column, Table, show
    from robotdiffuse.planning import PLANNERS, planner_settings

    if arguments.planner is None:
        rows = [(name, entry.kind, entry.description) for name, entry in PLANNERS.items()]
        show(Table.of("", ("planner", Column("kind", left=True), Column("description", left=True)), rows))
        return 0
    settings = planner_settings(arguments.planner, ())
    rows = [(one.name, one.value, one.rule, one.description) for one in settings.describe()]
    columns = ("setting", *(Column(name, left=True) for name in ("default", "values", "description")))
    show(Table.of(f"{arguments.planner}: {PLANNERS[arguments.planner].description}", columns, rows))
    return 0
