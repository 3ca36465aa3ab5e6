"""The paper's problems, its Table 1 and its figures, compared with results of this package.

Start and goal points are drawn as the authors draw them: uniformly in a box. Inverse kinematics finds a start
configuration and a goal configuration for these positions, with any orientation. The goal of a problem is
either the goal configuration or the tip's pose at this configuration. For a goal pose, planners find up to
ten configurations. A motion succeeds if it ends within 1 cm and 15 degrees of the pose.
"""

import itertools
import timeit
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path as FilePath
from typing import Any, NamedTuple

import numpy as np
from numpy import ndarray

from robotdiffuse.baselines.controls import NEAREST
from robotdiffuse.collision import CollisionChecker
from robotdiffuse.core.errors import InputError, counted
from robotdiffuse.core.tables import Column, Table, plain
from robotdiffuse.core.types import Configurations, Done, Path
from robotdiffuse.evaluation.bench import BenchSettings, run_bench
from robotdiffuse.evaluation.bench_comparisons import (
    Bench,
    Indicators,
    Mean,
    Section,
    bootstrap_interval,
    comscores,
    read_bench,
    sections,
    wilson_interval,
)
from robotdiffuse.evaluation.bench_report import about, crashes, success_over_time
from robotdiffuse.evaluation.metrics import METRICS
from robotdiffuse.evaluation.report import Report, draw_plot, share_cell
from robotdiffuse.evaluation.runs import (
    NETWORK_ALONE,
    Record,
    from_network,
    hard_cases,
    read_cases,
    run_all,
    sampled,
    sampling_digest,
    validator,
)
from robotdiffuse.learning.diffusion import SAMPLERS
from robotdiffuse.learning.motion_model import MotionModelSettings, link_clearances
from robotdiffuse.learning.weight_files import POINTS, folder_of, read_description, weights_for
from robotdiffuse.planning.diffusion import Diffusion, DiffusionSettings, encode
from robotdiffuse.planning.pose_goals import GOAL_COUNT, pose_configurations
from robotdiffuse.problems.families.family import POSITION
from robotdiffuse.problems.families.rop import ROP, Rop
from robotdiffuse.problems.files import SEED, Case, CaseFile, Progress, goal_of
from robotdiffuse.problems.problem import JointGoal, PoseGoal, Problem
from robotdiffuse.robots import load_robot


def paper_report(title: str, command: str) -> Report:
    """A report that reproduces a part of the paper; `command` is the command for it."""
    report = Report(f"{title} of the paper, beside ours")
    report.add(f"```sh\n{command}\n```")
    return report


def add_notes(report: Report, notes: Sequence[str]) -> None:
    report.add("## Notes")
    report.items(map(plain, notes))


# Problems

POSE = "rop_pose"
JOINT = "rop_joint"
"""Problem sets. A problem with the same number has the same scene and start in both; the goal is a pose
(POSE) or one configuration (JOINT). Each set leaves out its own trivial problems."""
GOALS = {POSE: "a pose with ten configurations", JOINT: "one configuration"}
STREAM = 1_000
"""Part of the random seed, different from that of the families' held-out problems."""


def draw_problem(number: int) -> dict[str, Problem]:
    """The problems with this number for the Panda, by problem set."""
    robot = load_robot("panda")
    rng = np.random.default_rng([SEED, STREAM, number])
    sample = ROP.draw(robot, rng, 1, POSITION)
    return {
        POSE: Problem(robot, sample.scene, sample.start, PoseGoal(robot.tip, sample.T_base_tip)),
        JOINT: sample.problem(robot),
    }


def goal_configurations(problem: Problem) -> Configurations:
    """The goal configurations of a problem. For a pose, these are at most ten collision-free configurations:
    those that a planner finds when it is called with seed 0."""
    if isinstance(problem.goal, JointGoal):
        return problem.goal.positions
    assert isinstance(problem.goal, PoseGoal)
    checker = CollisionChecker(problem.robot, problem.scene)
    return pose_configurations(problem, problem.goal, np.random.default_rng(0), checker.free)


def free_lines(problem: Problem, goals: Configurations) -> list[float | None]:
    """Lengths of the straight lines from the start to goal configurations [rad], the nearest goal first; None
    for lines that the validator refuses."""
    order = np.argsort(np.linalg.norm(goals - problem.start, axis=1))
    lines = [Path(problem.robot.joint_names, np.stack([problem.start, q])) for q in goals[order]]
    return [line.length if validator(problem, line) else None for line in lines]


def problem_file(out: FilePath, problem_set: str) -> FilePath:
    """The file of a problem set in the folder of a bench. `bench run` takes this path as a problem set."""
    return out / "problems" / f"{problem_set}.jsonl"


def write_problems(out: FilePath, count: int, report: Progress) -> None:
    """Draw the first `count` non-trivial problems of each set and write them into the folder of a bench,
    unless the folder has as many already."""
    files = {name: CaseFile(problem_file(out, name)) for name in GOALS}
    if min(map(len, files.values())) < count:
        cases: dict[str, list[Case]] = {name: [] for name in GOALS}
        for number in itertools.count():
            for name, problem in draw_problem(number).items():
                if len(cases[name]) < count and not any(free_lines(problem, goal_configurations(problem))):
                    cases[name].append(Case(f"{name}/{number}", "rop", problem, False, None, name))
            if all(len(drawn_cases) == count for drawn_cases in cases.values()):
                break
        for name, file in files.items():
            file.fill(cases[name])
        report(f"problems: {count} of {', '.join(GOALS)}")


def trivial_share(out: FilePath, problem_set: str) -> float:
    """The fraction of trivial problems among all problems that were drawn to complete the set."""
    cases = CaseFile(problem_file(out, problem_set)).cases()
    return 1 - len(cases) / (1 + int(cases[-1].name.partition("/")[2]))


def straight_line_counts(count: int, family: Rop) -> dict[str, int]:
    """Numbers of problems out of `count` in which the straight line is free: to a single goal configuration,
    to the nearest of ten, and to any of ten.

    As in the authors' code, goal configurations reach a position with any orientation. `family` gives the
    distribution of the obstacles.
    """
    robot = load_robot("panda")
    names = ("a single goal", "the nearest of ten goals", "any of ten goals")
    counts: dict[str, int] = dict.fromkeys(names, 0)
    for number in range(count):
        rng = np.random.default_rng([SEED, STREAM + 1, number])
        sample = family.draw(robot, rng, GOAL_COUNT, POSITION)
        problem = sample.problem(robot)
        lines = free_lines(problem, sample.goals)
        single = free_lines(problem, sample.goals[:1])[0]
        free = (single is not None, lines[0] is not None, any(line is not None for line in lines))
        for name, is_free in zip(counts, free, strict=True):
            counts[name] += is_free
    return counts


# Table 1
AS_IN_PAPER = "diffusion, as the paper says"
WITHOUT_CLEARANCES = "diffusion, no clearances, one sample"
PAPER_PARTS = "compression_autoencoder", "transformer", 254
"""Encoder, denoiser and number of waypoints of the paper's method."""
PAPER_SAMPLES = 1_600_000
"""Number of samples of the paper's training: 25,000 batches of 64."""
GUIDED_SAMPLE = ":samples=1:repeat=false"
"""Planner settings for a single sample, without further samples if the validator refuses it."""
UNGUIDED_SAMPLE = ":samples=1:guidance_steps=0:repeat=false"
"""Planner settings for a single sample without collision guidance, as in the row JPC of the paper's Table 2
(losses of joints, points and collision)."""
NO_WEIGHTS = (
    f"The row {AS_IN_PAPER!r} is missing, since --paper-weights is not given. No weights of the paper's size "
    "are bundled: make them in the repository (python benchmarks/paper_weights/checkpoint.py weights FOLDER) "
    "or train them (robotdiffuse train planner --config paper --data FOLDER --encoder FOLDER --out FOLDER), "
    "and give their folder."
)
PAPER_METHOD = "RobotDiffuse"
"""Name of the row of the paper's own method in its Table 1."""


class PaperRow(NamedTuple):
    """A row of the paper's Table 1, as printed."""

    name: str
    indicators: Indicators
    """Success and collision in percent, time in seconds."""
    comscore: float


PAPER_TABLE_1 = (
    PaperRow("RRT*", Indicators(73.3, 0.0, 15.037, 600.0), 0.4175),
    PaperRow("MPNet", Indicators(84.5, 14.3, 18.492, 600.0), 0.19),
    PaperRow("MPiNets", Indicators(87.4, 11.6, 16.438, 600.0), 0.4175),
    PaperRow("MPD", Indicators(79.7, 12.4, 14.142, 9.0), 0.645),
    PaperRow("RobotDiffuse", Indicators(84.9, 9.8, 14.218, 15.0), 0.765),
)
"""The paper's own formulas, applied to the figures of its Table 1, give other scores than the printed ones.
The first four columns are the normalized figures:

| row          | success | collision | length | time  | ComScore | printed | difference |
|--------------|---------|-----------|--------|-------|----------|---------|------------|
| RRT*         | 0       | 1         | 0.794  | 0     | 0.4486   | 0.4175  | +0.031     |
| MPNet        | 0.794   | 0         | 0      | 0     | 0.1986   | 0.19    | +0.009     |
| MPiNets      | 1       | 0.189     | 0.472  | 0     | 0.4152   | 0.4175  | -0.002     |
| MPD          | 0.454   | 0.133     | 1      | 1     | 0.6467   | 0.645   | +0.002     |
| RobotDiffuse | 0.823   | 0.315     | 0.983  | 0.990 | 0.7774   | 0.765   | +0.012     |

These scores rank the rows as the printed scores do, except that RRT* and MPiNets have equal printed scores.
The cause of the differences is unknown. These explanations were tried:

- Rounding: four times each printed score has at most two decimals (1.67, 0.76, 1.67, 2.58, 3.06), so the
  normalized values were probably rounded to two decimals. This gives MPD exactly (0.645), and MPNet if
  0.1975 is truncated to 0.19. RRT* (0.4475), RobotDiffuse (0.7750) and MPiNets (0.4150) remain different.
  Typing errors in these three would explain all differences.
- Other normalizations of the columns (fractions of the maximum, logarithms, ranks; all combinations): the
  largest difference is still 0.025 or more.
- Other weights: with the best weights that sum to 1, the largest difference is 0.011. With (0.2418, 0.1870,
  0.2929, 0.2196), which sum to 0.94, it is 0.002 (0.005 if the weights are rounded to two decimals). But four
  free weights for five scores prove little, and the paper states equal weights.
- Other figures than the printed ones, perhaps from an earlier version of the table: with any change of a
  single cell, the largest difference is at least 0.012. With 15.6 in place of 15.037 as the length of RRT*,
  and 88.0 in place of 87.4 as the success of MPiNets, it is 0.004. RRT* is worst in success and time (0) and
  best in collision (1), so with equal weights its printed score requires a normalized length of 0.67.
"""


class Row(NamedTuple):
    name: str
    planner: str
    """The planner, as text for `bench run`."""
    paper: str = ""
    """Name of the corresponding row of the paper; empty if there is none."""


ROWS = (
    Row("RRT* (OMPL)", "ompl_rrt_star", "RRT*"),
    Row("MPNet", "mpnet", "MPNet"),
    Row("MPiNets", "mpinets", "MPiNets"),
    Row("MPD", "mpd", "MPD"),
    Row("diffusion, as it ships: clearances as inputs", "diffusion", PAPER_METHOD),
    Row("diffusion, a single sample", f"diffusion{GUIDED_SAMPLE}"),
    Row("diffusion, a single sample, no guidance", f"diffusion{UNGUIDED_SAMPLE}"),
    Row(
        "diffusion, a single sample, no guidance, no clearances: 32 points of the scene",
        f"diffusion@{POINTS}{UNGUIDED_SAMPLE}",
    ),
    Row("robotdiffuse, the default: aorrtc", "robotdiffuse"),
    Row("no planner: line to the nearest goal", "straight_line:goals=nearest"),
    Row("no planner: line to any goal", "straight_line"),
    Row(
        "no planner: line, else through one fixed configuration",
        "control:source=vias:samples=1:guidance_steps=0",
    ),
    Row(
        "no planner: line, else through one of 16 fixed configurations",
        "control:source=vias:guidance_steps=0",
    ),
    Row("no network: line, else smooth noise with guidance", "control"),
)
MEASURES = ("link_length", "joint_length", "duration", "jerk", "turning")
"""Metrics of solved motions that are columns of the table."""


@dataclass(frozen=True)
class Table1Settings:
    out: FilePath
    """Folder of the bench."""
    problems: int = 60
    """Number of non-trivial problems for each kind of goal."""
    time_limit: float = 10.0
    """Time limit of a call [s]; RRT* uses all of it."""
    cpu_time: bool = False
    """See `BenchSettings`."""
    paper_weights: str | None = None
    """Folder with weights of a network without clearances as inputs, such as a network trained with the
    config `paper` or `points`. The network gets two rows of single samples: with and without guidance."""
    data: str | None = None
    """Folder of a data set, for a row with the motions whose start and goal are nearest to the problem's."""
    workers: int = 1
    """See `BenchSettings`."""
    cluster: str | None = None
    """See `BenchSettings`."""

    @property
    def rows(self) -> tuple[Row, ...]:
        """The rows of the table: ROWS, two rows for `paper_weights` if given, and a row of nearest motions if
        `data` is given."""
        nearest = Row(
            "no network: line, else nearest motions with guidance",
            f"control:source={NEAREST}:data={self.data}",
        )
        controls = () if self.data is None else (nearest,)
        if self.paper_weights is None:
            return ROWS + controls
        title = _title(self.paper_weights)
        diffusion = f"diffusion@{self.paper_weights}"
        guided = Row(title, diffusion + GUIDED_SAMPLE)
        unguided = Row(f"{title}, no guidance", diffusion + UNGUIDED_SAMPLE)
        # the bundled weights have a row already
        others = [row for row in ROWS[5:] if row.planner != unguided.planner]
        return (*ROWS[:5], guided, unguided, *others, *controls)

    def command(self, name: str) -> str:
        """The command with these settings: `reproduce` with this name."""
        weights = "" if self.paper_weights is None else " --paper-weights FOLDER"
        weights += "" if self.data is None else " --data DATA"
        return (
            f"robotdiffuse reproduce {name} --out FOLDER --problems {self.problems} "
            f"--time-limit {self.time_limit:g}{' --cpu-time' * self.cpu_time}{weights}"
        )

    @property
    def bench(self) -> BenchSettings:
        return BenchSettings(
            planners=tuple(row.planner for row in self.rows),
            problems=tuple(str(problem_file(self.out, name)) for name in GOALS),
            out=self.out,
            time_limit=self.time_limit,
            count=self.problems,
            cpu_time=self.cpu_time,
            workers=self.workers,
            cluster=self.cluster,
        )


def run_table1(settings: Table1Settings, report: Progress, done: Done) -> Bench:
    """Make the calls that have no record in the folder; returns the bench with all calls.

    Raises InputError for paper weights with clearances as inputs, for paper weights with which a sample takes
    longer than the time limit, and in the cases in which `run_bench` raises it.
    """
    if settings.paper_weights is not None:
        _check_paper_weights(settings.paper_weights, settings.time_limit)
    bench = settings.bench
    write_problems(settings.out, settings.problems, report)
    run_bench(bench, report, done)
    return read_bench(settings.out, list(bench.specs))


def _title(folder: str) -> str:
    """Name of the row for the weights in a folder, with their encoder, their denoiser and their number of
    training samples in percent of the paper's. Raises InputError if the folder has no weights."""
    description = read_description(folder_of(folder), "model")
    settings = MotionModelSettings.from_json(description.get("settings"), f"{folder}/model.json: settings")
    parts = settings.encoder, settings.denoiser, settings.waypoints
    title = AS_IN_PAPER if parts == PAPER_PARTS else WITHOUT_CLEARANCES
    trained = 100 * description.get("training", {}).get("samples", 0.0) / PAPER_SAMPLES
    network = f"{settings.encoder}, {settings.denoiser}"
    return f"{title}: {network}, {trained:.0f} % of {PAPER_SAMPLES / 1e6:g} M samples"


def _check_paper_weights(folder: str, time_limit: float) -> None:
    """Raises InputError for networks with clearances as inputs, and for networks that need longer for a
    single sample on this machine than the time limit [s]."""
    from robotdiffuse.learning.exported_model import exported_model

    model = exported_model("model", folder, load_robot("panda"))
    if model.settings.clearance_features:
        raise InputError(
            f"paper_weights is {folder}, whose inputs include clearances; these rows are for weights without "
            "them: train with --config paper or points"
        )
    steps = model.settings.sampling_steps or model.schedule.steps
    shapes = (1, model.waypoints, model.feature_count), 1, (1, model.condition_count)
    zeros = [np.zeros(shape, np.float32) for shape in shapes]
    seconds = steps * min(timeit.repeat(lambda: model.denoised(*zeros), number=1, repeat=3))
    if seconds > time_limit:
        raise InputError(
            f"time_limit is {time_limit:g} s and paper_weights is {folder}, with which a single sample takes "
            f"about {seconds:.0f} s here ({steps} denoising steps): no call would end in time. Give a time "
            f"limit of at least {2 * seconds:.0f}"
        )


def table1(settings: Table1Settings, bench: Bench) -> Report:
    """The report of Table 1, with one table for each kind of goal, on non-trivial problems."""
    report = paper_report("Table 1", settings.command("table1"))
    rows = dict(zip(settings.bench.specs, settings.rows, strict=True))
    # the folder may contain more problems than are required
    names = {
        case.name
        for problem_set in GOALS
        for case in read_cases(settings.out, problem_set)[: settings.problems]
    }
    records = {
        label: [r for r in bench.records[label] if r.name in names and r.time_limit == settings.time_limit]
        for label in rows
    }
    loads = list[float]()
    for section in sections(replace(bench, records=records), [settings.time_limit]):
        loads += section.main.loads
        report.table(_table(section, rows), level=2)
    shares = [
        f"{100 * trivial_share(settings.out, name):.0f} % (goal: {kind})" for name, kind in GOALS.items()
    ]
    trivial = (
        "Trivial problems, in which the straight line to a goal configuration is free, are left out: "
        f"{' and '.join(shares)}. The paper's figures include them."
    )
    lines = [trivial, *notes(settings), *about(bench), *crashes(bench)]
    if loads:
        lines.append(f"Load average of the machine after the calls: {min(loads):.1f} to {max(loads):.1f}.")
    add_notes(report, lines)
    return report


def scores(rows: Sequence[Row], indicators: dict[str, Indicators]) -> dict[str, float]:
    """ComScores of the rows, from measured indicators. The five rows with a counterpart in the paper are
    normalized together. Any further row is scored in the place of our counterpart of RobotDiffuse."""
    ours = next(row.name for row in rows if row.paper == PAPER_METHOD)
    other_rows = [row.name for row in rows if row.paper and row.paper != PAPER_METHOD]
    scores_with = {
        name: comscores([indicators[row_name] for row_name in other_rows] + [indicators[name]]).tolist()
        for name in indicators
        if name not in other_rows
    }
    return dict(zip(other_rows, scores_with[ours], strict=False)) | {
        name: values[-1] for name, values in scores_with.items()
    }


def _table(section: Section, rows: dict[str, Row]) -> Table:
    """The table of a problem set. rows: the row of each planner, by its text for `bench run`."""
    comparison = section.main
    title = f"Goal: {GOALS[section.problem_set]}; {counted(comparison.problems, 'non-trivial problem')}"
    indicators = {}
    for planner_row in comparison.rows:
        # the mean time of all calls, solved or not, each until its planner returned
        time = Mean.of(o.record.time for o in planner_row.outcomes).value
        indicators[rows[planner_row.planner].name] = planner_row.figures._replace(time=time)
    comscore = scores(tuple(rows.values()), indicators)
    printed = {row.name: (*row.indicators, row.comscore) for row in PAPER_TABLE_1}
    printed_beside = section.problem_set == POSE
    table = []
    for planner_row in comparison.rows:
        row = rows[planner_row.planner]
        collision = planner_row.figures.collision / 100
        interval = wilson_interval(round(collision * comparison.problems), comparison.problems)
        cells = (
            row.name,
            planner_row.success,
            share_cell(collision, interval),
            *(planner_row.mean(METRICS[name]) for name in MEASURES),
            indicators[row.name].time,
            comscore[row.name],
        )
        table.append([*cells, *(printed.get(row.paper, (None,) * 5) if printed_beside else ())])
    columns = (
        "row",
        Column("success", "%", better="more"),
        Column("collision", "%", better="less"),
        Column("length of links 1 to 7", "m"),
        Column("joint length", "rad"),
        Column("duration", "s"),
        "log jerk",
        Column("turning", "rad"),
        Column("time", "s", ".3g", "less"),
        Column("ComScore", "", ".3f", "more"),
        *(("paper: suc", "col", "len", "time", "ComScore") if printed_beside else ()),
    )
    five = sorted((row.name for row in rows.values() if row.paper), key=lambda name: -comscore[name])
    order = "Order of the paper's five rows by ComScore: " + ", ".join(f"{x} {comscore[x]:.3f}" for x in five)
    return Table.of(title, columns, table, (f"{order}.",))


def notes(settings: Table1Settings) -> list[str]:
    """How to read the tables."""
    texts = [
        f"Every call has {settings.time_limit:g} s{' of CPU time' * settings.cpu_time}; in the paper up to "
        "600 s. RRT* always uses the whole limit.",
        "success: share of problems with a motion that passes the validator, with the 95 % interval by "
        "Wilson. The motion must end within 1 cm and 15° of a goal pose, or at a goal configuration. "
        "collision: share of problems on which the validator "
        "refused the planner's last path because it collides. RRT*, MPNet, MPiNets, MPD and diffusion with "
        "default settings try again until time runs out. The rows of a single sample have one motion per "
        "problem, as in the paper. The paper's network was trained on 1.6 M samples.",
        "Means are over the problems that a row solves, with 95 % intervals; a row that solves only easy "
        "problems therefore has short motions. Only the mean time is over all calls, without an interval. "
        "length of links 1 to 7: the sum of the path lengths of the origins of the links that joints move. "
        "The paper calls this path length and states no unit. The hand is not counted: the paper's arm has "
        "none. "
        "log jerk: logarithm of the dimensionless jerk; turning: sum of the angles between segments.",
        "ComScore: normalized as in the paper, over the paper's five rows as measured here. For the score of "
        "any further row, this row takes the place of the paper's method among the five.",
        "robotdiffuse minimizes the duration, its default. time: mean until the planner returns"
        f"{' (CPU time of its process)' * settings.cpu_time}; the machine may do other work.",
    ]
    return texts if settings.paper_weights is not None else [NO_WEIGHTS, *texts]


# Figures

STEPS = (1, 2, 5, 10, 50, 200)
"""Numbers of denoising steps in the plot of success."""
SHOWN_STEPS = 20
"""Number of denoising steps of the drawn motion."""
SHOWN = (0, 10, 15, 18)
"""Indices of denoising steps; the motion is drawn as it is before each of them."""
COMPARED = ("diffusion", "mpinets")
"""Planners of figure 3b, as in the paper."""


class Noisy(NamedTuple):
    """An intermediate state of denoising."""

    level: float
    """Noise level as a fraction of the largest level; 0 for the finished motion."""
    path: Path


def denoising(problem: Problem) -> list[Noisy]:
    """One motion of the bundled network at several noise levels, from the noisiest to the finished motion;
    without guidance."""
    planner = Diffusion()
    rng = np.random.default_rng(0)
    robot = problem.robot
    model = planner.network(robot)
    checker = CollisionChecker(robot, problem.scene)
    embedding = encode(model, checker, planner.settings.points, rng)
    start = problem.start
    goal = goal_of(problem)
    reference = model.reference(start[None], goal[None])
    predict = model.predictor(
        reference, model.condition(embedding, start, goal), link_clearances(checker, model.settings)
    )
    states = list[tuple[float, ndarray]]()

    def recorded(x: ndarray, level: int) -> ndarray:
        states.append((level / model.schedule.steps, model.hold_ends(x.copy(), reference)))
        return predict(x, level)

    draw = SAMPLERS.load("ddim")
    x = draw(recorded, model.schedule, lambda: model.draw_noise(1, rng), SHOWN_STEPS, 0.0)
    states.append((0.0, model.hold_ends(x.copy(), reference)))
    motions = []
    for level, state in [*(states[i] for i in SHOWN), states[-1]]:
        q = np.clip(model.joints(state, reference)[0].astype(np.float64), robot.lower, robot.upper)
        q[0] = start
        q[-1] = goal
        motions.append(Noisy(level, Path(robot.joint_names, q)))
    return motions


RecordsBySteps = dict[str, dict[int, list[Record]]]
"""Records of each kind of guidance, by the number of denoising steps."""


def success_by_steps(out: FilePath, count: int) -> RecordsBySteps:
    """Records of batches of 16 samples of the network on `count` problems that the straight line does not
    solve, by guidance and number of denoising steps. They are stored in the folder."""
    cases = hard_cases("rop", count, out / "problems")
    weights = weights_for("model", load_robot("panda"))
    records: RecordsBySteps = {}
    for name, guidance in (("no guidance", 0), ("guidance", DiffusionSettings().guidance_steps)):
        methods = {}
        for steps in STEPS:
            settings = replace(NETWORK_ALONE, guidance_steps=guidance, sampling_steps=steps)
            method = f"{name}, {steps} steps, {sampling_digest(settings, weights)}"
            methods[method] = sampled(from_network(Diffusion(settings)))
        runs = run_all(cases, methods, seeds=(1,), folder=out / "figures", title=f"figure 1, {name}")
        records[name] = dict(zip(STEPS, runs.values(), strict=True))
    return records


def plot_success_by_steps(records: RecordsBySteps) -> str:
    """Plot of the share of single samples that pass the validator over the number of denoising steps; SVG."""

    def fill(figure: Any) -> None:
        axes = figure.subplots()
        for name, by_steps in records.items():
            shares = [np.array([r.passed for r in values]) for values in by_steps.values()]
            mean = np.array([x.mean() for x in shares])
            bars = np.abs(np.array([bootstrap_interval(x) for x in shares]).T - mean)
            axes.errorbar(list(by_steps), mean, bars, fmt="o-", markersize=4, label=name)
        axes.set(xscale="log", xlabel="denoising steps T", ylabel="single samples that pass the validator")
        axes.legend()

    return draw_plot(fill)


def plot_success_over_time(bench: Bench) -> str:
    """Figure 3a: success over time on the problems with goal poses, for planners with default settings;
    SVG."""
    plain_rows = {name: records for name, records in bench.records.items() if ":" not in name}
    parts = sections(replace(bench, records=plain_rows))
    return success_over_time(next(part for part in parts if part.name == POSE), list(plain_rows))


class Compared(NamedTuple):
    """Motions of several planners on one problem."""

    case: Case
    motions: dict[str, Path]
    """Motions by planner."""


def compared_motions(bench: Bench) -> Compared | None:
    """The problem for figure 3b: among the non-trivial problems that both planners of the figure solve, the
    problem on which their path lengths differ most. None if there is no such problem."""
    solved = {
        planner: {
            (r.problem_set, r.name): r for r in bench.records.get(planner, ()) if r.solved and not r.trivial
        }
        for planner in COMPARED
    }
    keys = sorted(set.intersection(*map(set, solved.values())))
    if not keys:
        return None

    def ratio(key: tuple[str, str]) -> float:
        lengths = [by_key[key].joint_length or 1.0 for by_key in solved.values()]
        return max(lengths) / min(lengths)

    best = max(keys, key=ratio)
    case = next(case for name in (POSE, JOINT) for case in read_cases(bench.folder, name) if case.key == best)
    names = case.problem.robot.joint_names
    return Compared(
        case, {planner: Path(names, by_key[best].waypoints) for planner, by_key in solved.items()}
    )
