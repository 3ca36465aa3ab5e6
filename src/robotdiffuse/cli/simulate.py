"""The command `robotdiffuse simulate`."""

import argparse
from dataclasses import replace
from typing import TYPE_CHECKING

from robotdiffuse.cli.arguments import command, option
from robotdiffuse.cli.drawing import ENDINGS, draw
from robotdiffuse.cli.exit_status import NO_PLAN, SOLVED
from robotdiffuse.cli.view import read_solved
from robotdiffuse.core.errors import InputError

if TYPE_CHECKING:
    from robotdiffuse.simulation.replay import Replay


def add(commands: argparse._SubParsersAction) -> None:
    parser = command(
        commands,
        "simulate",
        "replay a result in the PyBullet simulator",
        "Replay the motion of a result file in PyBullet with position control, and print "
        "tracking errors and contacts. Exit status: 0 no contacts, 1 contacts, 2 bad input.",
        run,
    )
    option(parser, "result RESULT", "result file (.json) of `robotdiffuse plan --out`")
    option(parser, "--out FILE *", "replay (.html) or picture (.png) of the simulated motion; repeatable")


def run(arguments: argparse.Namespace) -> int:
    import numpy as np

    from robotdiffuse.core.output_files import check_output
    from robotdiffuse.core.types import Trajectory

    try:
        from robotdiffuse.simulation import replay
    except ModuleNotFoundError as error:
        if error.name != "pybullet":
            raise
        raise InputError(
            "simulate needs PyBullet, which has no wheels above Python 3.11: pip install 'robotdiffuse[sim]'"
        ) from None
    outputs = [check_output(file, ENDINGS) for file in arguments.out]
    result, problem = read_solved(arguments.result)
    if result.trajectory is None:
        raise InputError(f"{arguments.result} holds a path without times; a replay needs a trajectory")
    robot, scene = problem.standing()
    done = replay(robot, scene, result.trajectory, moving=problem.moving_in_world)
    for name in (one.name for one in problem.moving if not one.known):
        print(f"note: the motion of {name} is not known; it stands still here")
    print_replay(problem.robot.name, result.trajectory.duration, done)
    rates = np.gradient(done.positions, done.times, axis=0)
    motion = Trajectory(done.joint_names, done.times, done.positions, rates, 0 * rates)
    for file in outputs:
        draw(problem, replace(result, trajectory=motion), file)
        print(f"wrote {file}")
    return SOLVED if done.free else NO_PLAN


def print_replay(robot: str, duration: float, done: "Replay") -> None:
    """Print tracking errors and contacts."""
    from robotdiffuse.core.tables import Column, Table, show

    title = f"{robot}: {'free' if done.free else 'contact'}, {duration:.2f} s"
    rms = float((done.tip_errors**2).mean() ** 0.5)
    show(
        Table.of(
            title,
            ("", "maximum", "RMS"),
            [
                *(
                    (f"error of {name}", f"{1e3 * most:.3f} mrad", f"{1e3 * rms:.3f} mrad")
                    for name, most, rms in zip(
                        done.joint_names, done.max_errors, done.rms_errors, strict=True
                    )
                ),
                ("error of the tip", f"{1e3 * done.tip_errors.max():.3f} mm", f"{1e3 * rms:.3f} mm"),
            ],
        )
    )
    if not done.free:
        columns = ("link", Column("touches", left=True), "at", "depth")
        show(
            Table.of(
                "",
                columns,
                [
                    (
                        contact.link,
                        contact.other,
                        f"{contact.time:.2f} s",
                        f"{1e3 * contact.depth:.1f} mm" if contact.depth > 0 else "none: closer than 2 mm",
                    )
                    for contact in done.contacts
                ],
            )
        )
