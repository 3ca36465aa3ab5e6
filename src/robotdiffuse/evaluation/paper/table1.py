"""The paper's Table 1: every row on the same problems, with the paper's figures beside ours."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path as FilePath
from typing import NamedTuple

from robotdiffuse.core.errors import InputError
from robotdiffuse.evaluation.bench.figures import Mean
from robotdiffuse.evaluation.bench.run_folder import Bench, read_bench
from robotdiffuse.evaluation.bench.runner import BenchSettings, Done, Report, run_bench
from robotdiffuse.evaluation.metrics import METRICS
from robotdiffuse.evaluation.paper.comscore import PAPER_TABLE_1, Indicators, comscores
from robotdiffuse.evaluation.paper.problems import GOALS, POSE, case_name, problem_file, write_problems
from robotdiffuse.evaluation.records import Record
from robotdiffuse.evaluation.statistics import wilson_interval
from robotdiffuse.evaluation.tables import Column, Figure, Table
from robotdiffuse.learning.motion_model import MotionModelSettings
from robotdiffuse.learning.weight_files import read_description
from robotdiffuse.learning.weights_registry import POINTS, folder_of

AS_IN_PAPER = "diffusion, as the paper says"
WITHOUT_CLEARANCES = "diffusion, no clearances, one unguided sample"
PAPER_PARTS = "compression_autoencoder", "transformer", 254
"""Encoder, denoiser and waypoints of the paper's method."""
PAPER_SAMPLES = 1_600_000
"""Samples of the paper's training: 25,000 batches of 64."""
ONE_SAMPLE = ("samples=1", "guidance_steps=0", "repeat=false")
"""One sample, no guidance by distances, no further batches where the validator refuses it."""
NO_WEIGHTS = (
    f"{AS_IN_PAPER}: no weights of its size and with its encoder. Train them with `robotdiffuse train "
    "planner --config paper --data FOLDER --encoder FOLDER --out FOLDER` and name them by --paper-weights."
)
OURS = "RobotDiffuse"
"""The paper's name of its own row."""


class Row(NamedTuple):
    name: str
    planner: str
    """As for `bench run`."""
    paper: str = ""
    """Name of the paper's row; empty if it has none."""


ROWS = (
    Row("RRT* (OMPL)", "ompl_rrt_star", "RRT*"),
    Row("MPNet", "mpnet", "MPNet"),
    Row("MPiNets", "mpinets", "MPiNets"),
    Row("MPD", "mpd", "MPD"),
    Row("diffusion, as it ships: clearances as inputs", "diffusion", OURS),
    Row("diffusion, a single sample", "diffusion:samples=1:repeat=false"),
    Row("diffusion, a single sample, no guidance", ":".join(["diffusion", *ONE_SAMPLE])),
    Row("the same, no clearances: 32 points of the scene", ":".join([f"diffusion@{POINTS}", *ONE_SAMPLE])),
    Row("robotdiffuse (hybrid)", "robotdiffuse"),
    Row("aorrtc", "aorrtc"),
    Row("no planner: line to the nearest goal", "straight_line:goals=nearest"),
    Row("no planner: line to any goal", "straight_line"),
)
MEASURES = ("link_length", "joint_length", "duration", "jerk", "turning")
"""Metrics of the solved motions that the table has."""


@dataclass(frozen=True)
class Table1Settings:
    out: FilePath
    """Folder of the bench."""
    problems: int = 300
    """Of each kind of goal."""
    time_limit: float = 10.0
    """Of a call [s]; RRT* uses all of it."""
    paper_weights: str | None = None
    """Folder with weights of config `paper`, `points` or another one without clearances as inputs, for a row
    of single samples without guidance."""
    workers: int = 1
    cluster: str | None = None
    """As for `BenchSettings`."""

    @property
    def rows(self) -> tuple[Row, ...]:
        """Of the table; without clearances as inputs only with weights for it."""
        if self.paper_weights is None:
            return ROWS
        planner = ":".join([f"diffusion@{self.paper_weights}", *ONE_SAMPLE])
        return (*ROWS[:5], Row(_title(self.paper_weights), planner), *ROWS[5:])

    @property
    def bench(self) -> BenchSettings:
        return BenchSettings(
            planners=tuple(row.planner for row in self.rows),
            problems=tuple(str(problem_file(self.out, name)) for name in GOALS),
            out=self.out,
            time_limit=self.time_limit,
            count=self.problems,
            workers=self.workers,
            cluster=self.cluster,
        )


def run_table1(settings: Table1Settings, report: Report, done: Done) -> Bench:
    """Make the calls that are missing in the folder; the bench with all of them.

    Raises InputError for paper weights with clearances as inputs, and as `run_bench` does.
    """
    if settings.paper_weights is not None:
        _check_paper_weights(settings.paper_weights)
    write_problems(settings.out, settings.problems, report)
    run_bench(settings.bench, report, done)
    return read_bench(settings.out, list(settings.bench.specs))


def _title(folder: str) -> str:
    """The name of the row of a folder's weights: what they are. Raises InputError if there are none."""
    about = read_description(folder_of(folder), "model")
    of = MotionModelSettings.from_json(about.get("settings"), f"{folder}/model.json: settings")
    title = AS_IN_PAPER if (of.encoder, of.denoiser, of.waypoints) == PAPER_PARTS else WITHOUT_CLEARANCES
    seen = about.get("training", {}).get("samples", 0.0) / PAPER_SAMPLES
    return f"{title}: {of.encoder}, {of.denoiser}, {100 * seen:.0f} % of {PAPER_SAMPLES / 1e6:g} M samples"


def _check_paper_weights(folder: str) -> None:
    """Raises InputError for weights that get the clearances of the scene as inputs."""
    from robotdiffuse.learning.exported_model import exported_model
    from robotdiffuse.robots import load_robot

    if exported_model("model", folder, load_robot("panda")).settings.clearance_features:
        raise InputError(
            f"paper_weights is {folder}, whose inputs include clearances; the paper's method sees the scene "
            "by its code alone: train with --config paper or points"
        )


def tables(settings: Table1Settings, bench: Bench) -> list[Table]:
    """A table for each kind of goal, on all problems and on those that are not trivial."""
    labels = dict(zip((row.name for row in settings.rows), settings.bench.specs, strict=True))
    found = []
    for problem_set, goal in GOALS.items():
        names = {case_name(problem_set, i) for i in range(settings.problems)}  # the folder may have more
        of = {
            name: [r for r in bench.records[label] if r.name in names and r.time_limit == settings.time_limit]
            for name, label in labels.items()
        }
        solvable = {r.name for records in of.values() for r in records if r.solved}
        parts = {
            "all problems": of,
            "not trivial, and solved by some row": {
                name: [r for r in records if not r.trivial and r.name in solvable]
                for name, records in of.items()
            },
        }
        for part, records in parts.items():
            n = len(next(iter(records.values())))
            if not n:
                continue
            title = f"Goal: {goal}; {part}: {n}"
            beside = problem_set == POSE and part == "all problems"
            found.append(_table(title, settings.rows, records, beside))
    return found


def indicators(records: Sequence[Record]) -> Indicators:
    """The figures that ComScore weighs; an unsolved call counts with its own time."""
    solved = [r for r in records if r.solved]
    return Indicators(
        100 * len(solved) / max(len(records), 1),
        100 * sum(r.in_collision for r in records) / max(len(records), 1),
        Mean.of(r.measures["link_length"] for r in solved).value,
        Mean.of(r.time for r in records).value,
    )


def scores(rows: Sequence[Row], of: dict[str, Indicators]) -> dict[str, float]:
    """ComScores among the paper's five rows; each further row takes the place of the paper's method."""
    ours = next(row.name for row in rows if row.paper == OURS)
    others = [row.name for row in rows if row.paper and row.paper != OURS]
    among = {
        name: comscores([of[other] for other in others] + [of[name]]) for name in of if name not in others
    }
    return {other: float(among[ours][i]) for i, other in enumerate(others)} | {
        name: float(values[-1]) for name, values in among.items()
    }


def _share(part: int, whole: int) -> tuple[float | None, str]:
    low, high = (100 * x for x in wilson_interval(part, whole))
    return 100 * part / max(whole, 1), f"{low:.1f} to {high:.1f}"


def _table(title: str, rows: Sequence[Row], records: dict[str, list[Record]], beside: bool) -> Table:
    """beside: whether the paper's figures are in the table."""
    found = {name: indicators(of) for name, of in records.items()}
    comscore = scores(rows, found)
    printed = {row.name: row for row in PAPER_TABLE_1}
    cells = []
    for row in rows:
        of = records[row.name]
        solved = [r for r in of if r.solved]
        means = [Mean.of(r.measures[m] for r in solved if m in r.measures) for m in MEASURES]
        paper = printed.get(row.paper)
        p = None if paper is None else paper.indicators
        cells.append(
            (
                row.name,
                *_share(len(solved), len(of)),
                *_share(sum(r.in_collision for r in of), len(of)),
                *(
                    Figure(f"{x.value:{METRICS[m].format}} ± {x.half:{METRICS[m].format}}", x.value)
                    if len(solved) > 1
                    else None
                    for m, x in zip(MEASURES, means, strict=True)
                ),
                found[row.name].time,
                comscore[row.name],
                *((p and p.success, p and p.collision, p and p.length, p and p.time) if beside else ()),
                *((paper and paper.comscore,) if beside else ()),
            )
        )
    columns = (
        "row",
        Column("success", "%", ".1f", "more"),
        Column("95 %", dim=True),
        Column("collision", "%", ".1f", "less"),
        Column("95 % ", dim=True),
        Column("length of links 1 to 7", "m"),
        Column("joint length", "rad"),
        Column("duration", "s"),
        Column("log jerk"),
        Column("turning", "rad"),
        Column("time", "s", ".3g", "less"),
        Column("ComScore", "", ".3f", "more"),
        *(("paper: suc", "col", "len", "time", "ComScore ") if beside else ()),
    )
    return Table.of(title, columns, cells)


def notes(settings: Table1Settings) -> list[str]:
    """How to read the tables."""
    found = [
        f"Every call has {settings.time_limit:g} s, in the paper up to 600. RRT* searches until then, unless "
        "it has the straight line.",
        "success: the motion passes the validator and ends within 1 cm and 15° of the pose, with the 95 % "
        "interval by Wilson. collision: share of problems on which the validator refused the planner's last "
        "path because it collides. RRT*, MPNet, MPiNets, MPD and diffusion as it ships try again until time "
        "runs out; the rows of a single sample have one motion a problem, as in the paper, whose training "
        "saw 1.6 M samples.",
        "Means are over the problems that a row solves, with 95 % intervals: rows that solve only easy "
        "problems seem short. length of links 1 to 7: path lengths of the origins of the links that joints "
        "move, which the paper calls path length (its arm has no hand; it names no unit). log jerk: "
        "logarithm of the dimensionless jerk; turning: sum of the angles between segments.",
        "trivial: the straight line to any goal configuration is free. ComScore: as in the paper, among its "
        "five rows; each further row takes the place of the paper's method.",
        "robotdiffuse and aorrtc minimize the duration, their default. time: mean until the planner returns; "
        "the machine may do other work.",
    ]
    return found if settings.paper_weights is not None else [NO_WEIGHTS, *found]
