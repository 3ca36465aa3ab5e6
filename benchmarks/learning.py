"""The diffusion model alone, with and without its inputs, and compared with smooth noise.

    python benchmarks/learning.py [--parts alone] [--families rop,shelf] [--problems 500]
        [--cases FOLDER] [--weights FOLDER]

Prints benchmarks/results/network.txt and network_inputs.txt. --cases FOLDER caches which problems are drawn.
Problems are held out; the straight line does not solve them, and ten seconds of search do. A motion counts as
solved if it passed the validator.

- alone: 16 samples as the sampler returns them. The model's inputs about obstacles are the embedding of
  their point cloud and the clearances of the links along the noisy motion. Rows of the table change one
  input: the embedding is that of another scene of the family; the whole condition (embedding, start and
  goal) is hidden; the clearances are computed without obstacles. Guidance knows the obstacles in every row.
  The controls apply guidance to smooth noise, from which the model starts too: with as many gradient steps as
  the network, and with as many as fit in the network's CPU time.
- controls: only the guided network and the controls of `alone`; prints
  benchmarks/results/network_equal_time.txt.
"""

import argparse
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from math import ceil
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy import ndarray

from common import WIDTH, draw_hard_cases, header, parse, parts_of, print_table
from robotdiffuse.baselines.controls import ControlSettings
from robotdiffuse.collision import CollisionChecker
from robotdiffuse.core import tables
from robotdiffuse.core.tables import Cell, Column, Table, show
from robotdiffuse.evaluation.bench_comparisons import bootstrap_interval, wilson_interval
from robotdiffuse.evaluation.runs import (
    NETWORK_ALONE,
    Draw,
    Record,
    Run,
    clocked,
    from_control,
    from_network,
    run_all,
    sampled,
)
from robotdiffuse.learning.motion_model import MAX_CLEARANCE, ClearanceFn, MotionModel
from robotdiffuse.planning.diffusion import Diffusion
from robotdiffuse.problems.families import FAMILIES
from robotdiffuse.problems.files import Case
from robotdiffuse.problems.problem import Problem
from robotdiffuse.robots import load_robot

PANDA = load_robot("panda")
PARTS = ("alone", "controls")
# For the number of gradient steps that take as much CPU time as the network: number of problems and of rounds
# that are timed, and two numbers of steps, between which times are interpolated.
TIMED = 10
TIMED_ROUNDS = 4
TIMED_STEPS = (10, 60)


class Summary(NamedTuple):
    """A column of a table, and the function that computes its figure from the records of a method."""

    column: Column
    compute: Callable[[Sequence[Record]], Cell]


def _solved(records: Sequence[Record]) -> Cell:
    return share([record.solved for record in records])


def share(passed: Sequence[bool]) -> Cell:
    """The fraction of true values in per cent with its 95 % interval."""
    low, high = wilson_interval(int(np.sum(passed)), len(passed))
    text = f"{100 * np.mean(passed):.1f} % ({100 * low:.1f} to {100 * high:.1f})"
    return tables.Figure(text, float(np.mean(passed)))


def _single(records: Sequence[Record]) -> Cell:
    """The mean with half the width of its 95 % interval."""
    shares = 100 * np.array([record.passed or 0.0 for record in records])
    half = 1.96 * shares.std() / len(shares) ** 0.5
    return tables.Figure(f"{shares.mean():.1f} ± {half:.1f} %", float(shares.mean()) / 100)


def _ratio(records: Sequence[Record]) -> Cell:
    ratios = [r.joint_length / r.reference for r in records if r.joint_length is not None and r.reference]
    return float(np.mean(ratios)) if ratios else None


def _cpu(records: Sequence[Record]) -> Cell:
    seconds = [record.cpu for record in records if record.cpu is not None]
    median, most = (1e3 * np.percentile(seconds, (50, 95))).tolist()
    return tables.Figure(f"{median:.1f} / {most:.1f}", median)


SINGLE = Summary(Column("single", better="more"), _single)
"""Fraction of the samples that pass the validator."""
BEST = Summary(Column("best", better="more"), _solved)
"""Fraction of the problems with at least one sample that passes the validator."""
SOLVED = Summary(Column("solved", better="more"), _solved)
LENGTH = Summary(Column("length*", "", ".3f", "less"), _ratio)
"""Mean ratio to the cases' reference lengths."""
CPU = Summary(Column("CPU ms median / p95", better="less"), _cpu)


def summary(title: str, records: Mapping[str, Sequence[Record]], figures: Sequence[Summary]) -> Table:
    """A table with a row for each method. records: those of each method."""
    rows = [(name, *(figure.compute(own) for figure in figures)) for name, own in records.items()]
    return Table.of(title, [Column(""), *(figure.column for figure in figures)], rows)


def clearances_without_obstacles(model: MotionModel) -> ClearanceFn:
    """A function for the clearance inputs of a model as in a scene without obstacles. Guidance still knows
    the obstacles."""
    links = len(model.robot.links)
    width = model.dof if model.settings.clearance_gradients else 0

    def clearances(q: ndarray) -> ndarray:
        inputs = np.zeros((*q.shape[:2], links + width), np.float32)
        inputs[..., :links] = MAX_CLEARANCE
        return inputs

    return clearances


def network_methods(planner: Diffusion, cases: list[Case]) -> dict[str, Draw]:
    """The network with guidance and without, and with fewer of its inputs."""

    def other(run: Run) -> Problem:
        return cases[(run.index + 1) % len(cases)].problem

    unguided = Diffusion(replace(planner.settings, guidance_steps=0))
    model = planner.network(PANDA)
    blind = clearances_without_obstacles(model)
    methods: dict[str, Draw] = {}
    for name, sampler in (("guided", planner), ("without guidance", unguided)):
        methods |= {
            name: from_network(sampler),
            f"{name}, embedding of another scene": from_network(sampler, other),
            f"{name}, clearances hidden": from_network(sampler, clearances=blind),
            f"{name}, both": from_network(sampler, other, blind),
        }
        if model.settings.null_condition:
            methods[f"{name}, condition hidden"] = from_network(
                Diffusion(replace(sampler.settings, guidance_scale=0.0))
            )
    return methods


def controls(planner: Diffusion, cases: list[Case]) -> dict[str, Draw]:
    """The network with guidance, and smooth noise with as many gradient steps and with as much CPU time."""
    settings = planner.settings
    assert settings.sampling_steps is not None
    as_many = settings.guidance_steps * ceil(settings.guided_share * settings.sampling_steps)
    steps = equal_time_steps(planner, cases[:TIMED])
    return {
        "guided": from_network(planner),
        "control: smooth noise, as many gradient steps": noise(planner, as_many),
        f"control: smooth noise, equal CPU time ({steps} gradient steps)": noise(planner, steps),
    }


def noise(planner: Diffusion, steps: int) -> Draw:
    """Smooth noise after some gradient steps, with as many candidates as the planner draws samples."""
    return from_control(ControlSettings(samples=planner.settings.samples, guidance_steps=steps))


def equal_time_steps(planner: Diffusion, cases: list[Case]) -> int:
    """The number of gradient steps on smooth noise that take as much CPU time as a batch of the network under
    guidance."""
    few, many = TIMED_STEPS
    draws = [from_network(planner), noise(planner, few), noise(planner, many)]
    seconds = np.zeros((TIMED_ROUNDS, len(cases), len(draws)))
    for turn in seconds:  # the first is left out: it loads and compiles
        for i, case in enumerate(cases):
            for j, draw in enumerate(draws):
                with clocked() as took:
                    draw(Run(case, i, "", 1), CollisionChecker(PANDA, case.problem.scene))
                turn[i, j] = took["cpu"]
    network, short, long = np.median(seconds[1:], axis=0).mean(axis=0)
    return max(round(few + (network - short) * (many - few) / (long - short)), 1)


def print_worth_of_inputs(records: dict[str, list[Record]]) -> None:
    """Print how much single-sample success falls if an input of the network is changed, on all families
    together."""
    rows = []
    for name in ("guided", "without guidance"):
        unchanged = np.array([record.passed or 0.0 for record in records[name]])
        for change in ("embedding of another scene", "condition hidden", "clearances hidden"):
            losses = unchanged - [record.passed or 0.0 for record in records[f"{name}, {change}"]]
            low, high = (100 * x for x in bootstrap_interval(losses))
            rows.append((name, change, f"{100 * losses.mean():+.1f} ({low:+.1f} to {high:+.1f})"))
    print_table(
        f"{len(unchanged)} problems: single samples, percentage points",
        ["network", "less", "mean (95 %)"],
        rows,
    )


def report_alone(
    family: str, cases: list[Case], weights: str | None, inputs: bool
) -> dict[str, list[Record]]:
    """Print the success of the network alone, and if `inputs` is true also with each input changed. Returns
    the records of each method."""
    planner = Diffusion(replace(NETWORK_ALONE, weights=weights))
    draws = (network_methods(planner, cases) if inputs else {}) | controls(planner, cases)
    methods = {name: sampled(draw) for name, draw in draws.items()}
    records = run_all(cases, methods, seeds=(1,), title=family)
    show(summary("Network alone, 16 samples", records, (SINGLE, BEST, LENGTH, CPU)), width=WIDTH)
    return records


def main() -> None:
    parser = argparse.ArgumentParser(description="The network alone.")
    parser.add_argument(
        "--parts", default="alone", help=f"parts of {','.join(PARTS)}, separated by commas (alone)"
    )
    parser.add_argument("--families", default=",".join(FAMILIES), help="families of problems (all)")
    parser.add_argument(
        "--problems", type=int, default=500, help="number of non-trivial problems of each family (500)"
    )
    parser.add_argument("--cases", type=Path, help="folder that caches which problems are drawn")
    parser.add_argument("--weights", help="folder of a trained model; default: the bundled one")
    arguments = parse(parser, parts=",".join(PARTS), families="rop", problems=2)
    parts = parts_of(arguments.parts, PARTS)
    families = parts_of(arguments.families, FAMILIES)
    print(header("numpy", "numba", "onnxruntime"))
    print(f"weights: {arguments.weights or 'the bundled ones'}")
    alone = dict[str, list[Record]]()
    for family in families:
        cases = draw_hard_cases(family, arguments.problems, arguments.cases)
        print(f"\n== {family}, {len(cases)} problems\n", flush=True)
        inputs = "alone" in parts
        for name, records in report_alone(family, cases, arguments.weights, inputs).items():
            alone.setdefault(name, []).extend(records)
    if any("condition hidden" in name for name in alone):
        print_worth_of_inputs(alone)
    print(
        "\n* joint-space length against a path of `aorrtc`, mean of ratios\n"
        "single: share of samples that pass the validator; best: share of problems with such a sample; with "
        "95 %\nintervals. Times are CPU time, as the machine may do other work."
    )


if __name__ == "__main__":
    main()
