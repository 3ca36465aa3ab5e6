"""The planners by name. A new planner is one file and one line in PLANNERS."""

from functools import cache
from importlib import import_module
from typing import TYPE_CHECKING, NamedTuple

from robotdiffuse.errors import InputError, unknown_name

if TYPE_CHECKING:
    from robotdiffuse.planners.base import Planner
    from robotdiffuse.problems.problem import Problem
    from robotdiffuse.types import PlanResult


class Entry(NamedTuple):
    location: str
    """module:class, imported when the planner is loaded."""
    description: str
    settings: str = ""
    """Of a learned planner, the class of its settings, which name the folder of its weights."""


_ROOM = "robotdiffuse.planners."
PLANNERS = {
    "robotdiffuse": Entry(
        _ROOM + "robotdiffuse:RobotDiffuse",
        "hybrid of the diffusion model under guidance, refinement and search (the default)",
        "RobotDiffuseSettings",
    ),
    "diffusion": Entry(
        _ROOM + "diffusion:Diffusion",
        "the paper's method alone: encoder, sampling, guidance; no search, nothing shortened",
        "DiffusionSettings",
    ),
    "rrt_connect": Entry(
        _ROOM + "rrt_connect.planner:RRTConnect",
        "two trees grown towards each other, then shortcuts",
    ),
    "shared_tree_rrt_star": Entry(
        _ROOM + "shared_tree.planner:SharedTreeRRTStar",
        "the paper's planner for data: one tree, all goals, near-optimal, 5 cm away from obstacles",
    ),
    "mpnet": Entry(
        _ROOM + "mpnet:MPNet",
        "MPNet: a network with dropout proposes waypoints from both ends",
        "MPNetPlannerSettings",
    ),
    "mpinets": Entry(
        _ROOM + "mpinets:MPiNets",
        "MPiNets: a policy on points of scene, arm and target is rolled out",
        "MPiNetsSettings",
    ),
    "mpd": Entry(
        _ROOM + "mpd:MPD",
        "MPD: an unconditional diffusion prior, guided by costs while it samples",
        "MPDSettings",
    ),
    "edmp": Entry(
        _ROOM + "edmp:EDMP",
        "EDMP: such a prior, guided by an ensemble of costs",
        "EDMPSettings",
    ),
    "a_star": Entry(_ROOM + "lattice.planner:AStar", "A* on a lattice of joint values"),
    "d_star_lite": Entry(
        _ROOM + "lattice.planner:DStarLite",
        "D* Lite on a lattice of joint values; mends its search when the scene changes",
    ),
    "ompl_rrt": Entry(_ROOM + "ompl_planners:OmplRRT", "OMPL's RRT, then its path simplifier"),
    "ompl_rrt_connect": Entry(
        _ROOM + "ompl_planners:OmplRRTConnect", "OMPL's RRT-Connect, then its path simplifier"
    ),
    "ompl_prm": Entry(_ROOM + "ompl_planners:OmplPRM", "OMPL's PRM, then its path simplifier"),
    "ompl_rrt_star": Entry(_ROOM + "ompl_planners:OmplRRTStar", "OMPL's RRT*, to the end of the time"),
    "ompl_informed_rrt_star": Entry(
        _ROOM + "ompl_planners:OmplInformedRRTStar", "OMPL's Informed RRT*, to the end of the time"
    ),
    "ompl_bit_star": Entry(_ROOM + "ompl_planners:OmplBITStar", "OMPL's BIT*, to the end of the time"),
    "ompl_aorrtc": Entry(_ROOM + "ompl_planners:OmplAORRTC", "OMPL's AORRTC, to the end of the time"),
}
DEFAULT_PLANNER = "robotdiffuse"


def check_planner(name: str) -> None:
    """Raises InputError, listing the known planners, for an unknown name."""
    if name not in PLANNERS:
        raise unknown_name("planner", name, PLANNERS)


def load_planner(name: str, settings: object | None = None, weights: str | None = None) -> "Planner":
    """A planner by name, with the given settings (its own dataclass) or its default ones.

    weights: folder of a learned planner's own weights, in place of those that come with the package; not
    beside settings, which name them too.

    Raises InputError for an unknown name, settings of another planner, weights that cannot be read or for a
    planner that has none.
    """
    check_planner(name)
    entry = PLANNERS[name]
    location, _, planner = entry.location.partition(":")
    module = import_module(location)
    if weights is not None:
        if settings is not None:
            raise InputError(f"planner {name} got settings and weights; name the weights in the settings")
        if not entry.settings:
            learned = ", ".join(other for other, its in PLANNERS.items() if its.settings)
            raise InputError(f"planner {name} has no weights; those that have: {learned}")
        settings = getattr(module, entry.settings)(weights=weights)
    cls = getattr(module, planner)
    return cls() if settings is None else cls(settings)


@cache
def _default() -> "Planner":
    return load_planner(DEFAULT_PLANNER)


def plan(problem: "Problem", time_limit: float = 1.0, seed: int = 0) -> "PlanResult":
    """Plan with the default planner, which is loaded once.

    `time_limit` is wall time [s]. The result holds a verified motion or a status that says why there is none.
    """
    return _default().plan(problem, time_limit=time_limit, seed=seed)
