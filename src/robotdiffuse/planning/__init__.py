"""The planners by name. A new planner is one file and one line in PLANNERS."""

from collections.abc import Iterable
from functools import cache
from typing import TYPE_CHECKING

from robotdiffuse.core.errors import InputError
from robotdiffuse.core.input_files import file_name
from robotdiffuse.core.registry import Entry, Registry
from robotdiffuse.core.settings import Settings
from robotdiffuse.core.types import CONVERGED

if TYPE_CHECKING:
    from robotdiffuse.core.results import PlanResult
    from robotdiffuse.planning.planner import Planner
    from robotdiffuse.problems.problem import Problem


SEARCH, LEARNED, HYBRID = "search", "learned", "hybrid"
"""Kinds of planners: without a network; only a network's motions, with or without guidance; both."""
PATH_CONSTRAINTS, CLEARANCE = "path constraints", "a requested clearance"
"""What not every planner supports."""


def _entry(location: str, settings: str, kind: str, description: str, *supports: str) -> Entry:
    return Entry(f"robotdiffuse.planning.{location}", description, settings, kind, frozenset(supports))


def _ompl(algorithm: str, description: str) -> Entry:
    return _entry(f"baselines.ompl:Ompl{algorithm}", "OmplSettings", SEARCH, f"OMPL's {description}")


PLANNERS = Registry(
    "planner",
    {
        "robotdiffuse": _entry(
            "diffusion.hybrid:RobotDiffuse",
            "RobotDiffuseSettings",
            HYBRID,
            "the diffusion model with guidance and refinement, and a search around them (the default)",
            PATH_CONSTRAINTS,
            CLEARANCE,
        ),
        "diffusion": _entry(
            "diffusion.diffusion:Diffusion",
            "DiffusionSettings",
            LEARNED,
            "the paper's method alone: encoder, sampling, guidance; no search, no simplification",
            PATH_CONSTRAINTS,
        ),
        "aorrtc": _entry(
            "search.aorrtc:AORRTC",
            "AORRTCSettings",
            SEARCH,
            "two trees below a falling bound on path length: the shortest paths for the time",
            PATH_CONSTRAINTS,
            CLEARANCE,
        ),
        "rrt_connect": _entry(
            "search.rrt_connect:RRTConnect",
            "RRTConnectSettings",
            SEARCH,
            "two trees grown towards each other, then simplification; restarts while time is left",
            PATH_CONSTRAINTS,
            CLEARANCE,
        ),
        "shared_tree_rrt_star": _entry(
            "search.shared_tree.planner:SharedTreeRRTStar",
            "SharedTreeSettings",
            SEARCH,
            "the paper's planner for data: one tree, all goals, near-optimal, 5 cm away from obstacles",
        ),
        "mpnet": _entry(
            "baselines.mpnet:MPNet",
            "MPNetPlannerSettings",
            LEARNED,
            "MPNet: a network with dropout proposes waypoints from both ends",
        ),
        "mpinets": _entry(
            "baselines.mpinets:MPiNets",
            "MPiNetsSettings",
            LEARNED,
            "MPiNets: a policy on points of scene, arm and target is rolled out",
        ),
        "mpd": _entry(
            "baselines.mpd:MPD",
            "MPDSettings",
            LEARNED,
            "MPD: an unconditional diffusion prior, guided by costs while it samples",
        ),
        "edmp": _entry(
            "baselines.edmp:EDMP",
            "EDMPSettings",
            LEARNED,
            "EDMP: such a prior, guided by an ensemble of costs",
        ),
        "a_star": _entry(
            "baselines.lattice.planner:AStar", "AStarSettings", SEARCH, "A* on a lattice of joint values"
        ),
        "d_star_lite": _entry(
            "baselines.lattice.planner:DStarLite",
            "DStarLiteSettings",
            SEARCH,
            "D* Lite on a lattice of joint values; repairs its search when the scene changes",
        ),
        "ompl_rrt": _ompl("RRT", "RRT, then its path simplifier"),
        "ompl_rrt_connect": _ompl("RRTConnect", "RRT-Connect, then its path simplifier"),
        "ompl_prm": _ompl("PRM", "PRM, then its path simplifier"),
        "ompl_rrt_star": _ompl("RRTStar", "RRT*, to the end of the time"),
        "ompl_informed_rrt_star": _ompl("InformedRRTStar", "Informed RRT*, to the end of the time"),
        "ompl_bit_star": _ompl("BITStar", "BIT*, to the end of the time"),
        "ompl_aorrtc": _ompl("AORRTC", "AORRTC, to the end of the time"),
    },
)
DEFAULT_PLANNER = "robotdiffuse"


def load_planner(name: str, settings: object | None = None, weights: str | None = None) -> "Planner":
    """The planner of a name, with the given settings (of its own dataclass) or its default ones.

    weights: folder with weights for a learned planner, in place of those that come with the package. With
    settings, name the folder there instead.

    Raises InputError for an unknown name, for settings of another planner, for both settings and weights, for
    weights that cannot be read, and for weights for a planner that takes none.
    """
    if weights is not None:
        if settings is not None:
            raise InputError(f"planner {name} got settings and weights; name the weights in the settings")
        if PLANNERS.entry(name).kind == SEARCH:
            learned = ", ".join(other for other, its in PLANNERS.items() if its.kind != SEARCH)
            raise InputError(f"planner {name} has no weights; those that have: {learned}")
        settings = PLANNERS.settings(name)(weights=str(file_name(weights, "weights")))  # type: ignore[misc]
    return PLANNERS.make(name, settings)


def planner_settings(name: str, assignments: Iterable[str]) -> Settings:
    """The default settings of a planner with some replaced: "range=0.5", "guidance.margin=0.02".

    Raises InputError for an unknown planner, an unknown setting and a value out of bounds.
    """
    kind = PLANNERS.settings(name)
    if kind is None:
        raise InputError(f"planner {name} has no settings")
    return kind().changed(assignments)


def planners_that_support(what: str) -> list[str]:
    """The names of the planners that support PATH_CONSTRAINTS or CLEARANCE."""
    return [name for name, entry in PLANNERS.items() if what in entry.supports]


@cache
def _default() -> "Planner":
    return load_planner(DEFAULT_PLANNER)


def plan(
    problem: "Problem",
    time_limit: float = 1.0,
    seed: int = 0,
    until: str = CONVERGED,
    clearance: float | None = None,
    velocity_scaling: float = 1.0,
    acceleration_scaling: float = 1.0,
    jerk: float | None = None,
) -> "PlanResult":
    """Plan with the default planner, which is loaded once.

    The arguments, and what they mean, are those of `planning.planner.Planner.plan`. The result holds a
    verified motion, or a status and a reason why there is none.
    """
    limits = velocity_scaling, acceleration_scaling, jerk
    return _default().plan(problem, time_limit, seed, until, clearance, *limits)
