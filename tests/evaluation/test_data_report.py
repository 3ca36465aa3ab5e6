"""The figures of a data set against figures by hand, and the page that shows them."""

import re

import numpy as np
import pytest

pytest.importorskip("matplotlib")

import robotdiffuse as rd
from helpers.box_arm import box_arm
from helpers.stores import random_motions, write_motions
from robotdiffuse.evaluation import data_report

ARM = box_arm()


@pytest.fixture
def rows():
    return random_motions(ARM, 11)


def test_figures(tmp_path, rows):
    write_motions(tmp_path, ARM, rows, shard=4)
    found = data_report.read_figures(tmp_path)
    costs = np.array([row["cost"] for row in rows])
    assert (found.trajectories, found.manifest.trajectories, found.shards) == (11, 11, 3)
    assert data_report.facts(found)[:2] == [("motions", "11"), ("waypoints, evenly spaced in length", "220")]
    assert found.counts == {"tried": 17, "solved": 11, "unsolved": 3, "refused": 0, "thinned": 3}
    assert sum(found.splits.values()) == 11 and list(found.splits) == ["train", "validation", "test"]
    _, families, spreads = data_report.tables(found)
    assert [row[:2] for row in families.rows] == [("rop", 6), ("rop_dense", 5)]
    lengths = [costs.mean(), *np.quantile(costs, [0, 0.05, 0.5, 0.95, 1])]
    assert spreads.texts[0] == ["length [rad]", *(f"{length:.3f}" for length in lengths)]
    assert spreads.texts[1][1:] == ["1.000"] * 6
    assert families.columns[5].heading == "trivial"
    free = [[row["line_free"] for row in rows if row["family"] == family] for family in (0, 1)]
    assert [row[5] for row in families.rows] == [pytest.approx(np.mean(each)) for each in free]
    shares = np.array([row[5:13] for row in families.rows], float)
    assert np.allclose(shares[:, :4].sum(axis=1), 1) and np.allclose(shares[:, 4:].sum(axis=1), 1)
    assert found.safety_distance == pytest.approx(0.05)
    assert [text for _, text in data_report.facts(found)[4:]] == [
        "78.6 %; tried: 17, of these 3 unsolved, 0 refused, 3 thinned",  # 11 of 14
        "100.0 %",
        "100.0 %",
        "1.0",
        "63.6 %",  # 7 of 11
    ]
    assert found.bytes == sum(f.stat().st_size for f in tmp_path.glob("*.zarr/**/*") if f.is_file())


def test_large_sets_are_sampled_evenly(tmp_path, rows, monkeypatch):
    monkeypatch.setattr(data_report, "SAMPLED_MOTIONS", 4)
    write_motions(tmp_path, ARM, rows, shard=3)
    found = data_report.read_figures(tmp_path)
    assert len(found.all["cost"]) == 11
    chosen = [rows[i] for i in (0, 2, 4, 6, 8, 10)]
    costs = [row["goal_costs"] for row in chosen]
    np.testing.assert_allclose(found.sample["goal_costs"], costs, rtol=1e-6)
    kept = found.sample["trajectories"]
    assert kept.shape == (6, min(data_report.SAMPLED_WAYPOINTS, 20), 3)
    assert np.array_equal(kept[:, [0, -1]], [row["trajectories"][[0, -1]] for row in chosen])


def test_page(tmp_path, rows):
    data = tmp_path / "arm <1>"
    file = tmp_path / "report.html"
    write_motions(data, ARM, rows)
    data_report.write_page(data, file, ARM)
    page = file.read_text("utf-8")
    assert page.count("<svg") == 3
    told = "91.7 %; tried: 13, of these 1 unsolved, 0 refused, 1 thinned", "clearance [cm]", "up to 5 % longer"
    for text in ("arm &lt;1&gt;", "rop_dense", *told, *ARM.joint_names):
        assert text in page, text
    assert "arm <1>" not in page
    addresses = set(re.findall(r"""(?:src|href)=["'](.*?)["']""", page))
    assert all(address.startswith(("data:", "#")) for address in addresses), "it must open without network"
    before = file.read_bytes()
    data_report.write_page(data, file, ARM)
    assert file.read_bytes() == before


def test_page_of_hardly_any_motions(tmp_path, rows):
    write_motions(tmp_path, ARM, rows[:1])
    data_report.write_page(tmp_path, tmp_path / "report.html", ARM)


def test_other_robots_and_endings_are_refused(tmp_path, rows):
    write_motions(tmp_path, ARM, rows)
    panda = rd.load_robot("panda")
    for file, robot, message in (("a.pdf", ARM, "unknown ending"), ("a.html", panda, "fingerprint")):
        with pytest.raises(rd.InputError, match=message):
            data_report.write_page(tmp_path, tmp_path / file, robot)
