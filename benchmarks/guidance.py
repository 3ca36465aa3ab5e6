"""Guidance: success of the network alone against sampling steps, gradient steps and classifier-free scale.

    python benchmarks/guidance.py [--problems 60] [--family rop] [--cases FOLDER] [--weights FOLDER]

Prints the report that is kept in benchmarks/results/guidance.txt and draws guidance.png beside it, or where
--plot says. Held-out problems that the straight line does not solve and ten seconds of search do; 16 samples
of each, straight from the sampler, judged as they are. Every setting of a table gets the same problems; the
classifier-free scales get half of them, and 50 and 200 sampling steps, which take long, are tried with no and
with the usual gradient steps only.
"""

import argparse
import time
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from report import header, print_table, progress, wilson

from problems import SEED, Case, draw_cases, goal_of, judged
from robotdiffuse.collision import CollisionChecker
from robotdiffuse.evaluation.trials import NETWORK_ALONE
from robotdiffuse.planners.robotdiffuse import RobotDiffuse, RobotDiffuseSettings, encode
from robotdiffuse.problems.families import FAMILIES

STEPS = (1, 2, 5, 10, 50, 200)
"""Sampling steps."""
LONG = 50
"""From so many on, not every number of gradient steps is tried."""
GRADIENT_STEPS = (0, 2, 4, 8)
"""At each guided sampling step; 0 is without collision guidance."""
SCALES = (0.0, 1.0, 1.5, 2.0, 4.0)
"""Of classifier-free guidance: 1 is the network itself; at 0 its condition is hidden, and what it is told of
the ends and of clearances along the motion is left."""
SCALED_STEPS = (1, 2, 5, 10)
"""Sampling steps that the scales are tried with."""
COLORS = ("#8a94a3", "#7fb3e0", "#3f7fc4", "#14487f", "#d1495b")


class Share(NamedTuple):
    """What became of one setting."""

    single: float
    half: float
    """Of the 95 % interval of `single`, over the problems."""
    best: float
    best_low: float
    """95 % interval of `best`."""
    best_high: float
    problems: int
    seconds: float
    """CPU time of a batch, median."""

    @property
    def row(self) -> list[str]:
        best = f"{100 * self.best:.1f} % ({100 * self.best_low:.0f} to {100 * self.best_high:.0f})"
        single = f"{100 * self.single:.1f} ± {100 * self.half:.1f} %"
        return [f"{self.problems}", single, best, f"{1e3 * self.seconds:.0f}"]


def success(settings: RobotDiffuseSettings, loaded: RobotDiffuse, cases: list[Case], title: str) -> Share:
    """Of a batch for each problem; the same random numbers for all settings."""
    planner = RobotDiffuse(replace(settings, weights=None))
    single, best, seconds = [], [], []
    for i, case in enumerate(progress(cases, title)):
        problem, rng = case.problem, np.random.default_rng([SEED, 5, i])
        model = loaded.model(problem.robot)
        assert model is not None
        checker = CollisionChecker(problem.robot, problem.scene)
        code = encode(model, checker, settings.points, rng)
        began = time.process_time()
        q = planner.sample(model, checker, code, problem.start, goal_of(problem)[None], rng).q
        seconds.append(time.process_time() - began)
        passed = judged(problem, q)
        single.append(passed.mean())
        best.append(bool(passed.any()))
    half = 1.96 * float(np.std(single)) / len(cases) ** 0.5
    return Share(float(np.mean(single)), half, *wilson(best), len(cases), float(np.median(seconds)))


def collision_guidance(loaded: RobotDiffuse, cases: list[Case]) -> dict[int, dict[int, Share]]:
    """By gradient steps and sampling steps."""
    found: dict[int, dict[int, Share]] = {}
    for gradient in GRADIENT_STEPS:
        found[gradient] = {}
        for steps in STEPS:
            if steps >= LONG and gradient not in (0, loaded.settings.guidance_steps):
                continue
            settings = replace(loaded.settings, guidance_steps=gradient, sampling_steps=steps)
            title = f"{gradient} gradient steps, {steps} sampling steps"
            found[gradient][steps] = success(settings, loaded, cases, title)
    rows = [
        [f"{gradient}" if gradient else "none", f"{steps}", *share.row]
        for gradient, by_steps in found.items()
        for steps, share in by_steps.items()
    ]
    columns = ["gradient steps", "sampling steps", "problems", "single", "best of 16", "CPU ms"]
    print_table("Collision guidance", columns, rows)
    return found


def classifier_free(loaded: RobotDiffuse, cases: list[Case]) -> dict[int, dict[float, dict[int, Share]]]:
    """By gradient steps (none, and as usual), scale and sampling steps."""
    usual = loaded.settings.guidance_steps
    found: dict[int, dict[float, dict[int, Share]]] = {0: {}, usual: {}}
    for gradient, by_scale in found.items():
        for scale in SCALES:
            by_scale[scale] = {}
            for steps in SCALED_STEPS:
                settings = replace(
                    loaded.settings, guidance_steps=gradient, sampling_steps=steps, guidance_scale=scale
                )
                title = f"scale {scale}, {gradient} gradient steps, {steps} sampling steps"
                by_scale[scale][steps] = success(settings, loaded, cases, title)
    rows = [
        [f"{scale:g}", f"{gradient}" if gradient else "none", f"{steps}", *share.row]
        for gradient, by_scale in found.items()
        for scale, by_steps in by_scale.items()
        for steps, share in by_steps.items()
    ]
    columns = ["scale", "gradient steps", "sampling steps", "problems", "single", "best of 16", "CPU ms"]
    print_table("Classifier-free guidance", columns, rows)
    return found


def line(axes: Axes, by_steps: dict[int, Share], what: str, place: int, label: str) -> None:
    """Success over sampling steps with its interval; lines stand a little apart."""
    shares = list(by_steps.values())
    at = np.array(list(by_steps)) * 1.035 ** (place - 2)
    middle = np.array([getattr(share, what) for share in shares])
    if what == "single":
        half = np.array([share.half for share in shares])
        low, high = (middle - half).clip(0, 1), (middle + half).clip(0, 1)
    else:
        low, high = (np.array([getattr(share, f"best_{end}") for share in shares]) for end in ("low", "high"))
    error = 100 * np.stack([middle - low, high - middle]).clip(0)
    axes.errorbar(at, 100 * middle, error, fmt="o-", color=COLORS[place], label=label, ms=4, elinewidth=0.8)


def draw(
    collision: dict[int, dict[int, Share]],
    free: dict[int, dict[float, dict[int, Share]]],
    title: str,
    file: Path,
) -> None:
    rows = 2 if free else 1
    figure = Figure(figsize=(11, 4 * rows), layout="constrained")
    panels = figure.subplots(rows, 2, sharey=True, squeeze=False)
    for axes, what, name in zip(panels[0], ("single", "best"), ("single sample", "best of 16"), strict=True):
        for place, (gradient, by_steps) in enumerate(collision.items()):
            label = f"{gradient} gradient steps" if gradient else "no collision guidance"
            line(axes, by_steps, what, place, label)
        axes.set_title(f"{name}, {title}")
    for axes, (gradient, by_scale) in zip(panels[-1], free.items() if free else (), strict=False):
        for place, (scale, by_steps) in enumerate(by_scale.items()):
            line(axes, by_steps, "single", place, f"scale {scale:g}")
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
        axes.set_ylabel("motions that pass the judge, %")
    file.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(file, dpi=130)


def main() -> None:
    parser = argparse.ArgumentParser(description="Success of the network against steps and guidance.")
    parser.add_argument("--problems", type=int, default=60, help="non-trivial ones (60)")
    parser.add_argument("--family", default="rop", choices=list(FAMILIES), help="of scenes (rop)")
    parser.add_argument("--cases", type=Path, help="folder that keeps what is known of the problems")
    parser.add_argument("--weights", help="folder of a trained model; default: the bundled one")
    results = Path(__file__).parent / "results"
    parser.add_argument("--plot", type=Path, default=results / "guidance.png", help="where the plot goes")
    arguments = parser.parse_args()
    print(header("numpy", "numba", "torch"))
    print(f"weights: {arguments.weights or 'the bundled ones'}; {arguments.family}")
    cases = draw_cases(arguments.family, arguments.problems, arguments.cases).hard
    loaded = RobotDiffuse(replace(NETWORK_ALONE, weights=arguments.weights))
    model = loaded.model(cases[0].problem.robot)
    assert model is not None
    success(loaded.settings, loaded, cases[:1], "compiling")
    collision = collision_guidance(loaded, cases)
    free = {}
    if model.config.null_condition:
        free = classifier_free(loaded, cases[: max(len(cases) // 2, 1)])
    else:
        print("Classifier-free guidance: left out, these weights were trained without dropping the condition")
    print("95 % intervals over the problems; CPU time of a batch of 16, without encoder and judge, median")
    draw(collision, free, arguments.family, arguments.plot)


if __name__ == "__main__":
    main()
