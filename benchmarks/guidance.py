"""Guidance: success of the network alone against sampling steps, gradient steps and classifier-free scale.

    python benchmarks/guidance.py [--problems 60] [--family rop] [--cases FOLDER] [--weights FOLDER]

Prints the report that is kept in benchmarks/results/guidance.txt and draws guidance.png beside it, or where
--plot says. Held-out problems that the straight line does not solve and ten seconds of search do; 16 samples
of each, straight from the sampler, validated as they are. Every setting of a table gets the same problems; the
classifier-free scales get half of them, and 50 and 200 sampling steps, which take long, are tried with no and
with the usual gradient steps only.
"""

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from report import WIDTH, header

from problems import PANDA, Case, draw_cases
from robotdiffuse.evaluation.methods import NETWORK_ALONE, from_network, sampled
from robotdiffuse.evaluation.records import Record
from robotdiffuse.evaluation.runs import tried
from robotdiffuse.evaluation.statistics import wilson_interval
from robotdiffuse.evaluation.summary import BEST, CPU, SINGLE, half_width, summary
from robotdiffuse.evaluation.tables import show
from robotdiffuse.planning.diffusion.hybrid import RobotDiffuse
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

Setting = tuple[int, float, int]
"""Gradient steps, classifier-free scale, sampling steps."""
Found = dict[Setting, list[Record]]


def name_of(setting: Setting) -> str:
    gradient, scale, steps = setting
    guided = f"{gradient} gradient steps" if gradient else "no gradient steps"
    scaled = "" if scale == 1.0 else f", scale {scale:g}"
    return f"{guided}{scaled}, {steps} sampling steps"


def try_all(loaded: RobotDiffuse, cases: list[Case], settings: Sequence[Setting], title: str) -> Found:
    """One batch for each problem; the same random numbers for all settings."""
    methods = {}
    for gradient, scale, steps in settings:
        changed = replace(
            loaded.settings, guidance_steps=gradient, sampling_steps=steps, guidance_scale=scale
        )
        methods[name_of((gradient, scale, steps))] = sampled(from_network(RobotDiffuse(changed)))
    found = tried(cases, methods, seeds=(5,), title=title)
    show(summary(f"{title}, {len(cases)} problems", found, (SINGLE, BEST, CPU)), width=WIDTH)
    return {setting: found[name_of(setting)] for setting in settings}


def line(axes: Axes, found: Found, what: str, place: int, label: str) -> None:
    """Success over sampling steps with its interval; lines stand a little apart."""
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


def draw(collision: Found, free: Found, title: str, file: Path) -> None:
    rows = 2 if free else 1
    figure = Figure(figsize=(11, 4 * rows), layout="constrained")
    panels = figure.subplots(rows, 2, sharey=True, squeeze=False)
    for axes, what, name in zip(panels[0], ("single", "best"), ("single sample", "best of 16"), strict=True):
        for place, gradient in enumerate(GRADIENT_STEPS):
            label = f"{gradient} gradient steps" if gradient else "no collision guidance"
            line(axes, {s: r for s, r in collision.items() if s[0] == gradient}, what, place, label)
        axes.set_title(f"{name}, {title}")
    for axes, gradient in zip(panels[-1], sorted({s[0] for s in free}), strict=False):
        for place, scale in enumerate(SCALES):
            of = {s: r for s, r in free.items() if s[:2] == (gradient, scale)}
            line(axes, of, "single", place, f"scale {scale:g}")
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
    model, usual = loaded.model(PANDA), loaded.settings.guidance_steps
    assert model is not None
    tried(cases[:1], {"": sampled(from_network(loaded))}, title="compiling")
    grid = [(g, 1.0, n) for g in GRADIENT_STEPS for n in STEPS if n < LONG or g in (0, usual)]
    collision, free = try_all(loaded, cases, grid, "Collision guidance"), {}
    if model.settings.null_condition:
        scaled = [(g, scale, n) for g in (0, usual) for scale in SCALES for n in SCALED_STEPS]
        free = try_all(loaded, cases[: max(len(cases) // 2, 1)], scaled, "Classifier-free guidance")
    else:
        print("Classifier-free guidance: left out, these weights were trained without dropping the condition")
    print("single: of 16 samples; best: problems with one that passes. 95 % intervals over the problems;")
    print("CPU time of a batch, encoder included, without the validator")
    draw(collision, free, arguments.family, arguments.plot)


if __name__ == "__main__":
    main()
