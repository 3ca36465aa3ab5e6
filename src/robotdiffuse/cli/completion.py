"""The commands `robotdiffuse planner`, `schema` and `completion`: what can be named."""

import json
from argparse import ArgumentParser
from collections.abc import Iterator

from robotdiffuse.cli.arguments import Commands, Namespace, add_import_option, command, group, option


def add_planner(commands: Commands) -> None:
    actions = group(commands, "planner", "list or show planners", "List the planners, or show one.")
    listing = command(actions, "list", "list the planners", "List the planners.", run_planner_list)
    add_import_option(listing)
    info = command(
        actions,
        "info",
        "show the settings of a planner",
        "Show the settings of a planner, for `robotdiffuse plan --set`.",
        run_planner_info,
        ("planner NAME", "a planner that `planner list` shows"),
    )
    add_import_option(info)


def run_planner_list(arguments: Namespace) -> None:
    from robotdiffuse.core.tables import Column, Table, show
    from robotdiffuse.planning import PLANNERS

    rows = [(name, one.kind, one.description) for name, one in PLANNERS.load_installed().items()]
    show(Table.of("", ("planner", Column("kind", left=True), Column("description", left=True)), rows))


def run_planner_info(arguments: Namespace) -> None:
    from robotdiffuse.core.tables import Column, Table, show
    from robotdiffuse.planning import PLANNERS, planner_settings

    settings = planner_settings(arguments.planner, ())
    rows = [(one.name, one.value, one.rule, one.description) for one in settings.describe()]
    columns = ("setting", *(Column(name, left=True) for name in ("default", "values", "description")))
    show(Table.of(f"{arguments.planner}: {PLANNERS[arguments.planner].description}", columns, rows))


SHELLS = ("bash", "zsh")
SCRIPT = """_robotdiffuse() {{
  local word="${{COMP_WORDS[COMP_CWORD]}}" command="" words="" options="" i
  for ((i = 1; i < COMP_CWORD; i++)); do
    case "$command ${{COMP_WORDS[i]}}" in
      {paths}) command="$command ${{COMP_WORDS[i]}}" ;;
    esac
  done
  case "$command" in
{cases}
  esac
  if [[ $word == -* ]]; then words="$options"; fi
  COMPREPLY=($(compgen -W "$words" -- "$word"))
}}
complete -o default -F _robotdiffuse robotdiffuse
"""
"""A function of bash; zsh runs it by bashcompinit, where `path` is not a plain variable.
Where no word fits, the shell completes names of files."""


def add_schema(commands: Commands) -> None:
    command(
        commands,
        "schema",
        "print the JSON schema of problem files",
        "Print the JSON schema of problem files, by which editors complete and check them.",
        run_schema,
    )


def add_completion(commands: Commands) -> None:
    parser = commands.add_parser(
        "completion",
        help="print a script that completes commands and options in bash or zsh",
        description="Print a script that completes commands and options: "
        'eval "$(robotdiffuse completion bash)" in ~/.bashrc, or with zsh in ~/.zshrc.',
    )
    option(parser, "shell", "the shell", choices=SHELLS)
    parser.set_defaults(run=run_completion, parsers=commands.choices)


def run_schema(arguments: Namespace) -> None:
    from robotdiffuse.problems.fields import problem_schema

    print(json.dumps(problem_schema(), indent=1))


def run_completion(arguments: Namespace) -> None:
    words_by_command = {"": (list(arguments.parsers), ["--help", "--version"])}
    for name, parser in arguments.parsers.items():
        words_by_command |= _words(parser, f" {name}")
    paths = "|".join(f'"{path}"' for path in words_by_command if path)
    cases = "\n".join(
        f"""    "{path}") words="{" ".join(words)}" options="{" ".join(options)}" ;;"""
        for path, (words, options) in words_by_command.items()
    )
    script = SCRIPT.format(paths=paths, cases=cases)
    print(
        script if arguments.shell == "bash" else f"autoload -U +X bashcompinit && bashcompinit\n{script}",
        end="",
    )


def _words(parser: ArgumentParser, path: str) -> Iterator[tuple[str, tuple[list[str], list[str]]]]:
    """Each command by its path, such as " data info", with its subcommands or choices, and its options."""
    words: list[str] = []
    options: list[str] = []
    below: dict[str, ArgumentParser] = {}
    for action in parser._actions:
        if isinstance(action, Commands):
            below |= action.choices
        elif not action.option_strings:
            words += map(str, action.choices or ())
        options += [option for option in action.option_strings if option.startswith("--")]
    yield path, ([*below, *words], options)
    for name, child in below.items():
        yield from _words(child, f"{path} {name}")
