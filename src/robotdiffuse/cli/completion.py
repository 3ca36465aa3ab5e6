"""The commands `robotdiffuse planner`, `schema` and `completion`, which list planners, fields and words."""

import json
from argparse import ArgumentParser
from collections.abc import Iterator

from robotdiffuse.cli import build_parser
from robotdiffuse.cli.arguments import Commands, Namespace
from robotdiffuse.core.tables import Column, Table, show
from robotdiffuse.planning import PLANNERS, planner_settings
from robotdiffuse.problems.fields import problem_schema


def run_planner_list(arguments: Namespace) -> None:
    rows = [(name, entry.kind, entry.description) for name, entry in PLANNERS.load_installed().items()]
    show(Table.of("", ("planner", Column("kind", left=True), Column("description", left=True)), rows))


def run_planner_info(arguments: Namespace) -> None:
    rows = [
        (setting.name, setting.value, setting.rule, setting.description)
        for setting in planner_settings(arguments.planner, ()).describe()
    ]
    columns = ("setting", *(Column(name, left=True) for name in ("default", "values", "description")))
    show(Table.of(f"{arguments.planner}: {PLANNERS[arguments.planner].description}", columns, rows))


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
"""A completion function for bash; zsh runs it by bashcompinit. It has no variable `path`, which is special in
zsh. Where no word fits, the shell completes names of files."""


def run_schema(arguments: Namespace) -> None:
    print(json.dumps(problem_schema(), indent=1))


def run_completion(arguments: Namespace) -> None:
    words_by_command = dict(_words(build_parser(), ""))
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
    """Yields for each command its path, such as " data info", and two lists: the words that may follow
    (subcommands or choices), and its options."""
    words = list[str]()
    options = list[str]()
    below = dict[str, ArgumentParser]()
    for action in parser._actions:
        if isinstance(action, Commands):
            below |= action.choices
        elif not action.option_strings:
            words += map(str, action.choices or ())
        options += [option for option in action.option_strings if option.startswith("--")]
    yield path, ([*below, *words], options)
    for name, child in below.items():
        yield from _words(child, f"{path} {name}")
