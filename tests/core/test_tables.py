"""Tables in Markdown and in the terminal: all cells appear, markup is escaped, the best value is marked."""

import re
from io import StringIO

from rich.console import Console

from robotdiffuse.core import tables
from robotdiffuse.core.tables import Column, Figure, Table

COLUMNS = ("planner", Column("success", "%", ".1f", "more", scale=100.0), Column("a & b", "s", better="less"))
ROWS = (("rrt_star*", 0.25, Figure("0.0010", 0.001)), ("b|c [x]", 0.75, 2.0), ("<d>", float("nan"), None))
TABLE = Table.of("Title [of] it", COLUMNS, ROWS, ("note_1 < 2",))


def test_numbers_are_formatted_and_the_best_are_those_that_look_like_it_and_are_not_common() -> None:
    assert [row[1:] for row in TABLE.texts] == [["25.0", "0.0010"], ["75.0", "2"], ["–", "–"]]
    assert Table.of("", ["", ""], [("x", -3)]).texts == [["x", "−3"]]
    in_mm = Table.of("", ["", Column("", "mm", ".1f", scale=1000.0)], [("x", 1), ("y", 0.5)])
    assert in_mm.texts == [["x", "1000.0"], ["y", "500.0"]]
    assert TABLE.best == {(1, 1), (0, 2)}
    column = Column("x", format=".1f", better="less")
    assert Table.of("", ["", column], [("a", 1.01), ("b", 1.02), ("c", 2), ("d", 3)]).best == {(0, 1), (1, 1)}
    assert not Table.of("", ["", column], [("a", 1), ("b", 1), ("c", 2)]).best


def test_markdown() -> None:
    assert tables.markdown(TABLE) == [
        "| planner    | success % |    a & b s |",
        "|------------|----------:|-----------:|",
        r"| rrt_star\* |      25.0 | **0.0010** |",
        r"| b\|c [x]   |  **75.0** |          2 |",
        r"| \<d>       |         – |          – |",
        "",
        r"note_1 \< 2",
    ]


def test_pairs_and_tables_are_printed_in_lines_that_fit() -> None:
    table = Table.pairs("panda: solved", [("reason", "solved by [b]aorrtc[/b] more"), ("seed", "0")])
    assert tables.pair_lines(table, 31) == ["panda: solved", "reason  solved by [b]aorrtc[/b]", "        more", "seed    0"]
    assert max(map(len, tables.pair_lines(table, 1))) <= len("reason  ") + tables.MIN_TEXT_WIDTH
    out = StringIO()
    Console(file=out, width=80).print(tables.terminal(TABLE))
    printed = re.sub(" +", " ", out.getvalue())
    assert "Title [of] it" in printed and "rrt_star* 25.0 0.0010" in printed and "b|c [x] 75.0 2" in printed
