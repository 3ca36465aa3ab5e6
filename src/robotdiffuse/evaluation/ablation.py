"""The paper's Table 2: every row is trained with the same budget and evaluated on the same held-out problems.

Collision guidance solves many problems even without a network. So the contribution of a network is measured
in two ways: without guidance, and by comparison with controls. The controls are motions through fixed
configurations (vias), the nearest motions of the data, and smooth noise, each with and without guidance.
"""

import json
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np

from robotdiffuse.baselines.controls import (
    EQUAL_TIME_STEPS,
    NEAREST,
    NOISE,
    VIAS,
    ControlSettings,
)
from robotdiffuse.core.errors import InputError, check_name, counted
from robotdiffuse.core.files import check_not_input, lock_folder
from robotdiffuse.core.settings import Count, OneOf, Settings
from robotdiffuse.core.tables import Column, Figure, Table
from robotdiffuse.core.types import Values, frozen_dataclass
from robotdiffuse.datasets.shards import read_manifest
from robotdiffuse.evaluation.bench_comparisons import Mean, bootstrap_interval, wilson_interval
from robotdiffuse.evaluation.metrics import link_length
from robotdiffuse.evaluation.paper import paper_report, straight_line_counts
from robotdiffuse.evaluation.report import Report, share_cell
from robotdiffuse.evaluation.runs import (
    NETWORK_ALONE,
    Record,
    from_control,
    from_network,
    hard_cases,
    run_all,
    sampled,
    sampling_digest,
)
from robotdiffuse.learning.checkpoint import load_network
from robotdiffuse.learning.training.config import CONFIGS, EncoderTraining, planner_training
from robotdiffuse.learning.training.tasks import train_encoder, train_planner
from robotdiffuse.planning.diffusion import Diffusion
from robotdiffuse.problems.families import FAMILIES
from robotdiffuse.problems.families.rop import ROP, Rop
from robotdiffuse.problems.files import Case, Progress
from robotdiffuse.processes.workers import Workers
from robotdiffuse.robots import load_robot

ENCODER = "compression_autoencoder"
STOP_TIMEOUT = 20.0
"""A stopped training has this time to write a checkpoint before it is killed [s]."""


class Row(NamedTuple):
    config: str
    """Name in `learning.training.config`."""
    guided: bool
    """Whether samples are drawn under collision guidance."""
    paper: tuple[float | None, ...]
    """The paper's success [%], collision [%], length and time [s]; None for numbers that the paper does not
    report."""


ROWS = {
    "PointNet": Row("table2_pointnet", True, (69.4, 26.7, 17.154, 42)),
    "DGCNN": Row("table2_dgcnn", True, (73.4, 22.5, 16.864, 64)),
    "U-Net": Row("table2_unet", True, (59.3, 29.7, 17.358, 27)),
    "Transformer": Row("table2_transformer", True, (69.0, 16.5, 17.137, 32)),
    "Decoder-only": Row("table2_decoder_only", True, (62.8, 23.8, 16.195, 23)),
    "Noise": Row("table2_noise", True, (64.5, 41.6, 17.628, 15)),
    "Joint-only": Row("table2_joint", False, (68.1, 21.1, 16.148, 15)),
    "Joint&Point": Row("table2_joint_point", False, (74.0, 19.5, 14.762, 15)),
    "JPC": Row("table2_jpc", False, (79.1, 9.2, 14.571, 15)),
    "Ours": Row("table2_jpc", True, (84.9, 9.8, 14.218, 15)),
}


class ControlRow(NamedTuple):
    source: str
    """Where the candidates come from; see `ControlSettings`."""
    samples: int | None
    """Number of candidates; None: as many as the networks draw."""
    guided: bool


CONTROLS = {
    "no network: through one fixed configuration": ControlRow(VIAS, 1, False),
    "no network: through 16 fixed configurations": ControlRow(VIAS, 16, False),
    "no network: nearest motions": ControlRow(NEAREST, None, True),
    "no network: smooth noise": ControlRow(NOISE, None, True),
}


@dataclass(frozen=True)
class AblationSettings(Settings):
    """Data, budgets and problems of Table 2."""

    data: str
    """Folder of a data set."""
    out: str
    """Folder for the trained networks. Networks that exist there are used, and interrupted training runs
    continue."""
    samples: Count = 300_000
    """Number of training samples of each row; equal for all rows."""
    encoder_samples: Count = 300_000
    """Number of point clouds on which an encoder is trained before it is frozen."""
    problems: Count = 500
    """Number of held-out problems that the straight line does not solve and a search does."""
    family: Annotated[str, OneOf(FAMILIES)] = "rop"
    """Family of the problems, a name in `problems.families`."""
    candidates: Count = 16
    """Number of trajectories sampled for each problem."""
    seeds: Count = 1
    """Number of training runs of each row, with seeds 0, 1, ...; figures are means over these runs."""


@frozen_dataclass
class Evaluation:
    """Figures of a network or control, one value for each problem."""

    single: Values
    """Fraction of the sampled trajectories that passed the validator."""
    best: Values
    """1 if any sampled trajectory passed the validator, else 0."""
    collided: Values
    """Fraction of the sampled trajectories in collision."""
    length: Values
    """Length of the shortest trajectory that passed, see `metrics.link_length` [m]; NaN if none passed."""
    seconds: Values
    """CPU time of encoding and sampling on one thread [s]."""

    @classmethod
    def of(cls, records: list[Record]) -> "Evaluation":
        figures = [(r.passed, r.collided, r.measures.get("link_length", np.nan), r.cpu) for r in records]
        single, collided, length, seconds = np.array(figures, np.float64).T
        return cls(single, (single > 0) * 1.0, collided, length, seconds)

    @classmethod
    def mean(cls, trainings: "list[Evaluation]") -> "Evaluation":
        """For each problem, the mean over several training runs; NaN lengths are left out."""
        values = [np.stack([getattr(each, f.name) for each in trainings]) for f in fields(cls)]
        return cls(*(np.ma.masked_invalid(x).mean(axis=0).filled(np.nan) for x in values))


class RowResult(NamedTuple):
    name: str
    unguided: Evaluation
    """Evaluation without guidance."""
    guided: Evaluation
    """Evaluation with guidance."""
    by_seed: tuple[float, ...] = ()
    """For each training, the fraction of samples that pass the validator, with guidance if the paper's row
    has guidance."""

    @property
    def as_in_paper(self) -> Evaluation:
        return self.guided if (ROWS | CONTROLS)[self.name].guided else self.unguided


def run_ablation(
    settings: AblationSettings,
    rows: list[str],
    workers: int,
    report: Progress,
) -> list[RowResult]:
    """Train the networks of the rows and evaluate every row. After an interruption, the same call continues
    the work.

    Raises InputError for an unknown row, listing the known ones, for data of another robot, and if `out` is
    the folder of the data, is used by another process, cannot be written, or holds networks that were trained
    with other numbers of samples, or networks whose data differ from each other.
    """
    for name in rows:
        check_name("row of Table 2", name, ROWS)
    out = Path(settings.out)
    check_not_input(out, settings.data)
    read_manifest(settings.data).check_robot(load_robot("panda"))
    configs = dict.fromkeys(ROWS[name].config for name in rows)
    trainings = [Training(config, seed) for config in configs for seed in range(settings.seeds)]
    evaluations = dict[tuple[Training | str, bool], Evaluation]()
    with lock_folder(out), Workers(workers, patience=STOP_TIMEOUT) as pool:
        if not (out / ENCODER / "encoder.json").exists():
            report(f"training {ENCODER}: {counted(settings.encoder_samples, 'cloud')}")
            encoder = EncoderTraining(name=ENCODER, minutes=None, samples=settings.encoder_samples)
            train_encoder(encoder, str(out / ENCODER))
        _training(out / ENCODER / "encoder.json", "encoder_samples", settings.encoder_samples)
        digests = {}
        for _, training in pool.each(_train, [(settings, training) for training in trainings]):
            about = _training(out / training.folder / "model.json", "samples", settings.samples)
            digests[training.folder] = about["data"]
            report(f"trained {training.folder}")
        if len(set(digests.values())) > 1:
            digests_text = ", ".join(f"{name} {digest}" for name, digest in digests.items())
            raise InputError(f"{out} holds networks of different data: {digests_text}; use another folder")
        cases = hard_cases(settings.family, settings.problems, out / "problems", report)
        todo = [
            (settings, row_training, guided, cases)
            for row_training in (*trainings, *CONTROLS)
            for guided in (False, True)
        ]
        for number, evaluation in pool.each(_evaluate, todo):
            _, row_training, guided, _ = todo[number]
            evaluations[row_training, guided] = evaluation
            name = row_training if isinstance(row_training, str) else row_training.folder
            text = f"evaluated {name} {'with' if guided else 'without'} guidance"
            report(f"{text}: {100 * evaluation.single.mean():.1f} % of samples")
    results = []
    for name in rows:
        row = ROWS[name]
        unguided, guided = (
            [evaluations[Training(row.config, seed), with_guidance] for seed in range(settings.seeds)]
            for with_guidance in (False, True)
        )
        by_seed = tuple(float(x.single.mean()) for x in (guided if row.guided else unguided))
        results.append(RowResult(name, Evaluation.mean(unguided), Evaluation.mean(guided), by_seed))
    controls = [RowResult(name, evaluations[name, False], evaluations[name, True]) for name in CONTROLS]
    return [*results, *controls]


class Training(NamedTuple):
    """One training of a row's network."""

    config: str
    seed: int

    @property
    def folder(self) -> str:
        """Name of the folder of the trained weights."""
        return f"{self.config}_seed{self.seed}" if self.seed else self.config


def _training(file: Path, name: str, budget: int) -> dict[str, Any]:
    """The entry about the training in the file of a network. Raises InputError if the network was trained
    with another number of samples than `budget`."""
    about = json.loads(file.read_text())["training"]
    samples = about["settings"]["samples"]
    if samples != budget:
        raise InputError(
            f"{file.parent} was trained with {name} {samples}, not {budget}; use another folder, "
            "or the same budget"
        )
    return about


def _train(settings: AblationSettings, training: Training) -> Training:
    out = Path(settings.out) / training.folder
    if not (out / "model.json").exists():
        options = {"data": settings.data, "samples": settings.samples, "seed": training.seed}
        if "encoder" not in CONFIGS[training.config].changes:
            options["encoder"] = str(Path(settings.out) / ENCODER)
        train_planner(planner_training(training.config, options), str(out))
    return training


def _evaluate(
    settings: AblationSettings, which: Training | str, guided: bool, cases: list[Case]
) -> Evaluation:
    """Evaluate a network or a control on problems. `which` is a training run, or a name in CONTROLS."""
    robot = load_robot("panda")
    out = Path(settings.out)
    if isinstance(which, str):
        folder = out / which.removeprefix("no network: ").replace(" ", "_")
        row = CONTROLS[which]
        planner = ControlSettings(
            source=row.source,
            samples=row.samples or settings.candidates,
            guidance_steps=EQUAL_TIME_STEPS if guided else 0,
            data=settings.data if row.source == NEAREST else None,
        )
        draw = from_control(planner)
    else:
        folder = out / which.folder
        encoder = load_network("model", folder, robot).encoder
        assert encoder is not None  # every row has an encoder
        planner = replace(
            NETWORK_ALONE,
            samples=settings.candidates,
            guidance_steps=NETWORK_ALONE.guidance_steps if guided else 0,
            weights=str(folder),
            points=encoder.settings.cloud,
        )
        draw = from_network(Diffusion(planner))
    digest = sampling_digest(planner, None if isinstance(which, str) else folder)
    method = {f"{'guided' if guided else 'unguided'} {digest}": sampled(draw, partial(link_length, robot))}
    (records,) = run_all(cases, method, seeds=(1,), folder=folder, bar=False).values()
    return Evaluation.of(records)


NOTES = (
    "single: share of samples that pass the validator; unguided: the same without guidance; best: share of "
    "problems with at least one valid sample. CPU: median time of encoding and sampling for one problem. "
    "paper: its success [%], collision [%], length and time [s].",
    "length: path lengths of the moving links added up, for the shortest valid sample; mean over the "
    "problems that have one; to first: mean ratio of this length to the length in the first row, over the "
    "problems that both rows solve. Intervals are over problems, not over training runs: another seed may "
    "change a row by more.",
    "no network: motions through fixed configurations, without guidance; the nearest motions of the data, "
    "bent to start and goal; smooth noise, which networks start from. Nearest motions and smooth noise get "
    f"{EQUAL_TIME_STEPS} gradient steps, which take as long as a network. Problems that the straight line "
    "solves were left out.",
)
LINE_FAMILIES = {"spheres and cubes": ROP, "spheres alone": Rop(kinds=("sphere",))}
LINE_NOTES = (
    "Share of problems on which the straight line in joint space is free; obstacles are spheres and cubes, "
    "or spheres alone. Problems are sampled as by the authors, with inverse kinematics of the position only. "
    "The paper's rows include problems that the line solves, so a success rate near these shares does not "
    "show that a planner avoids obstacles.",
)


def table2(settings: AblationSettings, results: list[RowResult]) -> Report:
    """The report of Table 2, with a second table that compares the paper's rows with the straight line."""
    command = (
        f"robotdiffuse reproduce table2 --data DATA --out FOLDER --samples {settings.samples} "
        f"--encoder-samples {settings.encoder_samples} --problems {settings.problems} "
        f"--family {settings.family} --seeds {settings.seeds}"
    )
    names = [result.name for result in results if result.name in ROWS]
    if len(names) < len(ROWS):
        command += f" --rows '{','.join(names)}'"
    report = paper_report("Table 2", command)
    report.table(table(settings, results), level=2)
    report.table(straight_line_table(settings.problems), level=2)
    return report


def table(settings: AblationSettings, results: list[RowResult]) -> Table:
    """The rows of Table 2, with the paper's figures beside ours."""
    names = ("samples", "encoder_samples", "problems", "candidates")
    budget = ", ".join(f"{name} {getattr(settings, name):,}" for name in names)
    title = f"Table 2 on {settings.family}: {budget}"
    several_seeds = settings.seeds > 1
    columns = (
        *("row", "guided"),
        Column("single", "%", better="more"),
        Column("best", "%", ".1f", "more", scale=100.0),
        Column("collision", "%", better="less"),
        Column("length", "m", ".3f", "less"),
        Column("to first", "", ".3f", "less"),
        Column("CPU", "ms", ".0f", "less", scale=1000.0),
        Column("unguided", "%", better="more"),
        *(("each seed",) if several_seeds else ()),
        *("paper: suc", "col", "len", "s"),
    )
    first = results[0].as_in_paper
    rows = []
    for result in results:
        evaluation = result.as_in_paper
        paper = ROWS[result.name].paper if result.name in ROWS else (None,) * 4
        by_seed = ", ".join(f"{100 * x:.1f}" for x in result.by_seed)
        row = (
            result.name,
            "yes" if evaluation is result.guided else "no",
            _share(evaluation.single),
            float(evaluation.best.mean()),
            _share(evaluation.collided),
            Mean.of(evaluation.length).value,
            Mean.of(evaluation.length / first.length).value,
            float(np.median(evaluation.seconds)),
            _share(result.unguided.single),
            *((by_seed,) if several_seeds else ()),
            *paper,
        )
        rows.append(row)
    return Table.of(title, columns, rows, NOTES)


def straight_line_table(problems: int) -> Table:
    """The success rates of the paper's Table 2 and of the straight line, sorted. Problems are drawn as the
    authors draw them."""
    paper_success = {name: row.paper[0] or 0.0 for name, row in ROWS.items()}
    rows = [
        (f"paper: {name}", Figure(f"{success}", success / 100)) for name, success in paper_success.items()
    ]
    for obstacles, family in LINE_FAMILIES.items():
        for goals, free in straight_line_counts(problems, family).items():
            name = f"no planner: straight line to {goals}, {obstacles}"
            rows.append((name, share_cell(free / problems, wilson_interval(free, problems))))
    columns = ("row", Column("success", "%"))
    rows.sort(key=lambda row: row[1].value)
    return Table.of(
        f"The straight line, without a planner, beside the paper's rows: "
        f"{counted(problems, 'sampled problem')}",
        columns,
        rows,
        LINE_NOTES,
    )


def _share(values: Values) -> Figure:
    """The mean of fractions, as a percentage with its 95 % interval."""
    return share_cell(float(values.mean()), bootstrap_interval(values))
