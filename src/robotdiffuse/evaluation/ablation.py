"""The paper's Table 2: every row is trained with the same budget and evaluated on the same held-out problems.

Collision guidance alone, without a network, solves many problems. What a row owes to its network is measured
without guidance, and by a control: guidance of trajectories that do not come from a network.
"""

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path as FilePath
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.core.errors import InputError, unknown_name
from robotdiffuse.core.output_files import lock_folder
from robotdiffuse.core.processes import Workers
from robotdiffuse.core.tables import Column, Table
from robotdiffuse.datasets.shards import read_manifest
from robotdiffuse.evaluation.comparison import Mean
from robotdiffuse.evaluation.methods import (
    NETWORK_ALONE,
    from_network,
    sampled,
    sampling_digest,
    without_network,
)
from robotdiffuse.evaluation.metrics import Kinematics
from robotdiffuse.evaluation.paper import paper_report, share_cells, straight_line_shares
from robotdiffuse.evaluation.problem_sets import hard_cases
from robotdiffuse.evaluation.report import Report, interval
from robotdiffuse.evaluation.runs import Record, run_all
from robotdiffuse.evaluation.statistics import bootstrap_interval
from robotdiffuse.learning.checkpoint import load_model
from robotdiffuse.learning.training.config import EncoderTraining
from robotdiffuse.learning.training.configs import CONFIGS, planner_training
from robotdiffuse.learning.training.encoder import train_encoder
from robotdiffuse.learning.training.planner import train_planner
from robotdiffuse.planning.diffusion.hybrid import RobotDiffuse, RobotDiffuseSettings
from robotdiffuse.problems.families import load_family
from robotdiffuse.problems.families.rop import ROP, Rop
from robotdiffuse.problems.held_out import Case
from robotdiffuse.robots import load_robot

ENCODER = "compression_autoencoder"
CONTROL = "no network"
"""Smooth noise about the straight line in place of a network's samples."""
CONTROL_WAYPOINTS = 48
"""As many as those of the rows' networks."""
STOP_TIMEOUT = 20.0
"""A stopped training writes a checkpoint; it is killed after this time [s]."""


class Row(NamedTuple):
    config: str
    """Name in `learning.training.configs`."""
    guided: bool
    """Whether samples are drawn under collision guidance."""
    paper: tuple[float | None, ...]
    """The paper's success [%], collision [%], length and time [s]; None if it has no such row."""


ROWS: dict[str, Row] = {
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


@dataclass(frozen=True)
class AblationSettings:
    data: str
    """Folder of a data set."""
    out: str
    """Folder for the trained networks; existing ones are kept, interrupted trainings continue."""
    samples: int = 300_000
    """Training samples of each row, the equal budget."""
    encoder_samples: int = 300_000
    """Clouds that the frozen encoder is trained on first."""
    problems: int = 500
    """Held-out problems that the straight line does not solve and search does."""
    family: str = "rop"
    """Family of the problems, a name in `problems.families`."""
    candidates: int = 16
    """Trajectories sampled for each problem."""
    seeds: int = 1
    """Trainings of each row, with seeds 0, 1, ...; figures are means over them."""

    def __post_init__(self) -> None:
        for name in ("samples", "encoder_samples", "problems", "candidates", "seeds"):
            if getattr(self, name) < 1:
                raise InputError(f"{name} is {getattr(self, name)}; it must be at least 1")
        load_family(self.family)


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Figures of a network, one value for each problem."""

    single: Float[ndarray, "n"]
    """Share of the sampled trajectories that passed the validator."""
    best: Float[ndarray, "n"]
    """1 if any of them passed."""
    collided: Float[ndarray, "n"]
    """Share of the sampled trajectories in collision."""
    length: Float[ndarray, "n"]
    """Link path length of the shortest that passed [m]; NaN without one."""
    seconds: Float[ndarray, "n"]
    """CPU time of encoding and sampling on one thread [s]."""

    @classmethod
    def of(cls, records: list[Record]) -> "Evaluation":
        single, collided = (np.array([getattr(r, name) for r in records]) for name in ("passed", "collided"))
        length = np.array([record.measures.get("link_length", np.nan) for record in records])
        return cls(single, (single > 0) * 1.0, collided, length, np.array([record.cpu for record in records]))

    @classmethod
    def mean(cls, of: "list[Evaluation]") -> "Evaluation":
        """The mean over several trainings, of each problem; NaN lengths do not count."""
        values = [np.stack([getattr(each, f.name) for each in of]) for f in fields(cls)]
        return cls(*(np.ma.masked_invalid(x).mean(axis=0).filled(np.nan) for x in values))


class RowResult(NamedTuple):
    name: str
    alone: Evaluation
    """Without guidance."""
    guided: Evaluation
    """With it."""
    by_seed: tuple[float, ...] = ()
    """Share of samples that pass the validator, as in the paper's row, of each training."""

    @property
    def as_in_paper(self) -> Evaluation:
        return self.guided if self.name not in ROWS or ROWS[self.name].guided else self.alone


def run_ablation(
    settings: AblationSettings,
    rows: list[str],
    workers: int = 1,
    report: Callable[[str], None] = lambda text: None,
) -> list[RowResult]:
    """Train the networks of the rows and evaluate every row. After an interruption, the same call continues.

    Raises InputError for an unknown row, listing the known ones, and for data of another robot.
    """
    for name in rows:
        if name not in ROWS:
            raise unknown_name("row of Table 2", name, ROWS)
    if workers < 1:
        raise InputError(f"workers is {workers}; it must be at least 1")
    read_manifest(settings.data).check_robot(load_robot("panda"))
    with lock_folder(FilePath(settings.out)):
        return _run(settings, rows, workers, report)


def _run(
    settings: AblationSettings, rows: list[str], workers: int, report: Callable[[str], None]
) -> list[RowResult]:
    encoder = FilePath(settings.out) / ENCODER
    if not (encoder / "encoder.json").exists():
        report(f"training {ENCODER}: {settings.encoder_samples:,} clouds")
        train_encoder(
            EncoderTraining(name=ENCODER, minutes=None, samples=settings.encoder_samples), str(encoder)
        )
    _check_budget(encoder / "encoder.json", "encoder_samples", settings.encoder_samples)
    configs = list(dict.fromkeys(ROWS[name].config for name in rows))
    trainings = [Training(config, seed) for config in configs for seed in range(settings.seeds)]
    found: dict[tuple[Training | None, bool], Evaluation] = {}
    with Workers(workers, STOP_TIMEOUT) as pool:
        for _, training in pool.each(_train, [(settings, training) for training in trainings]):
            file = FilePath(settings.out) / training.folder / "model.json"
            _check_budget(file, "samples", settings.samples)
            report(f"trained {training.folder}")
        _check_same_data(settings, trainings)
        cases = hard_cases(settings.family, settings.problems, FilePath(settings.out) / "problems", report)
        todo = [(settings, which, guided, cases) for which in (*trainings, None) for guided in (False, True)]
        for _, (which, guided, result) in pool.each(_evaluate, todo):
            found[which, guided] = result
            name, how = which.folder if which else CONTROL, "with" if guided else "without"
            report(f"evaluated {name} {how} guidance: {100 * result.single.mean():.1f} % of samples")
    results = []
    for name in rows:
        row = ROWS[name]
        each = [
            [found[Training(row.config, seed), guided] for seed in range(settings.seeds)]
            for guided in (False, True)
        ]
        by_seed = tuple(float(of.single.mean()) for of in each[row.guided])
        alone, guided = map(Evaluation.mean, each)
        results.append(RowResult(name, alone, guided, by_seed))
    return [*results, RowResult(CONTROL, found[None, False], found[None, True])]


class Training(NamedTuple):
    """One training of a row's network."""

    config: str
    seed: int

    @property
    def folder(self) -> str:
        """Name of the folder of its weights."""
        return f"{self.config}_seed{self.seed}" if self.seed else self.config


def _training(file: FilePath) -> dict[str, Any]:
    return json.loads(file.read_text())["training"]


def _check_budget(file: FilePath, name: str, wanted: int) -> None:
    """Raise InputError if a network was trained with another budget."""
    found = _training(file)["settings"]["samples"]
    if found != wanted:
        raise InputError(
            f"{file.parent} was trained with {name} {found}, now it is {wanted}; use another folder, "
            "or the same budget"
        )


def _check_same_data(settings: AblationSettings, trainings: list[Training]) -> None:
    """Raise InputError unless all networks were trained on the same data."""
    names = [training.folder for training in trainings]
    seen = {name: _training(FilePath(settings.out) / name / "model.json")["data"] for name in names}
    if len(set(seen.values())) > 1:
        found = ", ".join(f"{name} {digest}" for name, digest in seen.items())
        raise InputError(f"{settings.out} holds networks of different data: {found}; use another folder")


def _train(settings: AblationSettings, training: Training) -> Training:
    out, config = FilePath(settings.out) / training.folder, training.config
    if not (out / "model.json").exists():
        given = {"data": settings.data, "samples": settings.samples, "seed": training.seed}
        alone = {"encoder": str(FilePath(settings.out) / ENCODER)}
        names_one = "encoder" in CONFIGS[config].changes
        train_planner(planner_training(config, given if names_one else given | alone), str(out))
    return training


def _evaluate(
    settings: AblationSettings, training: Training | None, guided: bool, cases: list[Case]
) -> tuple[Training | None, bool, Evaluation]:
    robot = load_robot("panda")
    folder = FilePath(settings.out) / (training.folder if training else CONTROL.replace(" ", "_"))
    planner = _planner_settings(settings, training, guided)
    digest = sampling_digest(planner, None if training is None else folder)
    name = f"{'guided' if guided else 'unguided'} {digest}"
    alone = training is None
    draw = without_network(planner, CONTROL_WAYPOINTS) if alone else from_network(RobotDiffuse(planner))
    method = sampled(draw, Kinematics(robot).link_length)
    return (
        training,
        guided,
        Evaluation.of(run_all(cases, {name: method}, seeds=(1,), folder=folder, bar=False)[name]),
    )


def _planner_settings(
    settings: AblationSettings, training: Training | None, guided: bool
) -> RobotDiffuseSettings:
    steps = NETWORK_ALONE.guidance_steps if guided else 0
    alone = replace(NETWORK_ALONE, samples=settings.candidates, guidance_steps=steps)
    if training is None:
        return alone
    weights = str(FilePath(settings.out) / training.folder)
    encoder = load_model(weights, load_robot("panda")).encoder
    assert encoder is not None  # every row has one
    return replace(alone, weights=weights, points=encoder.settings.cloud)


NOTES = (
    "single: share of samples that pass the validator; best: of problems with at least one such sample.",
    "length: of the shortest such sample, over the problems that have one; to first: the mean ratio to that "
    "of the first row, over the problems that both solve. Intervals are over problems, not over trainings: "
    "another seed may move a row by more.",
    f"{CONTROL}: smooth noise about the straight line, which networks start from, under the same guidance.",
)
LINE_FAMILIES = {"spheres and cubes": ROP, "spheres alone": Rop(kinds=("sphere",))}
LINE_NOTES = (
    "The straight line in joint space, under the authors' own draw of problems, with inverse kinematics of "
    "the position alone: share of problems on which it is free. The paper's rows are of all problems, "
    "trivial ones too, so a row near these shares has shown no planner.",
)


def table2(settings: AblationSettings, results: list[RowResult]) -> Report:
    """Table 2 and, beside its rows, no planner at all."""
    command = (
        f"robotdiffuse reproduce table2 --data DATA --out FOLDER --samples {settings.samples} "
        f"--encoder-samples {settings.encoder_samples} --problems {settings.problems} "
        f"--seeds {settings.seeds}"
    )
    report = paper_report("Table 2", command)
    report.table(table(settings, results), level=2)
    report.table(straight_line_table(settings.problems), level=2)
    return report


def table(settings: AblationSettings, results: list[RowResult]) -> Table:
    """The rows of Table 2, with the paper's figures beside ours."""
    known = asdict(settings)
    budget = ("samples", "encoder_samples", "problems", "candidates")
    title = f"Table 2 on {settings.family}: {', '.join(f'{name} {known[name]:,}' for name in budget)}"
    several = settings.seeds > 1
    columns = (
        *("row", "guided"),
        *(Column("single", "%", ".1f", "more", scale=100.0), "95 %"),
        Column("best", "%", ".1f", "more", scale=100.0),
        *(Column("collision", "%", ".1f", "less", scale=100.0), "95 %"),
        Column("length", "m", ".3f", "less"),
        Column("to first", "", ".3f", "less"),
        Column("CPU", "ms", ".0f", "less", scale=1000.0),
        *(Column("unguided", "%", ".1f", "more", scale=100.0), "95 %"),
        *(("each seed",) if several else ()),
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
            *_share(evaluation.single),
            float(evaluation.best.mean()),
            *_share(evaluation.collided),
            Mean.of(evaluation.length).value,
            Mean.of(evaluation.length / first.length).value,
            float(np.median(evaluation.seconds)),
            *_share(result.alone.single),
            *((by_seed,) if several else ()),
            *paper,
        )
        rows.append(row)
    return Table.of(title, columns, rows, NOTES)


def straight_line_table(problems: int) -> Table:
    """No planner under the authors' own draw, beside the paper's rows of Table 2."""
    rows = [(f"paper: {name}", float(row.paper[0] or 0), "") for name, row in ROWS.items()]
    for obstacles, family in LINE_FAMILIES.items():
        for goals, free in straight_line_shares(problems, family).items():
            name = f"no planner: straight line to {goals}, {obstacles}"
            rows.append((name, *share_cells(free, problems)))
    columns = ("row", Column("success", "%", ".1f"), "95 %")
    rows.sort(key=lambda row: row[1])
    return Table.of(
        f"No planner among the paper's rows: {problems} problems drawn", columns, rows, LINE_NOTES
    )


def _share(values: Float[ndarray, "n"]) -> tuple[float, str]:
    """Mean of shares, and its 95 % interval in per cent."""
    return float(values.mean()), interval(*bootstrap_interval(values), scale=100.0)
