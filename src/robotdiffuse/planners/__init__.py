"""The planners by name. A new planner is one file and one line in PLANNERS."""

from functools import cache
from importlib import import_module
from typing import TYPE_CHECKING, NamedTuple

from robotdiffuse.errors import unknown_name

if TYPE_CHECKING:
    from robotdiffuse.planners.base import Planner
    from robotdiffuse.problem import Problem
    from robotdiffuse.types import PlanResult


class Entry(NamedTuple):
    location: str
    """module:class, imported when the planner is loaded."""
    description: str


PLANNERS = {
    "robotdiffuse": Entry(
        "robotdiffuse.planners.robotdiffuse:RobotDiffuse",
        "diffusion model, collision guidance and refinement; search where they fail (the default)",
    ),
    "rrt_connect": Entry(
        "robotdiffuse.planners.rrt_connect:RRTConnect",
        "two trees grown towards each other, then shortcuts",
    ),
    "shared_tree_rrt_star": Entry(
        "robotdiffuse.planners.shared_tree:SharedTreeRRTStar",
        "the paper's planner for data: one tree, all goals, near-optimal, 5 cm away from obstacles",
    ),
}
DEFAULT_PLANNER = "robotdiffuse"


def check_planner(name: str) -> None:
    """Raises InputError, listing the known planners, for an unknown name."""
    if name not in PLANNERS:
        raise unknown_name("planner", name, PLANNERS)


def load_planner(name: str, settings: object | None = None) -> "Planner":
    """A planner by name, with the given settings (its own dataclass) or its default ones.

    Raises InputError for an unknown name, settings of another planner or weights that cannot be read.
    """
    check_planner(name)
    module, _, planner = PLANNERS[name].location.partition(":")
    cls = getattr(import_module(module), planner)
    return cls() if settings is None else cls(settings)


@cache
def _default() -> "Planner":
    return load_planner(DEFAULT_PLANNER)


def plan(problem: "Problem", time_limit: float = 1.0, seed: int = 0) -> "PlanResult":
    """Plan with the default planner, which is loaded once.

    `time_limit` is wall time [s]. The result holds a verified motion or a status that says why there is none.
    """
    return _default().plan(problem, time_limit=time_limit, seed=seed)
