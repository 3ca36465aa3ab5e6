"""The live certificate in words: what the validator says of the motion shown, in the scene as it now is."""

from dataclasses import dataclass

from robotdiffuse.planning.planner import compiles_first
from robotdiffuse.validation.validator import Report
from robotdiffuse.visualization.live.session import State

FREE, WRONG, NONE, WAITING = "free", "wrong", "none", "waiting"
"""Kinds of certificates: green, red, no motion, not validated yet."""
COLLISIONS = ("scene_collision", "self_collision")


@dataclass(frozen=True)
class Certificate:
    kind: str
    headline: str
    lines: tuple[str, ...] = ()


def certificate(state: State) -> Certificate:
    """Green with clearances; red with link, obstacle, depth and time; or why there is no motion."""
    why_not = _why_not(state)
    more = (f"no new plan: {why_not}",) if why_not else ()
    verdict = state.verdict
    if state.motion is None:
        if why_not:
            return Certificate(NONE, "no plan", (why_not,))
        if state.planning:
            return Certificate(WAITING, "planning", (compiles_first(state.problem.robot),))
        return Certificate(WAITING, "nothing planned yet")
    if verdict is None:
        return Certificate(WAITING, "validating")
    report, trajectory = verdict.report, state.motion.trajectory
    assert trajectory is not None
    violation = report.violation
    if violation is None:
        lines = (
            f"{_to_obstacles(state, report)}, between links {_distance(report.self_clearance)}, "
            f"all along {trajectory.duration:.2f} s",
            *more,
        )
        return Certificate(FREE, f"free, clearance at least {_distance(report.min_clearance)}", lines)
    what = "collides" if violation.kind in COLLISIONS else "not valid"
    when = f"at {violation.time:.2f} s of {trajectory.duration:.2f} s"
    return Certificate(WRONG, f"{what}: {violation.message}", (when, *more))


def _to_obstacles(state: State, report: Report) -> str:
    problem = state.problem
    if not (problem.scene.shapes or problem.moving):
        return "no obstacles"
    return f"to obstacles {_distance(report.scene_clearance)}"


def _why_not(state: State) -> str:
    """Why the last call of the planner brought no motion; empty if it did."""
    if state.failure:
        return state.failure
    if state.answer is None or state.answer.solved:
        return ""
    return f"{state.answer.status.value}: {state.answer.reason}"


def _distance(metres: float | None) -> str:
    metres = metres or 0.0
    return f"{100 * metres:.1f} cm" if metres >= 0.01 else f"{1000 * metres:.1f} mm"
