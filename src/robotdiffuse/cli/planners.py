"""The command `robotdiffuse planners`."""

import argparse

from robotdiffuse.cli.arguments import add_import_option, command, option


def add(commands: argparse._SubParsersAction) -> None:
    parser = command(
        commands,
        "planners",
        "list the planners, or the settings of one",
        "List the planners, or the settings of one for `robotdiffuse plan --set`.",
        run,
    )
    option(parser, "planner NAME", "list the settings of this planner", nargs="?")
    add_import_option(parser)


def run(arguments: argparse.Namespace) -> int:
    from robotdiffuse.core.tables import Column, Table, show
    from robotdiffuse.planning import PLANNERS, planner_settings

    if arguments.planner is None:
        rows = [(name, one.kind, one.description) for name, one in PLANNERS.load_installed().items()]
        show(Table.of("", ("planner", Column("kind", left=True), Column("description", left=True)), rows))
        return 0
    settings = planner_settings(arguments.planner, ())
    rows = [(one.name, one.value, one.rule, one.description) for one in settings.describe()]
    columns = ("setting", *(Column(name, left=True) for name in ("default", "values", "description")))
    show(Table.of(f"{arguments.planner}: {PLANNERS[arguments.planner].description}", columns, rows))
    return 0
