"""Generates parts of pages from the code, where a page says `<!-- generated: NAME -->`."""

import argparse
import ast
import re
from collections.abc import Callable, Iterator
from importlib import import_module
from importlib.resources import files
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import Files
from mkdocs.structure.pages import Page

EXAMPLES = Path(__file__).parents[2] / "examples"
READING_ORDER = (
    *("planning", "problems", "robots", "scenes", "perception"),
    *("core", "validation", "certificates", "visualization", "datasets"),
)
"""Order of the packages on the page of public names."""
TABLES = {
    "Planners": "planning:PLANNERS",
    "Families of random problems": "problems.families:FAMILIES",
    "Denoisers": "learning.denoisers:DENOISERS",
    "Encoders": "learning.encoders:ENCODERS",
    "Samplers": "learning.diffusion:SAMPLERS",
    "Files that motions are written to": "interop:WRITERS",
    "Files that motions are read from": "interop:READERS",
}
"""Tables on the page of parts by name: title, and where the table is."""
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
    groups = [(group.title or "", group._group_actions) for group in parser._action_groups]
    titles = {action: title for title, actions in groups[2:] for action in actions}
    for title in ("", *dict.fromkeys(titles.values())):
        rows = [action for action in shown if titles.get(action, "") == title]
        if rows:
            table = "".join(f"| {_names(action)} | {_cell(_help(action))} |\n" for action in rows)
            parts.append(f"| {title or 'argument'} | |\n|---|---|\n{table}")
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
    packages: dict[str, list[str]] = {}
    stub = files("robotdiffuse") / "__init__.pyi"
    for node in ast.parse(stub.read_text()).body:
        if isinstance(node, ast.ImportFrom) and node.module is not None:
            home = f"robotdiffuse.{node.module}"
            directives = [f"::: {home}.{alias.name}" for alias in node.names]
            packages.setdefault(node.module.split(".")[0], []).extend(directives)
    order = sorted(packages, key=lambda package: (*READING_ORDER, package).index(package))
    return "\n\n".join(f"## {name.capitalize()}\n\n" + "\n\n".join(packages[name]) for name in order)


def tables() -> str:
    """Every table of things by name, with their settings."""
    return "\n\n".join(f"## {title}\n\n{_table(location)}" for title, location in TABLES.items())


def _table(location: str) -> str:
    module, _, name = location.partition(":")
    table = getattr(import_module(f"robotdiffuse.{module}"), name)
    kinds = any(entry.kind for entry in table.values())
    rows = [f"| name |{' kind |' if kinds else ''} what it is |", f"|---|{'---|' if kinds else ''}---|"]
    for key, entry in table.items():
        rows.append(f"| `{key}` |{f' {entry.kind} |' if kinds else ''} {_cell(entry.description)} |")
    return "\n".join(rows)


def metrics() -> str:
    """The table of metrics."""
    from robotdiffuse.evaluation.metrics import METRICS

    rows = [f"| `{name}` | {metric.unit} | {metric.better} |" for name, metric in METRICS.items()]
    return "\n".join(["| name | unit | better |", "|---|---|---|", *rows])


def planner_settings() -> str:
    """The settings of every planner, as `--set NAME=VALUE` takes them."""
    from robotdiffuse.planning import PLANNERS

    parts: dict[type, list[str]] = {}
    for name in PLANNERS:
        kind = PLANNERS.settings(name)
        if kind is not None:
            parts.setdefault(kind, []).append(name)
    return "\n\n".join(_settings(kind, names) for kind, names in parts.items())


def _settings(kind: type, names: list[str]) -> str:
    rows = [
        f"| `{setting.name}` | {_cell(str(setting.default))} | {_cell(setting.description)} |"
        for setting in kind().describe()
    ]
    heading = ", ".join(f"`{name}`" for name in names)
    return "\n".join([f"### {heading}\n", "| setting | default | meaning |", "|---|---|---|", *rows])


def gallery() -> str:
    """The numbered examples, each with what it does, its picture and its code."""
    return "\n\n".join(_example(file) for file in sorted(EXAMPLES.glob("[0-9]*.py")))


def _example(file: Path) -> str:
    source = file.read_text(encoding="utf-8")
    tree = ast.parse(source)
    text = ast.get_docstring(tree) or ""
    first = tree.body[0]
    code = "\n".join(source.splitlines()[first.end_lineno :]).strip()
    title = file.stem.split("_", 1)[1].replace("_", " ").capitalize().replace("Moveit", "MoveIt")
    picture = f"![{title}](images/gallery/{file.stem}.png)"
    return f'## {title}\n\n{text}\n\n{picture}\n\n```python title="examples/{file.name}"\n{code}\n```'


PARTS: dict[str, Callable[[], str]] = {
    "commands": commands,
    "gallery": gallery,
    "metrics": metrics,
    "planner settings": planner_settings,
    "public names": public_names,
    "tables": tables,
}


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Replaces each mark by its part. Raises PluginError for an unknown name."""

    def part(match: re.Match[str]) -> str:
        if match.group(1) not in PARTS:
            raise PluginError(f"{page.file.src_uri}: no part {match.group(1)!r}; known: {', '.join(PARTS)}")
        return PARTS[match.group(1)]()

    return MARK.sub(part, markdown)
