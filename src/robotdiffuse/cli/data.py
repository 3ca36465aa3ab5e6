"""robotdiffuse data: its actions are in data_generate.py and data_look.py"""

import argparse

from robotdiffuse.cli import data_generate, data_inspect


def add(commands: argparse._SubParsersAction) -> None:
    parser = commands.add_parser(
        "data", help="make and look at training data", description="Make training data, and look at it."
    )
    actions = parser.add_subparsers(title="actions", metavar="ACTION", required=True)
    data_generate.add_generate(actions)
    data_inspect.add_info(actions)
    data_inspect.add_check(actions)
    data_inspect.add_view(actions)
    data_inspect.add_export(actions)
    data_inspect.add_import(actions)
