"""The pages of `robotdiffuse reproduce`, as Markdown."""

from collections.abc import Sequence
from pathlib import Path as FilePath
from typing import TYPE_CHECKING

from robotdiffuse.core.output_files import write_atomically
from robotdiffuse.evaluation.bench.report import about, crashes
from robotdiffuse.evaluation.bench.run_folder import Bench
from robotdiffuse.evaluation.paper import table1
from robotdiffuse.evaluation.tables import Table, markdown, plain

if TYPE_CHECKING:
    from robotdiffuse.evaluation.paper.table2 import AblationSettings, RowResult


def write_table1(settings: table1.Table1Settings, bench: Bench) -> FilePath:
    """Write table1.md into the folder; returns the file."""
    weights = "" if settings.paper_weights is None else " --paper-weights FOLDER"
    command = (
        f"robotdiffuse reproduce table1 --out FOLDER --problems {settings.problems} "
        f"--time-limit {settings.time_limit:g}{weights}"
    )
    loads = [r.load for records in bench.records.values() for r in records if r.load is not None]
    load = (
        f"Load average of the machine after the calls: {min(loads):.1f} to {max(loads):.1f}." if loads else ""
    )
    lines = [*table1.notes(settings), *about(bench), *filter(None, [load]), *crashes(bench)]
    return write_page(settings.out / "table1.md", "Table 1", command, lines, table1.tables(settings, bench))


def write_table2(settings: "AblationSettings", results: "list[RowResult]") -> FilePath:
    """Write table2.md into the folder; returns the file."""
    from robotdiffuse.evaluation.paper import table2  # imports PyTorch

    command = (
        f"robotdiffuse reproduce table2 --data DATA --out FOLDER --samples {settings.samples} "
        f"--encoder-samples {settings.encoder_samples} --problems {settings.problems} "
        f"--seeds {settings.seeds}"
    )
    tables = [table2.table(settings, results), table2.straight_line_table(settings.problems)]
    return write_page(FilePath(settings.out) / "table2.md", "Table 2", command, [], tables)


def write_page(
    file: FilePath,
    title: str,
    command: str,
    notes: Sequence[str],
    tables: Sequence[Table],
    pictures: Sequence[tuple[str, str]] = (),
) -> FilePath:
    """Write a page: tables, then pictures, then notes.

    pictures: captions and files beside the page; the part of a caption before a colon is its heading.
    """
    lines = [f"# {title} of the paper, beside ours", "", "```sh", command, "```"]
    for table in tables:
        lines += ["", f"## {plain(table.title)}", "", *markdown(table)]
    heading = ""
    for caption, picture in pictures:
        of, _, what = caption.partition(": ")
        lines += ["", *([f"## {plain(of)}", ""] if of != heading else []), f"{plain(what)}:"]
        lines += ["", f"![{plain(caption)}]({picture})"]
        heading = of
    if notes:
        lines += ["", "## Notes", "", *(f"- {plain(note)}" for note in notes)]
    write_atomically(file, "\n".join(lines) + "\n", make_folder=True)
    return file
