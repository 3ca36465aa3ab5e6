"""Parts of pages that come from the code, so that they cannot go stale: `<!-- generated: NAME -->` in a page."""

import argparse
import re
from collections.abc import Callable, Iterator

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import Files
from mkdocs.structure.pages import Page

MARK = re.compile(r"^<!-- generated: (.+) -->$", re.MULTILINE)


def commands() -> str:
    """All commands with their options, from the parser that the command line uses."""
    from robotdiffuse.cli import build_parser

    return "\n\n".join(_command(parser) for parser in leaves(build_parser()))


def leaves(parser: argparse.ArgumentParser) -> Iterator[argparse.ArgumentParser]:
    """The parsers of the commands that have no commands below them."""
    below = [action for action in parser._actions if isinstance(action, argparse._SubParsersAction)]
    if not below:
        yield parser
    for action in below:
        for child in action.choices.values():
            yield from leaves(child)


def _command(parser: argparse.ArgumentParser) -> str:
    shown = [action for action in parser._actions if not isinstance(action, argparse._HelpAction)]
    needed = [action for action in shown if action.required]
    places = [action for action in needed if not action.option_strings]
    options = [action for action in needed if action.option_strings]
    words = [parser.prog, *map(_usage, places), *map(_usage, options)]
    if len(shown) > len(needed):
        words.append("[OPTIONS]")
    parts = [f"## {parser.prog}", parser.description or "", f"```text\n{' '.join(words)}\n```"]
    for group in parser._action_groups:
        rows = [action for action in group._group_actions if action in shown]
        if not rows:
            continue
        if group.title not in ("positional arguments", "options"):
            parts.append(f"*{(group.title or '').capitalize()}*")
        table = "".join(f"| {_names(action)} | {_cell(_help(action))} |\n" for action in rows)
        parts.append(f"| argument | meaning |\n|---|---|\n{table}")
    return "\n\n".join(part.rstrip() for part in parts if part)


def _usage(action: argparse.Action) -> str:
    value = str(action.metavar or action.dest.upper())
    return f"{action.option_strings[-1]} {value}" if action.option_strings else value


def _names(action: argparse.Action) -> str:
    value = "" if action.nargs == 0 else str(action.metavar or action.dest.upper())
    names = ", ".join(action.option_strings)
    return f"`{' '.join(part for part in (names, value) if part)}`"


def _help(action: argparse.Action) -> str:
    text = (action.help or "").replace("%%", "%")
    return f"{text} (needed)" if action.required and action.option_strings else text


def _cell(text: str) -> str:
    return text.replace("|", r"\|").replace("<", "&lt;").replace("*", r"\*")


def public_names() -> str:
    """A directive for each public name of the package, at its home."""
    import robotdiffuse

    return "\n\n".join(f"::: {home}.{name}" for name, home in robotdiffuse._HOME.items())


PARTS: dict[str, Callable[[], str]] = {"commands": commands, "public names": public_names}


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    def part(match: re.Match[str]) -> str:
        if match.group(1) not in PARTS:
            raise PluginError(f"{page.file.src_uri}: no generated part {match.group(1)!r}; known: {', '.join(PARTS)}")
        return PARTS[match.group(1)]()

    return MARK.sub(part, markdown)
