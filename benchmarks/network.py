"""The network alone, refinement and its control, the whole planner: on held-out problems of each family.

    python benchmarks/network.py [--families rop,shelf] [--problems 500] [--cases FOLDER] [--weights FOLDER]
        [--parts a,b,c,d]

Prints the report that is kept in benchmarks/results/network.txt; FOLDER as in problems.py. Problems are not
trivial (the straight line does not solve them) and ten seconds of search do solve them. Everything that is
called solved passed the validator; motions of the whole planner are confirmed by PyBullet on meshes.

What the network is told of the obstacles is the code z of their point cloud, and the clearances of the links
along the noisy motion. Each is taken away in rows of its own: in place of z the code of another scene of the
family, or its whole condition hidden, of z, start and goal (the ends it finds in the noisy motion too), and
clearances as if there were no obstacles. Guidance, where there is some, knows the obstacles in any case. Part
d is the whole planner, which ships without the code, beside itself with it, two seeds of half a second.
"""

import argparse
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path as File

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from report import WIDTH, header, print_table
from searches import bumps, network, search

from problems import PANDA, SEARCH_TIME, Case, Drawn, draw_cases, families_of
from robotdiffuse.collision import CollisionChecker
from robotdiffuse.core.types import Path
from robotdiffuse.evaluation.methods import (
    NETWORK_ALONE,
    Draw,
    fields_of,
    from_network,
    measure_of,
    planned,
    sampled,
    searched,
    without_network,
)
from robotdiffuse.evaluation.records import Record
from robotdiffuse.evaluation.runs import Clock, Fields, Method, Trial, tried
from robotdiffuse.evaluation.statistics import bootstrap_interval
from robotdiffuse.evaluation.summary import BEST, CPU, LENGTH, SINGLE, SOLVED, summary
from robotdiffuse.evaluation.tables import show
from robotdiffuse.learning.motion_model import MotionModel
from robotdiffuse.planning.diffusion.diffusion import encode
from robotdiffuse.planning.diffusion.hybrid import RobotDiffuse, RobotDiffuseSettings
from robotdiffuse.problems.families import FAMILIES
from robotdiffuse.problems.problem import Problem
from robotdiffuse.simulation.validator import PyBulletOracle

TIME_LIMIT = 5.0
"""Of the whole planner [s]."""
EQUAL_TIME = 0.5
"""In which the whole planner is compared with itself told more [s]."""


def alone(planner: RobotDiffuse, cases: list[Case]) -> dict[str, Draw]:
    """The network with guidance and without, and with less of what it is told."""

    def other(trial: Trial) -> Problem:
        return cases[(trial.place + 1) % len(cases)].problem

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
            found[f"{name}, condition hidden"] = from_network(of, guidance_scale=0.0)
    control = without_network(planner.settings, model.settings.waypoints)
    return found | {"control: guidance of line and bumps": control}


def confirmed(planner: RobotDiffuse) -> Method:
    """The whole planner, and whether PyBullet finds its path or motion in collision."""

    def call(trial: Trial) -> Iterator[Fields]:
        with Clock() as clock:
            result = planner.plan(trial.problem, trial.limit, seed=trial.place)
        hit = False
        if result.path is not None and result.trajectory is not None:
            moved = Path(result.trajectory.joint_names, result.trajectory.positions)
            with PyBulletOracle(PANDA, trial.problem.scene) as oracle:
                hit = any(oracle.check_path(path) is not None for path in (result.path, moved))
        yield fields_of(result, measure_of(PANDA)) | {"cpu": clock.cpu, "refuted": float(hit)}

    return call


class Told(RobotDiffuse):
    """With the code of the scene."""

    def code(
        self, model: MotionModel, checker: CollisionChecker, rng: np.random.Generator
    ) -> Float[ndarray, "code"]:
        return encode(model, checker, self.settings.points, rng)


def equal_time(every: dict[str, list[Case]], settings: RobotDiffuseSettings) -> None:
    planners = {"as it ships": RobotDiffuse(settings), "with the code": Told(settings)}
    for planner in planners.values():
        planner.warm_up(next(iter(every.values()))[0].problem, "converged")  # loads the network
    methods = {
        name: planned(planner, until="time_limit", clearance=0.0) for name, planner in planners.items()
    }
    rows, ratios = [], dict[str, ndarray]()
    own = {name: list[bool]() for name in planners}
    for family, cases in every.items():
        found = tried(cases, methods, seeds=(1, 2), limit=EQUAL_TIME, title=family)
        lengths = []
        for name, records in found.items():
            own[name] += [record.stage in ("network", "refinement") for record in records if record.solved]
            lengths.append(
                [record.measures["joint_length"] if record.solved else np.nan for record in records]
            )
        shipped, told = np.array(lengths).reshape(2, len(cases), -1)
        ratio = np.exp(np.log(told / shipped).mean(axis=1))
        ratios[family] = ratio[~np.isnan(ratio)]
    for family, of in [*ratios.items(), ("all", np.concatenate(list(ratios.values())))]:
        low, high = bootstrap_interval(of)
        rows.append((family, len(of), f"{of.mean():.5f} ({low:.5f} to {high:.5f})"))
    shares = ", ".join(f"{name} {np.mean(of):.1%}" for name, of in own.items())
    print_table(
        f"(d) whole planner with the code, lengths over those without, {EQUAL_TIME:g} s",
        ["family", "problems", "mean (95 %)"],
        rows,
        (f"answers that are the network's: {shares}",),
    )


def print_worth(found: dict[str, list[Record]]) -> None:
    """Of all families together, what each of the network's inputs is worth."""
    rows = []
    for name in ("guided", "without guidance"):
        own = np.array([record.passed or 0.0 for record in found[name]])
        for taken in ("code of another scene", "condition hidden", "clearances hidden"):
            less = own - [record.passed or 0.0 for record in found[f"{name}, {taken}"]]
            low, high = (100 * x for x in bootstrap_interval(less))
            rows.append((name, taken, f"{100 * less.mean():+.1f} ({low:+.1f} to {high:+.1f})"))
    print_table(f"(a) {len(own)} problems: single samples, points", ["as told", "less", "mean (95 %)"], rows)


def report(family: str, drawn: Drawn, weights: str | None, parts: str) -> dict[str, list[Record]]:
    """Prints it; the records of the network alone."""
    hard, count = drawn.hard, len(drawn.cases) + drawn.unsolved
    trivial = len(drawn.cases) - len(hard)
    print(
        f"\n== {family}: {count} problems drawn: {trivial} solved by the straight line "
        f"({trivial / count:.1%}), {len(hard)} not trivial, {drawn.unsolved} that {SEARCH_TIME:.0f} s of "
        "search do not solve (left out)\n",
        flush=True,
    )
    planner, single = RobotDiffuse(replace(NETWORK_ALONE, weights=weights)), dict[str, list[Record]]()
    if "a" in parts:
        methods = {name: sampled(draw) for name, draw in alone(planner, hard).items()}
        single = tried(hard, methods, seeds=(1,), title=family)
        found = dict(single)
        if trivial:
            name = "guided, trivial ones too"
            found |= tried(drawn.cases, {name: methods["guided"]}, seeds=(1,), title=name)
        show(summary("(a) network alone, 16 samples", found, (SINGLE, BEST, LENGTH, CPU)), width=WIDTH)
    if "b" in parts:
        starts = {
            "from the network's 16 samples": network,
            "control: line and 15 random bumps": bumps(16),
            "control: line and 63 random bumps": bumps(64),
        }
        methods = {name: searched(search(planner, of, line=False), (np.inf,)) for name, of in starts.items()}
        found = tried(hard, methods, seeds=(2,), title=family)
        show(summary("(b) refinement, shortcuts, validator", found, (SOLVED, LENGTH, CPU)), width=WIDTH)
    if "c" in parts:
        whole = confirmed(RobotDiffuse(RobotDiffuseSettings(weights=weights)))
        found = tried(hard, {"robotdiffuse": whole}, limit=TIME_LIMIT, title=family)
        show(summary("(c) whole planner", found, (SOLVED, LENGTH, CPU)), width=WIDTH)
        print_stages(found["robotdiffuse"])
    return single


def print_stages(records: list[Record]) -> None:
    stages = Counter(record.stage or "nothing" for record in records)
    print("solved by " + ", ".join(f"{name} {n / len(records):.1%}" for name, n in sorted(stages.items())))
    refuted = sum(record.measures["refuted"] for record in records)
    print(f"motions that PyBullet finds in collision: {refuted:.0f} of {sum(r.solved for r in records)}")


def main() -> None:
    parser = argparse.ArgumentParser(description="RobotDiffuse on held-out problems.")
    parser.add_argument("--families", type=families_of, default=list(FAMILIES), help="all of them")
    parser.add_argument("--problems", type=int, default=500, help="non-trivial ones of each family (500)")
    parser.add_argument("--cases", type=File, help="folder that keeps what is known of the problems")
    parser.add_argument("--weights", help="folder of a trained model; default: the bundled one")
    parser.add_argument("--parts", default="a,b,c,d", help="of the report (a,b,c,d)")
    arguments = parser.parse_args()
    print(header("numpy", "numba", "torch"))
    print(f"weights: {arguments.weights or 'the bundled ones'}")
    warm = draw_cases("rop", 1).hard[0].problem
    RobotDiffuse(RobotDiffuseSettings(weights=arguments.weights)).plan(warm)  # compiles
    every, alone_on = dict[str, list[Case]](), dict[str, list[Record]]()
    for family in arguments.families:
        drawn = draw_cases(family, arguments.problems, arguments.cases)
        every[family] = drawn.hard
        for name, records in report(family, drawn, arguments.weights, arguments.parts).items():
            alone_on.setdefault(name, []).extend(records)
    if len(arguments.families) > 1 and any("condition hidden" in name for name in alone_on):
        print_worth(alone_on)
    if "d" in arguments.parts:
        equal_time(every, RobotDiffuseSettings(weights=arguments.weights))
    print(
        "\n* joint-space length against a path of `aorrtc`, mean of "
        "ratios\nsingle: share of samples that pass the validator; best: problems with one that does. Shares "
        "with 95 %\nintervals; times are CPU time, as the machine may do other work."
    )


if __name__ == "__main__":
    main()
