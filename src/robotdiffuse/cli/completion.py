"""The commands `robotdiffuse schema` and `robotdiffuse completion`, for editors and shells."""

import argparse
import json
from collections.abc import Iterator

BASH, ZSH = SHELLS = ("bash", "zsh")
SCRIPT = """_robotdiffuse() {{
  local word="${{COMP_WORDS[COMP_CWORD]}}" path="" words="" i
  for ((i = 1; i < COMP_CWORD; i++)); do
    case "$path ${{COMP_WORDS[i]}}" in
      {paths}) path="$path ${{COMP_WORDS[i]}}" ;;
    esac
  done
  case "$path" in
{cases}
  esac
  COMPREPLY=($(compgen -W "$words" -- "$word"))
  if [[ $word != -* ]]; then COMPREPLY+=($(compgen -f -- "$word")); fi
}}
complete -o filenames -F _robotdiffuse robotdiffuse
"""
"""A function of bash; zsh runs it by bashcompinit."""


def add_schema(commands: argparse._SubParsersAction) -> None:
    parser = commands.add_parser(
        "schema",
        help="print the JSON schema of problem files",
        description="Print the JSON schema of problem files, by which editors complete and check them.",
    )
    parser.set_defaults(run=run_schema)


def add(commands: argparse._SubParsersAction) -> None:
    parser = commands.add_parser(
        "completion",
        help="print a script that completes commands and options in bash or zsh",
        description="Print a script that completes commands and options: "
        'eval "$(robotdiffuse completion bash)" in ~/.bashrc, or with zsh in ~/.zshrc.',
    )
    parser.add_argument("shell", choices=SHELLS, help="the shell")
    parser.set_defaults(run=run, parsers=commands.choices)


def run_schema(arguments: argparse.Namespace) -> int:
    from robotdiffuse.problems.files.schema import problem_schema

    print(json.dumps(problem_schema(), indent=1))
    return 0


def run(arguments: argparse.Namespace) -> int:
    words = {"": [*arguments.parsers, "--help", "--version"]}
    for name, parser in arguments.parsers.items():
        words |= _words(parser, f" {name}")
    paths = "|".join(f'"{path}"' for path in words if path)
    cases = "\n".join(f"""    "{path}") words="{" ".join(found)}" ;;""" for path, found in words.items())
    script = SCRIPT.format(paths=paths, cases=cases)
    print(
        script if arguments.shell == BASH else f"autoload -U +X bashcompinit && bashcompinit\n{script}",
        end="",
    )
    return 0


def _words(parser: argparse.ArgumentParser, path: str) -> Iterator[tuple[str, list[str]]]:
    """Each command by its path, such as " data info", with what may follow: commands, choices and options."""
    found: list[str] = []
    below: list[tuple[str, argparse.ArgumentParser]] = []
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            below += action.choices.items()
        elif not action.option_strings:
            found += map(str, action.choices or ())
        found += [option for option in action.option_strings if option.startswith("--")]
    yield path, [*(name for name, _ in below), *found]
    for name, child in below:
        yield from _words(child, f"{path} {name}")
