"""Report, the result of a validation, and the violations in it."""

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Violation:
    """A requirement that a motion violates."""

    kind: str
    """not_finite, start, limits, scene_collision, self_collision, constraint, torque, twitch, jump,
    waypoint or goal; for trajectories also time, rest, velocity, acceleration, rates and speed."""
    time: float
    """Place of the violation. For a trajectory, the time [s]; for a path, the index of a waypoint plus the
    traveled fraction of the segment after it."""
    message: str
    """What is violated, in one line."""
    subject: str | None = None
    """The link that collides, is constrained or misses its goal pose; the joint that exceeds a limit, jumps
    or is off the start; or the missed waypoint."""
    other: str | None = None
    """The obstacle, the other link or the kind of constraint."""
    excess: float | None = None
    """Amount of the violation, in its own unit: for a contact, its greatest depth [m]; for a constraint, the
    greatest excess over its limit until the motion meets it again; for a step by nearly a whole turn, the
    size of the step; for other kinds, the excess over a limit, or the error at start or goal."""

    @property
    def line(self) -> str:
        """The message, with the place of the violation added if the message does not name it."""
        named = f" at {self.time:.3f} s" in self.message or " at waypoint " in self.message
        return self.message if named else f"{self.message} (at {self.time:.3f})"


@dataclass(frozen=True)
class Report:
    """The result of a validation."""

    valid: bool
    violation: Violation | Any  # Any stands for None, so that its fields can be read without a check
    """The first violation; None if and only if the motion is valid."""
    scene_clearance: float | None
    """Certified lower bound on the distance of all moving links to all obstacles over the whole motion [m],
    at most 1 m. None for an invalid motion."""
    self_clearance: float | None
    """Lower bound on the distance between links that are checked against each other [m]; None for an invalid
    motion."""
    jerk_share: float | None = None
    """The largest jerk of a valid trajectory, divided by the joint's limit (`jerk_limits`); infinite if the
    acceleration is not 0 at the start or the end. Jerk limits are no requirement: a motion with a share above
    1 is valid, but some controllers refuse it."""
    found: tuple[Violation, ...] = ()
    """All violations that were found: the first of each kind, but up to two of the kinds jump, limits and
    scene_collision. The function `violations` finds every contact."""

    @property
    def min_clearance(self) -> float | None:
        """The smaller of `scene_clearance` and `self_clearance` [m]; None for an invalid motion."""
        if self.scene_clearance is None or self.self_clearance is None:
            return None
        return min(self.scene_clearance, self.self_clearance)
