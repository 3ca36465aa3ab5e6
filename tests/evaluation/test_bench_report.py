"""The report of a bench: figures by hand, tables, plots, the page, and the motions to replay."""

import json
import re
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

import robotdiffuse as rd
from helpers.commands import Said
from helpers.refusals import refuses
from robotdiffuse.core.tables import Table
from robotdiffuse.evaluation import bench_comparisons, bench_report
from robotdiffuse.evaluation.metrics import METRICS, Metric, measured
from robotdiffuse.evaluation.report import draw_plot
from robotdiffuse.evaluation.runs import RESTARTED, Record, case_file, record_of_row, record_path
from robotdiffuse.problems.files import Case, held_out_problem

RUN = {"date": "2026-01-02 03:04", "processor": "Abacus_9 & sons", "cores": 4, "python": "3.12", "versions": {"numpy": "2.0"}}
RUN |= {"workers": 1, "problems": ["rop"], "seeds": 3}
MEASURES = {"tip_length": 1.0, "turning": 0.5, "min_clearance": 0.01, "duration": 2.0, "jerk": 10.0}
MEASURES |= {"sparc_joint": -2.0, "sparc_tip": -2.0}


def record(planner: str, name: str, limit: float, **fields: object) -> Record:
    about = {"problem_set": "rop", "family": "rop", "trivial": False, "seed": 0}
    values = {"planner": planner, "name": name, "time_limit": limit} | about | fields
    return Record(**values)  # pyright: ignore[reportArgumentType]


def solved(
    planner: str, name: str, limit: float, progress: list[tuple[float, float]], time: float | None = None, **fields: object
) -> Record:
    """A record of a motion for which the paths of the links are three times as long [m] as the path in joint space [rad]."""
    length = progress[-1][1]
    values = {"status": "solved", "reason": "solved", "memory": 100.0, "positions": ((0.0,) * 7, (0.1,) * 7)}
    values |= {"time": progress[-1][0] if time is None else time, "progress": tuple(progress)}
    values |= {"measures": MEASURES | {"joint_length": length, "link_length": 3 * length}}
    return record(planner, name, limit, **(values | fields))


def failed(planner: str, name: str, limit: float, time: float, **fields: object) -> Record:
    return record(planner, name, limit, **({"status": "timeout", "reason": "no path", "time": time} | fields))


def write(folder: Path, records: list[Record], counts: dict[float, int | None] | None = None) -> Path:
    """Writes a run for each time limit, with all of its planners. `counts`: the numbers of problems of the runs, if not all."""
    (folder / "records").mkdir(parents=True)
    for record in records:
        with record_path(folder, record.planner).open("a") as stream:
            stream.write(json.dumps(record.row()) + "\n")
    for limit in sorted({record.time_limit for record in records}):
        planners = sorted({record.planner for record in records if record.time_limit == limit})
        run = RUN | {"planners": planners, "time_limit": limit, "count": (counts or {}).get(limit)}
        with (folder / "runs.jsonl").open("a") as stream:
            stream.write(json.dumps(run) + "\n")
    return folder


def keep_problems(folder: Path, names: list[str]) -> None:
    problem = held_out_problem("rop", 0)
    case_file(folder / "problems", "rop").fill([Case(n, "rop", problem, n == "rop/3") for n in names])


@pytest.fixture
def small(tmp_path: Path) -> Path:
    names = ["rop/0", "rop/1", "rop/2", "rop/3"]
    records = [solved("robotdiffuse", name, 1.0, [(0.05, 2.0)], trivial=name == "rop/3") for name in names]
    # the first path after 0.05, 0.5 and 5 s; the last problem beyond the limit of 10 s
    for name, first in zip(names[:3], (0.05, 0.5, 5.0), strict=True):
        records.append(solved("ompl_rrt_star", name, 10.0, [(first, 4.0), (first * 1.5, 3.0)], time=10.0))
    records.append(failed("ompl_rrt_star", names[3], 10.0, 10.0, trivial=True))
    records += [
        solved("mpnet", names[0], 1.0, [(0.02, 2.4)]),
        failed("mpnet", names[1], 1.0, 0.4, refused="scene_collision"),
        failed("mpnet", names[2], 1.0, 0.4),
        solved("mpnet", names[3], 1.0, [(0.02, 2.0)], trivial=True),
    ]
    return write(tmp_path / "small_run", records)


def rows(section: bench_comparisons.Section, limit: float) -> dict[str, bench_comparisons.Row]:
    (found,) = (c for c in section.comparisons if c.limit == limit)
    return {row.planner: row for row in found.rows}


def test_a_call_counts_for_shorter_limits_and_for_longer_ones_if_it_ended_by_itself() -> None:
    short = failed("mpnet", "a", 0.1, 0.1)
    middle = failed("mpnet", "a", 1.0, 0.5)
    long = failed("mpnet", "a", 10.0, 10.0)
    assert bench_comparisons.deciding_record([short, middle, long], 0.05) is short
    assert bench_comparisons.deciding_record([short, middle, long], 0.5) is middle
    assert bench_comparisons.deciding_record([short, middle, long], 5.0) is long
    assert bench_comparisons.deciding_record([short, middle, long], 60.0) is middle
    assert bench_comparisons.deciding_record([short], 1.0) is None
    assert bench_comparisons.deciding_record([failed("mpnet", "a", 1.0, 0.0, status="crashed")], 2.0) is None


def test_an_outcome_is_what_was_found_by_then() -> None:
    record = solved("ompl_rrt_star", "a", 10.0, [(0.5, 4.0), (2.0, 3.0)], time=10.0)
    before, between, after = (bench_comparisons.outcome(record, t) for t in (0.4, 1.0, 10.0))
    assert not before.solved and np.isnan(before.joint_length)
    assert before.returned == 0.4 and before.failure == bench_comparisons.LATER
    assert (between.found, between.returned) == (0.5, 1.0)
    assert (between.joint_length, between.link_length) == (4.0, pytest.approx(12.0))  # 9 x 4 / 3
    assert (after.joint_length, after.link_length) == (3.0, 9.0)
    # the validator may end after the limit of the call alone
    assert bench_comparisons.outcome(solved("mpd", "a", 1.0, [(1.08, 4.0)]), 1.0).found == 1.0
    assert not bench_comparisons.outcome(solved("mpd", "a", 1.0, [(1.2, 4.0)]), 1.0).solved
    assert not bench_comparisons.outcome(solved("mpd", "a", 2.0, [(1.08, 4.0)]), 1.0).solved


def test_figures_of_a_small_run(small: Path) -> None:
    bench = bench_comparisons.read_bench(small)
    assert next(iter(bench.records)) == bench.reference == "robotdiffuse"
    assert set(bench.records) == {"robotdiffuse", "mpnet", "ompl_rrt_star"}
    whole, apart = bench_comparisons.sections(bench)
    assert (whole.name, apart.name) == ("rop", "rop, non-trivial")
    assert [c.limit for c in whole.comparisons] == [0.1, 1.0, 10.0]
    assert [[c.problems for c in of.comparisons] for of in (whole, apart)] == [[4, 4, 4], [3, 3, 3]]
    star = [rows(whole, t)["ompl_rrt_star"] for t in (0.1, 1.0, 10.0)]
    assert [row.figures.success for row in star] == [25, 50, 75]
    assert star[0].figures.length == 9.0  # improved by 0.075 s
    assert [o.found for o in star[1].solved] == [0.05, 0.5]
    assert star[1].figures.time == 1.0 and star[2].failures == {bench_comparisons.RAN_OUT: 1}
    net = rows(whole, 1.0)["mpnet"]
    assert (net.figures.success, net.figures.collision) == (50, 25)
    assert str(net.success) == "50.0 (15.0 to 85.0)"
    assert net.failures == {"scene collision": 1, bench_comparisons.GAVE_UP: 1}
    assert net.figures.time == pytest.approx((0.02 + 1 + 1 + 0.02) / 4)
    assert net.paired is not None
    assert (net.paired.a_only, net.paired.b_only, net.paired.both) == (0, 2, 2)
    assert net.paired.ratio == pytest.approx(1.1)  # of 1.2 and 1
    assert net.figures.length == pytest.approx(3 * 2.2)
    assert rows(whole, 10.0)["mpnet"].figures.success == 50  # it ended by itself
    figures = {"robotdiffuse": (1, 1, 6.0, 0.05), "mpnet": (0, 0, 6.6, 0.51), "ompl_rrt_star": (0, 1, 9.0, 1.0)}
    for name, (success, collision, length, time) in figures.items():
        score = (success + collision + (9.0 - length) / 3.0 + (1.0 - time) / 0.95) / 4
        assert rows(whole, 1.0)[name].comscore == pytest.approx(score)


def test_compared_are_problems_that_all_planners_were_given_this_time_for(tmp_path: Path) -> None:
    names = [f"rop/{i}" for i in range(6)]
    records = [solved("robotdiffuse", name, 10.0, [(0.1, 2.0)]) for name in names]
    # of the last four, a 10 s run did not get to, the easy ones ended by themselves in 1 s
    records += [failed("mpd", name, 10.0, 10.0) for name in names[:2]]
    records += [solved("mpd", name, 1.0, [(0.1, 2.0)]) for name in names[2:4]]
    records += [failed("mpd", name, 1.0, 1.0) for name in names[4:]]
    records += [failed("edmp", name, 1.0, 1.0) for name in names]
    folder = write(tmp_path / "run", records, {10.0: 2})
    keep_problems(folder, names)
    (section,) = bench_comparisons.sections(bench_comparisons.read_bench(folder))
    whole = {c.limit: c for c in section.comparisons}
    assert whole[1.0].problems == 6 and whole[1.0].missing == ()
    assert (whole[10.0].problems, whole[10.0].section_problems) == (2, 6)
    assert whole[10.0].missing == ("edmp",)
    assert rows(section, 10.0)["mpd"].figures.success == 0 and section.main.limit == 1.0


def test_seeds_of_a_problem_are_one_row_of_the_comparison(tmp_path: Path) -> None:
    records = [solved("robotdiffuse", name, 1.0, [(0.1, 2.0)], seed=seed) for name in "ab" for seed in range(3)]
    records += [solved("mpd", "a", 1.0, [(0.1, 2.0 + seed)], seed=seed) for seed in range(3)]
    records += [solved("mpd", "b", 1.0, [(0.1, 2.0)]), *(failed("mpd", "b", 1.0, 1.0, seed=seed) for seed in (1, 2))]
    (section,) = bench_comparisons.sections(bench_comparisons.read_bench(write(tmp_path / "run", records)), [1.0])
    row = rows(section, 1.0)["mpd"]
    assert section.main.seeds == 3 and row.figures.success == pytest.approx(400 / 6)
    assert row.paired is not None and (row.paired.both, row.paired.b_only) == (1, 1)
    assert row.paired.ratio == pytest.approx(1.5)


def test_intervals_are_over_problems_not_over_their_seeds(tmp_path: Path) -> None:
    records = [
        solved("mpd", name, 1.0, [(0.1, 2.0)], seed=seed, measures=MEASURES | {"duration": duration})
        for name, duration in {"a": 1.0, "b": 2.0, "c": 4.0}.items()
        for seed in range(8)
    ]
    (section,) = bench_comparisons.sections(bench_comparisons.read_bench(write(tmp_path / "run", records)), [1.0])
    row = rows(section, 1.0)["mpd"]
    half = 1.96 * np.std([1, 2, 4], ddof=1) / np.sqrt(3)
    assert str(row.mean(METRICS["duration"])) == f"{7 / 3:.2f} ± {half:.2f}"
    assert str(row.success) == str(bench_report.success_in("rop", row)) == "100.0 (43.9 to 100.0)"  # of three


def test_a_run_without_a_count_has_the_families_default_count(tmp_path: Path) -> None:
    """Regression: problems beyond it counted, too, if a shorter run had solved them early."""
    names = [f"rop/{i}" for i in range(bench_comparisons.FAMILY_COUNT + 40)]
    records = [solved("mpd", name, 0.1, [(0.01, 2.0)]) for name in names[::2]]
    records += [failed("mpd", name, 0.1, 0.1) for name in names[1::2]]
    records += [failed("mpd", name, 1.0, 1.0) for name in names[: bench_comparisons.FAMILY_COUNT][1::2]]
    folder = write(tmp_path / "run", records, {0.1: len(names)})
    sections = bench_comparisons.sections(bench_comparisons.read_bench(folder), [1.0])
    assert sections[0].comparisons[0].problems == bench_comparisons.FAMILY_COUNT


def test_curves_end_where_they_are_no_longer_known_of_all_problems(small: Path) -> None:
    whole, _ = bench_comparisons.sections(bench_comparisons.read_bench(small))
    curves = {curve.planner: curve for curve in whole.curves}
    assert curves["mpnet"].end == 10.0
    assert curves["ompl_rrt_star"].found.tolist() == [0.05, 0.5, 5.0]
    # best known 2: first paths of 4, the second of the three at 0.5 s; 3 from 0.75 s on
    star = curves["ompl_rrt_star"]
    assert star.times[0] == pytest.approx(0.5, rel=0.06) and star.ratios[0] == 2.0
    assert star.ratios[-1] == 1.5


def cells(table: Table, heading: str) -> dict[str, str]:
    column = [column.title.strip() for column in table.columns].index(heading)
    return {row[0]: row[column] for row in table.texts}


def test_lengths_are_compared_at_equal_time(tmp_path: Path) -> None:
    """Planners that end early are restarted, in rows of their own; planners that use up the limit are not."""
    records = []
    for name in ("rop/0", "rop/1", "rop/2"):
        records += [
            solved("robotdiffuse", name, 1.0, [(0.05, 2.0)]),
            solved("robotdiffuse" + RESTARTED, name, 1.0, [(0.05, 2.0), (0.6, 1.6)], 0.99, restarts=19),
            solved("rrt_connect", name, 1.0, [(0.01, 2.4)]),
            solved("rrt_connect" + RESTARTED, name, 1.0, [(0.01, 2.4), (0.3, 1.8)], 0.99, restarts=90),
            solved("ompl_aorrtc", name, 1.0, [(0.01, 2.4), (0.3, 1.6)], 0.99),
        ]
    records.append(failed("rrt_connect", "rop/3", 1.0, 1.0))  # which stands for its restarts
    bench = bench_comparisons.read_bench(write(tmp_path / "run", records))
    assert list(bench.records)[:2] == ["robotdiffuse", "robotdiffuse+restarts"]
    again = bench.records["rrt_connect" + RESTARTED]
    assert [record.name for record in again] == [f"rop/{i}" for i in range(4)]
    assert {record.planner for record in again} == {"rrt_connect+restarts"}
    section = bench_comparisons.sections(bench)[-1]
    table = bench_report.main_table(section, section.main, bench.reference)
    expected = {"robotdiffuse": "–", "robotdiffuse, restarted": "1", "rrt_connect": "–"}
    expected |= {"rrt_connect, restarted": "1.125 (1.125 to 1.125)", "ompl_aorrtc": "1.000 (1.000 to 1.000)"}
    assert cells(table, "joint length / robotdiffuse, restarted") == expected
    assert cells(table, "ComScore")["rrt_connect, restarted"] == "–"
    tenth = bench_report.main_table(section, section.comparisons[0], bench.reference)
    assert cells(tenth, "joint length / robotdiffuse, restarted")["rrt_connect, restarted"].startswith("1.200 ")
    plain = bench_comparisons.read_bench(bench.folder, ["robotdiffuse", "rrt_connect"])
    assert len(plain.records) == 4
    alone = replace(plain, records={n: r for n, r in plain.records.items() if RESTARTED not in n})
    section = bench_comparisons.sections(alone)[-1]
    table = bench_report.main_table(section, section.main, alone.reference)
    assert cells(table, "joint length / robotdiffuse") == {"robotdiffuse": "1", "rrt_connect": "1.200 (1.200 to 1.200) †"}
    assert bench_report.UNEQUAL_NOTE in table.notes


def test_rows_that_were_timed_under_other_loads_are_told_in_the_table(tmp_path: Path) -> None:
    names = [f"rop/{i}" for i in range(3)]
    first = [solved("robotdiffuse", n, 1.0, [(0.05, 2.0)], run="a", workers=2, load=1.5) for n in names]
    same = [solved("rrt_connect", n, 1.0, [(0.05, 2.0)], run="a", workers=2, load=2.25) for n in names]
    other = [solved("mpd", n, 1.0, [(0.05, 2.0)], run="b", workers=1, load=0.5) for n in names]
    folder = write(tmp_path / "run", [*first, *same, *other])
    every = RUN | {"planners": [], "time_limit": 1.0, "count": 3}
    runs = [every | {"run": run, "workers": workers} for run, workers in (("a", 2), ("b", 1))]
    (folder / "runs.jsonl").write_text("".join(json.dumps(run) + "\n" for run in runs))
    bench = bench_comparisons.read_bench(folder)
    (section,) = bench_comparisons.sections(bench, [1.0])
    table = bench_report.main_table(section, section.main, bench.reference)
    timed = dict.fromkeys(("robotdiffuse", "rrt_connect"), "run a, 2 at once") | {"mpd": "run b, 1 at once"}
    assert cells(table, "timed") == timed
    assert "Not all rows were timed alike" in table.notes[0]
    bench = bench_comparisons.read_bench(folder, ["robotdiffuse", "rrt_connect"])
    (section,) = bench_comparisons.sections(bench, [1.0])
    table = bench_report.main_table(section, section.main, bench.reference)
    assert table.columns[-1].heading == "ComScore"
    assert table.notes[0] == "All rows were timed alike: run a, 2 at once; load average 1.5 to 2.2."


def test_a_metric_is_declared_in_one_place(small, tmp_path, monkeypatch):
    pytest.importorskip("matplotlib")
    waypoints = Metric("waypoint_count", "kilo", "less", ".4f", lambda m: len(m.path.positions), 1e-3)
    monkeypatch.setitem(METRICS, waypoints.name, waypoints)
    problem = held_out_problem("rop", 0)
    line = np.stack([problem.start, problem.start + 0.1, problem.start])
    figures = measured(problem.robot, rd.Path(problem.robot.joint_names, line))
    record = solved("robotdiffuse", "rop/9", 1.0, [(0.1, 0.5)], measures=figures)
    assert record.row()["waypoint_count"] == 3
    assert record_of_row(json.loads(json.dumps(record.row()))) == record
    bench = bench_comparisons.read_bench(write(tmp_path / "run", [record]))
    report = bench_report.bench_report(bench, bench_comparisons.sections(bench, [1.0]))
    assert re.search(r"waypoint count kilo .*\n.*\n.* 0.0030 ", report.markdown)
    assert re.search(r"<th[^>]*>waypoint count kilo</th>", report.page) and re.search(r"<td[^>]*>0.0030</td>", report.page)


@pytest.mark.slow
def test_the_command_writes_everything_also_to_a_folder_that_does_not_exist(small, tmp_path, said: Said):
    pytest.importorskip("matplotlib")
    keep_problems(small, ["rop/0", "rop/1"])
    out = tmp_path / "out"
    printed = said(0, "bench", "report", small, "--out", out, "--limits", "1,10", "--no-replays")
    assert "rop, non-trivial, 10 s: 3 problems" in printed and "ompl_rrt_star" in printed
    page = (out / "index.html").read_text()
    assert bench_report.UNEQUAL_NOTE in page and "`" not in page
    for name in ("robotdiffuse", "mpnet", "ompl_rrt_star"):
        assert page.count(f">{name}<") >= 4, name
    assert "http" not in re.sub(r'xmlns(:\w+)?="[^"]*"|<metadata>.*?</metadata>', "", page, flags=re.DOTALL)
    ids = re.findall(r'\bid="([^"]*)"', page)
    assert len(ids) == len(set(ids)) and not (out / "replays.html").exists()
    plots = re.findall(r"!\[.*?\]\((.*?)\)", (out / "report.md").read_text())
    assert {"success_rop.svg", "length_rop_non_trivial.svg"} < set(plots)
    for name in plots:
        assert ElementTree.parse(out / name).getroot().tag.endswith("svg")
    said(0, "bench", "report", small, "--out", tmp_path / "new" / "report")
    assert {"index.html", "replays.html", "report.md"} < {file.name for file in (tmp_path / "new" / "report").iterdir()}


def test_no_legend_or_name_is_clipped() -> None:
    """Regression: names of planners with settings were cut off at the edge of a plot."""
    pytest.importorskip("matplotlib")
    sizes = []
    for name in ("a", "robotdiffuse:iterations=5000+restarts"):
        svg = draw_plot(lambda figure, name=name: figure.text(0.9, 0.5, name))
        sizes.append(float(ElementTree.fromstring(svg).attrib["viewBox"].split()[2]))
    assert sizes[1] > sizes[0] + 50


def test_what_is_shown_is_hard_or_failed(small: Path) -> None:
    keep_problems(small, [f"rop/{i}" for i in range(4)])
    bench = bench_comparisons.read_bench(small)
    shown = bench_report.motions_to_replay(bench, bench_comparisons.sections(bench, [1.0]))
    titles = [motion.title for motion in shown]
    assert titles[0] == "robotdiffuse · rop/0"  # solved by all; made up as one and the same
    assert "ompl_rrt_star · rop/0" in titles
    assert {title for title in titles if "fails" in title} == {"mpnet fails · rop/2", "ompl_rrt_star fails · rop/3"}
    captions = {motion.title: motion.caption for motion in shown}
    assert captions["mpnet fails · rop/2"].startswith("gave up before; shown: robotdiffuse")
    assert not any("Figure(" in caption for caption in captions.values())
    assert len(shown) <= bench_report.MAX_REPLAYS


def test_bad_input_is_one_clear_line(small: Path, said: Said) -> None:
    (small / "new" / "records").mkdir(parents=True)
    (small / "new" / "records" / "mpnet.jsonl").touch()
    refuses("no records yet", bench_comparisons.read_bench, small / "new")
    refuses(r"no records of foo; it has .*mpnet, ", bench_comparisons.read_bench, small, ["foo"])
    alone = bench_comparisons.read_bench(small, ["ompl_rrt_star"])
    refuses("no planner was run that long", bench_comparisons.sections, alone, [60.0])
    (small / "runs.jsonl").write_text('{"date": 1}\n')
    refuses(r"runs\.jsonl is damaged", bench_comparisons.read_bench, small)
    with (small / "records" / "mpnet.jsonl").open("a") as stream:
        stream.write("{broken\n")
    assert "mpnet.jsonl, line 5 is not a JSON object" in said(2, "bench", "report", small)
