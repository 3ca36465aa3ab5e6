"""The commands `data info`, `check`, `view`, `export` and `import`."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

import robotdiffuse as rd
from helpers.commands import Said, run
from helpers.panda import GOAL, HOME, PANDA, START
from helpers.stores import line, random_motions, record, write_motions

BALL = rd.Scene([rd.Sphere([0.5, 0.0, 0.5], 0.15)])


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("COLUMNS", "200")
    write_motions(tmp_path / "set", PANDA, random_motions(PANDA, 5), shard=3)
    return tmp_path / "set"


def test_info_prints_figures_and_writes_the_page_and_check_finds_no_fault(folder, said: Said):
    printed = said(0, "data", "info", folder)
    figures = "71.4 %", "tried: 9", "rop_dense", "length [rad]", "clearance [cm]"
    for text in ("panda: 5 motions", "waypoints, evenly spaced in length", *figures):
        assert text in printed, text
    assert (folder / "report.html").read_text().startswith("<!doctype html>")
    printed = said(0, "data", "check", folder, "--workers", 1, "--no-pybullet", "--count", 4)
    assert "panda: clean" in printed and re.search("validated .* 4 in", printed) and "not checked" in printed


def test_check_finds_a_collision(folder, said: Said):
    pytest.importorskip("pybullet")
    write_motions(folder, PANDA, [*random_motions(PANDA, 2), record(PANDA, BALL, line(START, GOAL))])
    printed = said(1, "data", "check", folder, "--workers", 1)
    assert "violations found" in printed and printed.count("shard 0, row 2") == 2
    assert re.search(r"found by PyBullet +1\b", printed) and "inside sphere" in printed


def test_view_shows_samples_in_one_page(folder, said: Said):
    out = folder.parent / "samples.html"
    assert f"wrote {out}" in said(0, "data", "view", folder, "--count", 2, "--seed", 3, "--out", out).replace("\n", "")
    page = out.read_text("utf-8")
    titles = re.findall("<b>(.*?)</b>", page)
    assert len(titles) == 2 and all(re.fullmatch(r"rop(_dense)? · shard \d, row \d", title) for title in titles)
    stored = json.loads(page.split('id="replays">')[1].split("</script>")[0])
    replays = ["".join(stored["parts"][i] for i in parts) for parts in stored["pages"]]
    assert len(replays) == 2
    assert len(set(stored["parts"])) == len(stored["parts"])  # what replays share is kept once
    for replay, title in zip(replays, titles, strict=True):
        assert replay.startswith("<!doctype html>") and f"<h1>{title}</h1>" in replay


def test_export(folder, said: Said):
    two = rd.Scene([rd.Sphere([2.0, 0.0, 0.5], 0.25), rd.Sphere([2.0, 1.0, 0.5], 0.25)])
    folder = folder.parent / "spheres"
    write_motions(folder, PANDA, [record(PANDA, two, line(START, GOAL, 254))], waypoints=254)
    file = folder.parent / "robot.npz"
    assert "1 motion;" in said(0, "data", "export", folder, file)
    with np.load(file) as arrays:
        assert arrays["x_train"].shape == (1, 254, 7) and arrays["y_train"].shape == (1, 23)
    again = folder.parent / "again"
    assert f"1 motion in {again}" in said(0, "data", "import", file, "--out", again, "--radius", 0.2)
    assert run("data", "check", again, "--no-pybullet", "--workers", 1) == 0


def test_info_on_motions_that_are_all_straight_warns_of_nothing(tmp_path: Path, recwarn: pytest.WarningsRecorder) -> None:
    line = HOME + np.linspace(0, 0.3, 5)[:, None]
    rd.write_dataset([line] * 20, [rd.Scene([rd.Sphere([-2, 0.1 * i, 1], 0.1)]) for i in range(20)], tmp_path / "d")
    assert run("data", "info", tmp_path / "d", "--page", tmp_path / "page.html") == 0
    assert (tmp_path / "page.html").is_file() and not (tmp_path / "d" / "report.html").exists()
    assert not [str(warning.message) for warning in recwarn if warning.category is UserWarning]
