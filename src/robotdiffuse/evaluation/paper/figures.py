"""The paper's figures 1 and 3 as data and plots: denoising, success over time, two motions of one problem."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path as FilePath
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.core.types import Path
from robotdiffuse.evaluation.bench import plots
from robotdiffuse.evaluation.bench.figures import sections
from robotdiffuse.evaluation.bench.run_folder import Bench
from robotdiffuse.evaluation.methods import NETWORK_ALONE, from_network, sampled, sampling_digest
from robotdiffuse.evaluation.paper.problems import JOINT, POSE
from robotdiffuse.evaluation.problem_sets import hard_cases, read_cases
from robotdiffuse.evaluation.records import Record
from robotdiffuse.evaluation.runs import run_all
from robotdiffuse.evaluation.statistics import bootstrap_interval
from robotdiffuse.evaluation.style import as_svg, make_figure, percent_axis, style
from robotdiffuse.learning.clearance_features import link_clearances
from robotdiffuse.learning.samplers import SAMPLERS
from robotdiffuse.learning.weights_registry import weights_for
from robotdiffuse.planning.diffusion.diffusion import encode
from robotdiffuse.planning.diffusion.hybrid import RobotDiffuse, RobotDiffuseSettings
from robotdiffuse.problems.held_out import Case, goal_of
from robotdiffuse.problems.problem import Problem
from robotdiffuse.robots import load_robot

STEPS = (1, 2, 5, 10, 50, 200)
"""Denoising steps of the plot of success."""
SHOWN_STEPS, SHOWN = 20, (0, 10, 15, 18)
"""Denoising steps of the motion that is drawn, and those of them, counted from the first, that are."""
COMPARED = ("diffusion", "mpinets")
"""Planners of figure 3b, as in the paper."""


class Noisy(NamedTuple):
    """A motion on its way from noise."""

    level: float
    """Noise level as a part of T; 0 for the motion itself."""
    path: Path


def denoising(problem: Problem, seed: int = 0) -> list[Noisy]:
    """One motion of the bundled network at several noise levels, without guidance, the noisiest first."""
    planner, rng, robot = RobotDiffuse(), np.random.default_rng(seed), problem.robot
    model = planner.model(robot)
    assert model is not None
    checker = CollisionChecker(robot, problem.scene)
    code = encode(model, checker, planner.settings.points, rng)
    start, goal = problem.start, goal_of(problem)
    reference = model.reference(start[None], goal[None])
    predict = model.predictor(
        reference, model.condition(code, start, goal), link_clearances(checker, model.settings)
    )
    states: list[tuple[float, ndarray]] = []

    def recorded(x: ndarray, level: int) -> ndarray:
        states.append((level / model.schedule.steps, model.hold_ends(x.copy(), reference)))
        return predict(x, level)

    draw = SAMPLERS.load("ddim")
    x = draw(recorded, model.schedule, lambda: model.draw_noise(1, rng), SHOWN_STEPS, 0.0)
    kept = [states[i] for i in SHOWN] + [(0.0, model.hold_ends(x.copy(), reference))]
    return [
        Noisy(level, Path(robot.joint_names, _joints(model.joints(state, reference)[0], problem)))
        for level, state in kept
    ]


def _joints(q: Float[ndarray, "n dof"], problem: Problem) -> Float[ndarray, "n dof"]:
    q = np.clip(q.astype(np.float64), problem.robot.lower, problem.robot.upper)
    q[0], q[-1] = problem.start, goal_of(problem)
    return q


def success_by_steps(out: FilePath, count: int) -> dict[str, dict[int, list[Record]]]:
    """Records of 16 samples of the network on `count` problems that the straight line does not solve, by
    guidance and denoising steps; the folder keeps them."""
    cases, weights = hard_cases("rop", count, out / "problems"), weights_for("model", load_robot("panda"))
    found: dict[str, dict[int, list[Record]]] = {}
    for name, guidance in (("no guidance", 0), ("guidance", RobotDiffuseSettings().guidance_steps)):
        of_steps = {
            steps: replace(NETWORK_ALONE, guidance_steps=guidance, sampling_steps=steps) for steps in STEPS
        }
        methods = {
            f"{name}, {steps} steps, {sampling_digest(settings, weights)}": sampled(
                from_network(RobotDiffuse(settings))
            )
            for steps, settings in of_steps.items()
        }
        records = run_all(cases, methods, seeds=(1,), folder=out / "figures", title=f"figure 1, {name}")
        found[name] = dict(zip(STEPS, records.values(), strict=True))
    return found


def plot_success_by_steps(found: dict[str, dict[int, list[Record]]]) -> str:
    """The share of single samples that pass the validator over the number of denoising steps, as SVG."""
    with style():
        figure = make_figure(6, 3.2)
        axes = figure.subplots()
        for (name, of), color in zip(found.items(), ("#41597a", "#0c9b74"), strict=True):
            shares = [np.array([r.passed or 0.0 for r in records]) for records in of.values()]
            mean = np.array([x.mean() for x in shares])
            low, high = np.array([bootstrap_interval(x) for x in shares]).T
            bars = 100 * np.stack([mean - low, high - mean]).clip(0)
            axes.errorbar(list(of), 100 * mean, bars, fmt="o-", ms=4, color=color, label=name)
        axes.set(xscale="log", xlabel="denoising steps T", ylim=(0, 102))
        axes.set_xticks(STEPS, [str(steps) for steps in STEPS])
        axes.minorticks_off()
        axes.set_ylabel("single samples that pass the validator")
        percent_axis(axes)
        axes.legend(loc="lower right")
        return as_svg(figure)


def plot_success_over_time(bench: Bench) -> str:
    """Figure 3a, with the paper's method in it: success over time on the problems with poses, as SVG."""
    plain = {name: records for name, records in bench.records.items() if ":" not in name}
    section = next(section for section in sections(replace(bench, records=plain)) if section.name == POSE)
    with style():
        return plots.success_over_time(section, list(plain))


@dataclass(frozen=True, eq=False)
class Compared:
    """Motions of one problem."""

    case: Case
    motions: dict[str, Path]
    """By planner."""


def compared_motions(bench: Bench, planners: Sequence[str] = COMPARED) -> Compared | None:
    """The problem that is not trivial and solved by all of these planners on which their lengths differ
    most; None without one."""
    solved = {
        planner: {
            (r.problem_set, r.name): r for r in bench.records.get(planner, ()) if r.solved and not r.trivial
        }
        for planner in planners
    }
    keys = sorted(set.intersection(*map(set, solved.values())))
    if not keys:
        return None

    def ratio(key: tuple[str, str]) -> float:
        lengths = [of[key].joint_length or 1.0 for of in solved.values()]
        return max(lengths) / min(lengths)

    best = max(keys, key=ratio)
    case = next(case for name in (POSE, JOINT) for case in read_cases(bench.folder, name) if case.key == best)
    names = case.problem.robot.joint_names
    return Compared(case, {planner: Path(names, of[best].waypoints) for planner, of in solved.items()})
