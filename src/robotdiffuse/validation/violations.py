"""All violations of a motion, where the validator reports the first one."""

import numpy as np

from robotdiffuse.collision.contacts import contacts
from robotdiffuse.core.types import Path, Trajectory
from robotdiffuse.problems.problem import Problem
from robotdiffuse.trajectories.cubics import Cubics
from robotdiffuse.validation.rates import sample_cubics
from robotdiffuse.validation.report import Report, Violation
from robotdiffuse.validation.validator import DEFAULT, VerifySettings, collision_violation, verifier

RATE_KINDS = ("rest", "rates", "velocity", "acceleration", "jump")
CONTACT_KINDS = ("scene_collision", "self_collision")


def violations(
    problem: Problem, motion: Path | Trajectory, settings: VerifySettings = DEFAULT
) -> tuple[Violation, ...]:
    """All violations of a motion in order; empty if it is valid.

    They include every contact, at the place where it begins, joint limits once for each joint, and the first
    of every other kind.
    """
    validator = verifier(problem, settings)
    timed = isinstance(motion, Trajectory)
    report: Report = validator.trajectory(motion) if timed else validator.path(motion)
    if report.valid or (report.violation is not None and report.violation.kind in ("not_finite", "time")):
        return () if report.violation is None else (report.violation,)
    still = {*(shape.name for shape in problem.scene.shapes), *problem.robot.link_names}
    found = [
        w for w in report.found if w.kind != "limits" and not (w.kind in CONTACT_KINDS and w.other in still)
    ]
    q, clock = motion.positions, np.arange(len(motion.positions), dtype=float)
    if timed:
        rates = any(wrong.kind in RATE_KINDS for wrong in found)
        clock, q = (motion.times, q) if rates else sample_cubics(motion, settings.chord)
    for contact in contacts(problem.robot, problem.scene, q, settings.contact):
        found.append(collision_violation(contact, float(np.interp(contact.at, np.arange(len(q)), clock))))
    if timed:
        times, turns = Cubics(motion).turns()
        clock, q = np.concatenate([clock, times]), np.concatenate([q, turns])
    found += _limits(problem, q, clock, settings)
    return tuple(sorted(found, key=lambda wrong: wrong.time))


def _limits(problem: Problem, q: np.ndarray, clock: np.ndarray, settings: VerifySettings) -> list[Violation]:
    robot, found = problem.robot, []
    beyond = np.maximum(robot.lower - q, q - robot.upper)
    beyond[:, robot.continuous] = 0.0
    for j in np.flatnonzero((beyond > settings.limit_slack).any(axis=0)).tolist():
        over = np.flatnonzero(beyond[:, j] > settings.limit_slack)
        i, most = int(over[clock[over].argmin()]), float(beyond[:, j].max())
        name, low, high = robot.joint_names[j], robot.lower[j], robot.upper[j]
        message = f"{name} leaves its limits, {low:.6g} to {high:.6g}, by up to {most:.3g}"
        found.append(Violation("limits", float(clock[i]), message, name, None, most))
    return found
