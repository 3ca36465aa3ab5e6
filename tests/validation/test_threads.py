"""Threads that validate motions of one problem at the same time share its verifier."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np

import robotdiffuse as rd
from robotdiffuse.validation.validator import Report


def test_eight_threads_validate_motions_of_one_problem() -> None:
    """The classes of the proof said that they were not safe for threads, and were shared by threads."""
    robot = rd.load_robot("panda")
    shapes = [
        rd.Box((0.5, 0.1, 0.4), (0.2, 0.2, 0.2)),
        rd.Cylinder((0.3, -0.5, 0.5), 0.1, 0.6),
        rd.Sphere((-0.3, 0.4, 0.6), 0.15),
    ]
    start = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.8])
    problem = rd.Problem(robot=robot, scene=rd.Scene(shapes), start=start, goal=start)
    rng = np.random.default_rng(0)
    ends = start + rng.uniform(-0.1, 0.1, (64, 1, robot.dof)) * (robot.upper - robot.lower)
    motions = [rd.Path(robot.joint_names, np.stack([start, end, start])) for end in ends[:, 0]]

    def validated(motion: rd.Path) -> Report:
        return rd.verify(problem, motion)

    alone = [validated(motion) for motion in motions]
    with ThreadPoolExecutor(8) as threads:
        together = list(threads.map(validated, motions))
    assert [str(report) for report in together] == [str(report) for report in alone]
    assert {report.valid for report in alone} == {True, False}
