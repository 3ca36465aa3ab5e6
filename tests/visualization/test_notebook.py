"""rd.show: replays in notebook cells."""

import html
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import robotdiffuse as rd
from helpers.panda import PANDA
from helpers.refusals import refuses
from robotdiffuse.problems.files import problem_record

START, END = np.array([0.0, -0.4, 0, -2, 0, 1.6, 0.8]), np.array([0.3, -0.4, 0, -2, 0, 1.6, 0.8])
PROBLEM = rd.Problem(PANDA, rd.Scene([rd.Sphere([0, 0.9, 0.5], 0.1, "moon")]), START, END)


@pytest.fixture(scope="module")
def result() -> rd.PlanResult:
    return rd.load_planner("aorrtc").plan(PROBLEM, 5.0)


@pytest.fixture
def notebook(monkeypatch: pytest.MonkeyPatch) -> None:
    """A shell like that of a Jupyter kernel."""
    shell = SimpleNamespace(kernel=object())
    monkeypatch.setitem(sys.modules, "IPython", SimpleNamespace(get_ipython=lambda: shell))  # type: ignore


@pytest.mark.usefixtures("notebook")
def test_a_result_and_a_result_file_in_a_cell(result: rd.PlanResult, tmp_path: Path) -> None:
    cell = rd.show(result, height=300)._repr_html_()
    assert cell.startswith('<iframe srcdoc="&lt;!doctype html&gt;') and 'height="300"' in cell
    page = html.unescape(cell.partition('srcdoc="')[2].rpartition('" height')[0])
    assert page.endswith("</html>\n") and '"moon"' in page
    result.save(tmp_path / "with.json", problem_record(PROBLEM))
    assert "moon" in rd.show(rd.load_result(tmp_path / "with.json"))._repr_html_()
    replace(result, problem=None).save(tmp_path / "without.json")
    without = rd.load_result(tmp_path / "without.json")
    refuses(r"use rd\.show\(result, problem\)", rd.show, without)
    assert "moon" in rd.show(without, PROBLEM)._repr_html_()


@pytest.mark.usefixtures("notebook")
def test_no_motion() -> None:
    cell = rd.show(rd.load_planner("aorrtc").plan(rd.Problem(PANDA, rd.Scene([rd.Sphere([0.4, 0, 0.4], 0.3)]), START, END)))
    assert "panda · invalid start" in cell._repr_html_() and "inside sphere" in cell._repr_html_()


def test_outside_a_notebook(result: rd.PlanResult, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "IPython", raising=False)
    refuses(r"rd\.show is for notebooks; elsewhere .* `robotdiffuse view`", rd.show, result)
