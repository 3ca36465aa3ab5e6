"""The diffusion model alone, with and without its inputs, under guidance; the whole planner beside it.

    python benchmarks/learning.py [--families rop,shelf] [--problems 500] [--cases FOLDER] [--weights FOLDER]
        [--parts alone,planner,code]
    python benchmarks/learning.py --parts guidance [--family rop] [--problems 60] [--plot guidance.png]

Parts `alone`, `planner` and `code` print benchmarks/results/network.txt and network_inputs.txt, `guidance`
prints guidance.txt and draws guidance.png. FOLDER of cases keeps what is known of the problems. Problems are
held out; the straight line does not solve them, and ten seconds of search do. What counts as solved passed
the validator.

- alone: 16 samples, straight from the sampler. The model's inputs on obstacles are the code of their point
cloud and
  the clearances of the links along the noisy motion. Rows take each away: the code of another scene of the
  family; the whole condition, which is code, start and goal; clearances as if there were no obstacles.
  Guidance, where there is some, knows the obstacles in any case. The controls are guidance of smooth noise,
  which is what the model starts from: with as many gradient steps, and with as many as fit in the network's
  CPU time.
- controls: of `alone`, the guided network and the controls; prints benchmarks/results/network_equal_time.txt.
- planner: the whole planner; PyBullet checks its motions on meshes.
- code: the whole planner, which does without the code, beside itself with the code.
- guidance: single samples and best of 16 against sampling steps, gradient steps and classifier-free scale.
Every
  setting of a table gets the same problems; classifier-free scales get half of them, and 50 and 200 sampling
  steps are tried with no and with the usual number of gradient steps only.
"""

import argparse
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy import ndarray

from common import TIME_LIMIT, WIDTH, draw_hard_cases, header, parse, parts_of, print_table
from robotdiffuse.collision import CollisionChecker
from robotdiffuse.core.types import Path as JointPath
from robotdiffuse.evaluation import tables
from robotdiffuse.evaluation.methods import (
    NETWORK_ALONE,
    Draw,
    fields_of,
    from_network,
    measure_of,
    planned,
    sampled,
    without_network,
)
from robotdiffuse.evaluation.records import Record
from robotdiffuse.evaluation.runs import Clock, Fields, Method, Run, run_all
from robotdiffuse.evaluation.statistics import bootstrap_interval, wilson_interval
from robotdiffuse.evaluation.tables import Cell, Column, Table, show
from robotdiffuse.learning.motion_model import MotionModel
from robotdiffuse.planning.diffusion.diffusion import encode
from robotdiffuse.planning.diffusion.hybrid import RobotDiffuse, RobotDiffuseSettings
from robotdiffuse.problems.families import FAMILIES
from robotdiffuse.problems.held_out import Case
from robotdiffuse.problems.problem import Problem
from robotdiffuse.robots import load_robot
from robotdiffuse.simulation.validator import PyBulletOracle

PANDA = load_robot("panda")
PARTS = ("alone", "controls", "planner", "code", "guidance")
PLANNER_LIMIT = 5.0
"""Time limit of the whole planner [s]."""
EQUAL_TIME = 0.5
"""In which the whole planner is compared with itself with the code [s]."""
STEPS = (1, 2, 5, 10, 50, 200)
"""Sampling steps."""
LONG_SAMPLING = 50
"""From so many sampling steps on, not every number of gradient steps is tried."""
GRADIENT_STEPS = (0, 2, 4, 8)
"""At each guided sampling step; 0 is without collision guidance."""
SCALES = (0.0, 1.0, 1.5, 2.0, 4.0)
"""Of classifier-free guidance: 1 is the network itself, 0 hides its condition and leaves the clearances."""
SCALED_STEPS = (1, 2, 5, 10)
"""Sampling steps that the scales are tried with."""
TIMED, TIMED_ROUNDS = 10, 4
"""Problems and rounds that the equal number of gradient steps is measured on."""
TIMED_STEPS = (10, 60)
COLORS = ("#8a94a3", "#7fb3e0", "#3f7fc4", "#14487f", "#d1495b")


class Summary(NamedTuple):
    """A column, and its figure of some records."""

    column: Column
    of: Callable[[Sequence[Record]], Cell]


def _solved(records: Sequence[Record]) -> Cell:
    return share([record.solved for record in records])


def share(passed: Sequence[bool]) -> Cell:
    """A share in per cent with its 95 % interval."""
    low, high = wilson_interval(int(np.sum(passed)), len(passed))
    text = f"{100 * np.mean(passed):.1f} % ({100 * low:.1f} to {100 * high:.1f})"
    return tables.Figure(text, float(np.mean(passed)))


def half_width(values: Sequence[float]) -> float:
    """Half the width of the 95 % interval of a mean."""
    return 1.96 * float(np.std(values)) / len(values) ** 0.5


def _single(records: Sequence[Record]) -> Cell:
    shares = [record.passed or 0.0 for record in records]
    return tables.Figure(
        f"{100 * np.mean(shares):.1f} ± {100 * half_width(shares):.1f} %", float(np.mean(shares))
    )


def _ratio(records: Sequence[Record]) -> Cell:
    ratios = [r.joint_length / r.reference for r in records if r.joint_length is not None and r.reference]
    return float(np.mean(ratios)) if ratios else None


def _cpu(records: Sequence[Record]) -> Cell:
    seconds = [record.cpu for record in records if record.cpu is not None]
    median, most = (1e3 * np.percentile(seconds, (50, 95))).tolist()
    return tables.Figure(f"{median:.1f} / {most:.1f}", median)


SINGLE = Summary(Column("single", better="more"), _single)
"""Share of the samples that pass the validator."""
BEST = Summary(Column("best", better="more"), _solved)
"""Share of problems with such a sample."""
SOLVED = Summary(Column("solved", better="more"), _solved)
LENGTH = Summary(Column("length*", "", ".3f", "less"), _ratio)
"""Mean ratio to the cases' reference lengths."""
CPU = Summary(Column("CPU ms median / p95", better="less"), _cpu)


def summary(title: str, of: Mapping[str, Sequence[Record]], figures: Sequence[Summary]) -> Table:
    """The table of each method's records."""
    rows = [(name, *(figure.of(records) for figure in figures)) for name, records in of.items()]
    return Table.of(title, [Column(""), *(figure.column for figure in figures)], rows)


Setting = tuple[int, float, int]
"""Gradient steps, classifier-free scale, sampling steps."""
Found = dict[Setting, list[Record]]


def network_methods(planner: RobotDiffuse, cases: list[Case]) -> dict[str, Draw]:
    """The network with guidance and without, and with fewer of its inputs."""

    def other(run: Run) -> Problem:
        return cases[(run.index + 1) % len(cases)].problem

    unguided = RobotDiffuse(replace(planner.settings, guidance_steps=0))
    model = planner.model(PANDA)
    assert model is not None
    found: dict[str, Draw] = {}
    for name, of in (("guided", planner), ("without guidance", unguided)):
        found |= {
            name: from_network(of),
            f"{name}, code of another scene": from_network(of, other),
            f"{name}, clearances hidden": from_network(of, hidden=True),
            f"{name}, both": from_network(of, other, hidden=True),
        }
        if model.settings.null_condition:
            found[f"{name}, condition hidden"] = from_network(
                RobotDiffuse(replace(of.settings, guidance_scale=0.0))
            )
    return found


def controls(planner: RobotDiffuse, cases: list[Case]) -> dict[str, Draw]:
    """The network with guidance, and smooth noise with as many gradient steps and with as much CPU time."""
    model = planner.model(PANDA)
    assert model is not None
    found = {"guided": from_network(planner)}
    waypoints = model.settings.waypoints
    found["control: smooth noise, as many gradient steps"] = without_network(planner.settings, waypoints)
    steps = equal_time_steps(planner, waypoints, cases[:TIMED])
    name = f"control: smooth noise, equal CPU time ({steps} gradient steps)"
    return found | {name: without_network(planner.settings, waypoints, steps)}


def equal_time_steps(planner: RobotDiffuse, waypoints: int, cases: list[Case]) -> int:
    """Gradient steps on smooth noise that take as much CPU time as a batch of the network under guidance."""
    few, many = TIMED_STEPS
    draws = [from_network(planner), *(without_network(planner.settings, waypoints, n) for n in (few, many))]
    seconds = np.zeros((TIMED_ROUNDS, len(cases), len(draws)))
    for turn in seconds:  # the first is left out: it loads and compiles
        for i, case in enumerate(cases):
            for j, draw in enumerate(draws):
                with Clock() as clock:
                    draw(Run(case, i, "", 1), CollisionChecker(PANDA, case.problem.scene))
                turn[i, j] = clock.cpu
    network, short, long = np.median(seconds[1:], axis=0).mean(axis=0)
    return max(round(few + (network - short) * (many - few) / (long - short)), 1)


def confirmed(planner: RobotDiffuse) -> Method:
    """The whole planner; `refuted` is 1 if its path or motion collides by PyBullet."""

    def call(run: Run) -> Iterator[Fields]:
        with Clock() as clock:
            result = planner.plan(run.problem, run.limit, seed=run.index)
        hit = False
        if result.path is not None and result.trajectory is not None:
            moved = JointPath(result.trajectory.joint_names, result.trajectory.positions)
            with PyBulletOracle(PANDA, run.problem.scene) as oracle:
                hit = any(oracle.check_path(path) is not None for path in (result.path, moved))
        yield fields_of(result, measure_of(PANDA)) | {"cpu": clock.cpu, "refuted": float(hit)}

    return call


class WithCode(RobotDiffuse):
    """The planner whose network gets the code of the scene."""

    def code(
        self, model: MotionModel, checker: CollisionChecker, rng: np.random.Generator
    ) -> Float[ndarray, "code"]:
        return encode(model, checker, self.settings.points, rng)


def compare_code(every: dict[str, list[Case]], settings: RobotDiffuseSettings) -> None:
    """Print path lengths of the whole planner with the code over those without."""
    planners = {"as it ships": RobotDiffuse(settings), "with the code": WithCode(settings)}
    for planner in planners.values():
        planner.warm_up(next(iter(every.values()))[0].problem, TIME_LIMIT)  # loads the network
    methods = {name: planned(planner, until=TIME_LIMIT, clearance=0.0) for name, planner in planners.items()}
    rows, ratios = [], dict[str, ndarray]()
    own = {name: list[bool]() for name in planners}
    for family, cases in every.items():
        found = run_all(cases, methods, seeds=(1, 2), limit=EQUAL_TIME, title=family)
        lengths = []
        for name, records in found.items():
            own[name] += [record.stage in ("network", "refinement") for record in records if record.solved]
            lengths.append(
                [record.measures["joint_length"] if record.solved else np.nan for record in records]
            )
        shipped, with_code = np.array(lengths).reshape(2, len(cases), -1)
        ratio = np.exp(np.log(with_code / shipped).mean(axis=1))
        ratios[family] = ratio[~np.isnan(ratio)]
    for family, of in [*ratios.items(), ("all", np.concatenate(list(ratios.values())))]:
        low, high = bootstrap_interval(of)
        rows.append((family, len(of), f"{of.mean():.5f} ({low:.5f} to {high:.5f})"))
    shares = ", ".join(f"{name} {np.mean(of):.1%}" for name, of in own.items())
    print_table(
        f"Whole planner with the code, lengths over those without, {EQUAL_TIME:g} s",
        ["family", "problems", "mean (95 %)"],
        rows,
        (f"answers that are the network's: {shares}",),
    )


def print_worth_of_inputs(found: dict[str, list[Record]]) -> None:
    """Print what each input of the network is worth on all families together."""
    rows = []
    for name in ("guided", "without guidance"):
        own = np.array([record.passed or 0.0 for record in found[name]])
        for taken in ("code of another scene", "condition hidden", "clearances hidden"):
            less = own - [record.passed or 0.0 for record in found[f"{name}, {taken}"]]
            low, high = (100 * x for x in bootstrap_interval(less))
            rows.append((name, taken, f"{100 * less.mean():+.1f} ({low:+.1f} to {high:+.1f})"))
    print_table(f"{len(own)} problems: single samples, points", ["network", "less", "mean (95 %)"], rows)


def report_alone(
    family: str, cases: list[Case], weights: str | None, inputs: bool
) -> dict[str, list[Record]]:
    """Print how the network does alone, and with `inputs` also without each of them; its records."""
    planner = RobotDiffuse(replace(NETWORK_ALONE, weights=weights))
    draws = (network_methods(planner, cases) if inputs else {}) | controls(planner, cases)
    methods = {name: sampled(draw) for name, draw in draws.items()}
    found = run_all(cases, methods, seeds=(1,), title=family)
    show(summary("Network alone, 16 samples", found, (SINGLE, BEST, LENGTH, CPU)), width=WIDTH)
    return found


def report_planner(family: str, cases: list[Case], weights: str | None) -> None:
    """Print how the whole planner does."""
    whole = confirmed(RobotDiffuse(RobotDiffuseSettings(weights=weights)))
    found = run_all(cases, {"robotdiffuse": whole}, limit=PLANNER_LIMIT, title=family)
    show(summary("Whole planner", found, (SOLVED, LENGTH, CPU)), width=WIDTH)
    print_stages(found["robotdiffuse"])


def print_stages(records: list[Record]) -> None:
    """Print which stages of the planner the answers come from, and what PyBullet says."""
    stages = Counter(record.stage or "nothing" for record in records)
    print("solved by " + ", ".join(f"{name} {n / len(records):.1%}" for name, n in sorted(stages.items())))
    refuted = sum(record.measures["refuted"] for record in records)
    print(f"motions that PyBullet finds in collision: {refuted:.0f} of {sum(r.solved for r in records)}")


def name_of(setting: Setting) -> str:
    gradient, scale, steps = setting
    guided = f"{gradient} gradient steps" if gradient else "no gradient steps"
    scaled = "" if scale == 1.0 else f", scale {scale:g}"
    return f"{guided}{scaled}, {steps} sampling steps"


def try_settings(loaded: RobotDiffuse, cases: list[Case], settings: Sequence[Setting], title: str) -> Found:
    """The records of each setting, one batch for each problem, with the same random numbers."""
    methods = {}
    for gradient, scale, steps in settings:
        changed = {"guidance_steps": gradient, "sampling_steps": steps, "guidance_scale": scale}
        planner = RobotDiffuse(replace(loaded.settings, **changed))
        drawn = from_network(planner)
        methods[name_of((gradient, scale, steps))] = sampled(drawn)
    found = run_all(cases, methods, seeds=(5,), title=title)
    show(summary(f"{title}, {len(cases)} problems", found, (SINGLE, BEST, CPU)), width=WIDTH)
    return {setting: found[name_of(setting)] for setting in settings}


def draw_line(axes: Axes, found: Found, what: str, place: int, label: str) -> None:
    """Draw success over sampling steps with its interval; lines are shifted a little apart."""
    at = np.array([steps for *_, steps in found]) * 1.035 ** (place - 2)
    rows = []
    for records in found.values():
        single, best = [r.passed or 0.0 for r in records], [r.solved for r in records]
        mean, half = float(np.mean(single)), half_width(single)
        low, high = wilson_interval(sum(best), len(best))
        rows.append((mean, mean - half, mean + half) if what == "single" else (np.mean(best), low, high))
    middle, low, high = np.array(rows).clip(0, 1).T
    error = 100 * np.stack([middle - low, high - middle]).clip(0)
    axes.errorbar(at, 100 * middle, error, fmt="o-", color=COLORS[place], label=label, ms=4, elinewidth=0.8)


def draw_guidance(collision: Found, free: Found, title: str, file: Path) -> None:
    rows = 2 if free else 1
    figure = Figure(figsize=(11, 4 * rows), layout="constrained")
    panels = figure.subplots(rows, 2, sharey=True, squeeze=False)
    for axes, what, name in zip(panels[0], ("single", "best"), ("single sample", "best of 16"), strict=True):
        for place, gradient in enumerate(GRADIENT_STEPS):
            label = f"{gradient} gradient steps" if gradient else "no collision guidance"
            draw_line(axes, {s: r for s, r in collision.items() if s[0] == gradient}, what, place, label)
        axes.set_title(f"{name}, {title}")
    for axes, gradient in zip(panels[-1], sorted({s[0] for s in free}), strict=False):
        for place, scale in enumerate(SCALES):
            of = {s: r for s, r in free.items() if s[:2] == (gradient, scale)}
            draw_line(axes, of, "single", place, f"scale {scale:g}")
        guided = f"{gradient} gradient steps" if gradient else "no collision guidance"
        axes.set_title(f"single sample by classifier-free scale, {guided}")
    for axes in panels.flat:
        ticks = STEPS if axes in panels[0] else SCALED_STEPS
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(axis="y", color="#e3e6ea", lw=0.8)
        axes.set(xscale="log", xlabel="sampling steps", ylim=(0, 102))
        axes.set_xticks(ticks, [str(steps) for steps in ticks])
        axes.minorticks_off()
        axes.legend(frameon=False, loc="lower left")
    for axes in panels[:, 0]:
        axes.set_ylabel("motions that pass the validator, %")
    file.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(file, dpi=130)


def report_guidance(family: str, cases: list[Case], arguments: argparse.Namespace) -> None:
    """Print and draw success against steps and scales."""
    planner = RobotDiffuse(replace(NETWORK_ALONE, weights=arguments.weights))
    model, usual = planner.model(PANDA), planner.settings.guidance_steps
    assert model is not None
    steps = [n for n in STEPS if n <= arguments.most_steps]
    grid = [(g, 1.0, n) for g in GRADIENT_STEPS for n in steps if n < LONG_SAMPLING or g in (0, usual)]
    collision, free = try_settings(planner, cases, grid, "Collision guidance"), {}
    if model.settings.null_condition:
        few = [n for n in SCALED_STEPS if n <= arguments.most_steps]
        scaled = [(g, scale, n) for g in (0, usual) for scale in SCALES for n in few]
        half = cases[: max(len(cases) // 2, 1)]
        free = try_settings(planner, half, scaled, "Classifier-free guidance")
    else:
        print("Classifier-free guidance: left out; these weights were trained without dropping the condition")
    print("single: of 16 samples; best: problems with one that passes. 95 % intervals over the problems;")
    print("CPU time of a batch, encoder included, without the validator")
    if arguments.plot:
        draw_guidance(collision, free, family, arguments.plot)


def main() -> None:
    parser = argparse.ArgumentParser(description="The network alone, guidance, and the whole planner.")
    parser.add_argument(
        "--parts", default="alone,planner,code", help=f"of {','.join(PARTS)} (the first three)"
    )
    parser.add_argument("--families", default=",".join(FAMILIES), help="of problems (all)")
    parser.add_argument("--family", default="rop", choices=list(FAMILIES), help="for guidance (rop)")
    parser.add_argument("--problems", type=int, help="non-trivial ones of each family (500; guidance: 60)")
    parser.add_argument("--cases", type=Path, help="folder that keeps what is known of the problems")
    parser.add_argument("--weights", help="folder of a trained model; default: the bundled one")
    parser.add_argument("--most-steps", type=int, default=STEPS[-1], help="of sampling, for guidance (all)")
    parser.add_argument("--plot", type=Path, help="file for the plot of guidance")
    arguments = parse(parser, parts=",".join(PARTS), families="rop", problems=2, most_steps=2)
    parts, families = parts_of(arguments.parts, PARTS), parts_of(arguments.families, FAMILIES)
    print(header("numpy", "numba", "onnxruntime"))
    print(f"weights: {arguments.weights or 'the bundled ones'}")
    every = dict[str, list[Case]]()
    if set(parts) - {"guidance"}:
        every = {name: draw_hard_cases(name, arguments.problems or 500, arguments.cases) for name in families}
    alone = dict[str, list[Record]]()
    for family, cases in every.items():
        print(f"\n== {family}, {len(cases)} problems\n", flush=True)
        if {"alone", "controls"} & set(parts):
            inputs = "alone" in parts
            for name, records in report_alone(family, cases, arguments.weights, inputs).items():
                alone.setdefault(name, []).extend(records)
        if "planner" in parts:
            report_planner(family, cases, arguments.weights)
    if any("condition hidden" in name for name in alone):
        print_worth_of_inputs(alone)
    if "code" in parts:
        compare_code(every, RobotDiffuseSettings(weights=arguments.weights))
    if every:
        print(
            "\n* joint-space length against a path of `aorrtc`, mean of ratios\n"
            "single: share of samples that pass the validator; best: problems with one that does; with "
            "95 %\nintervals. Times are CPU time, as the machine may do other work."
        )
    if "guidance" in parts:
        cases = draw_hard_cases(arguments.family, arguments.problems or 60, arguments.cases)
        report_guidance(arguments.family, cases, arguments)


if __name__ == "__main__":
    main()
