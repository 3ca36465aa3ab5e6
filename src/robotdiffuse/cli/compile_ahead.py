"""Compiles, in a second process, a part of the code that a first plan needs.

Numba compiles one function at a time. On a new machine, a second process about halves the wait: it compiles
what a plan needs last while the plan itself compiles what it needs first. Both share Numba's cache.

    python -m robotdiffuse.cli.compile_ahead [picture]
"""

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np

from robotdiffuse.core import loading
from robotdiffuse.core.types import Path
from robotdiffuse.robots import load_robot
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import Sphere

PICTURE = "picture"
"""Argument with which the code that draws pictures is compiled too."""
BALL = Sphere([0.0, 0.0, -5.0], 0.1)
"""An obstacle out of reach of all bundled arms."""


@contextmanager
def compiling_ahead(picture: bool) -> Iterator[None]:
    """While the block runs, the first compilation in this process starts the second process, unless the
    machine has only one core.

    picture: whether the second process also compiles the code that draws pictures.
    """

    def start() -> None:
        command = [sys.executable, "-m", __name__, *([PICTURE] if picture else [])]
        nothing = subprocess.DEVNULL
        subprocess.Popen(command, stdin=nothing, stdout=nothing, stderr=nothing)

    loading.on_first_compilation = None if (os.cpu_count() or 1) < 2 else start
    try:
        yield
    finally:
        loading.on_first_compilation = None


def steps(robot: Robot, picture: bool) -> Iterator[Callable[[], object]]:
    """Calls that compile the code of the last stages of a plan, the slowest first. The compiled code serves
    all robots."""
    rows = np.stack([robot.middle, robot.middle + 0.01, robot.middle])
    path = Path(robot.joint_names, rows)
    scene = Scene([BALL])
    from robotdiffuse.collision import CollisionChecker
    from robotdiffuse.collision.motions import ContinuousCollision
    from robotdiffuse.trajectories.timing import time_parameterize
    from robotdiffuse.validation.validator import VerifySettings

    settings = VerifySettings()
    sweep = ContinuousCollision(robot, scene, settings.contact, settings.tightness).sweep
    yield lambda: CollisionChecker(robot, scene).link_clearances(rows)
    yield lambda: sweep(rows)
    yield lambda: time_parameterize(robot, path, lambda _: True, lambda _: True)
    if picture:
        from robotdiffuse.visualization.picture import PictureSettings, render

        yield lambda: render(robot, scene, path, PictureSettings(width=16, height=16))


def main(arguments: list[str]) -> None:
    parent = os.getppid()
    for step in steps(load_robot("panda"), PICTURE in arguments):
        if os.getppid() != parent:  # the plan is done
            return
        step()


if __name__ == "__main__":
    main(sys.argv[1:])
