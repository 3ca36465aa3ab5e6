"""The validity badge of the page: whether the current motion is valid in the current scene."""

from dataclasses import dataclass

from robotdiffuse.collision.kernels.distance import CLEARANCE_CAP
from robotdiffuse.validation.report import Report
from robotdiffuse.visualization.live.session import State

VALID, INVALID, NO_MOTION, PENDING = "valid", "invalid", "none", "pending"
"""Kinds of badges: green, red, no motion, not validated yet."""
COLLISIONS = ("scene_collision", "self_collision")


@dataclass(frozen=True)
class Validity:
    """Kind and text of the badge."""

    kind: str
    headline: str
    lines: tuple[str, ...] = ()


def validity(state: State) -> Validity:
    """The badge of a state: clearances, or link, obstacle, depth and time of a violation, or why there is no
    motion."""
    why_not = _why_not(state)
    more = (f"no new plan: {why_not}",) if why_not else ()
    validation = state.validation
    if state.motion is None:
        if why_not:
            return Validity(NO_MOTION, "no plan", (why_not,))
        if state.planning:
            return Validity(PENDING, "planning", ("a new machine compiles first, for about a minute",))
        return Validity(PENDING, "not planned yet")
    if validation is None:
        return Validity(PENDING, "validating")
    report, trajectory = validation.report, state.motion.trajectory
    assert trajectory is not None
    violation = report.violation
    if violation is None:
        lines = (
            f"{_to_obstacles(state, report)}, between links {_distance(report.self_clearance)}, "
            f"over {trajectory.duration:.2f} s",
            *more,
        )
        return Validity(VALID, f"free, clearance at least {_distance(report.min_clearance)}", lines)
    what = "collides" if violation.kind in COLLISIONS else "not valid"
    when = f"at {violation.time:.2f} s of {trajectory.duration:.2f} s"
    return Validity(INVALID, f"{what}: {violation.message}", (when, *more))


def _to_obstacles(state: State, report: Report) -> str:
    problem = state.problem
    if not (problem.scene.shapes or problem.moving):
        return "no obstacles"
    return f"to obstacles {_distance(report.scene_clearance)}"


def _why_not(state: State) -> str:
    """Why the last planning call found no motion; "" if it did."""
    if state.failure:
        return state.failure
    if state.answer is None or state.answer.solved:
        return ""
    return f"{state.answer.status.value}: {state.answer.reason}"


def _distance(metres: float | None) -> str:
    metres = metres or 0.0
    if metres > CLEARANCE_CAP - 1e-4:
        return f"more than {CLEARANCE_CAP:g} m"
    return f"{100 * metres:.1f} cm" if metres >= 0.01 else f"{1000 * metres:.1f} mm"
