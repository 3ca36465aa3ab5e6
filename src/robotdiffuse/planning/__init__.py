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
"""Kinds of planners: without a network; a network's motions alone, with guidance or without; both."""


def _entry(location: str, settings: str, kind: str, description: str) -> Entry:
    return Entry(f"robotdiffuse.planning.{location}", description, settings, kind)


def _ompl(algorithm: str, description: str) -> Entry:
    return _entry(f"baselines.ompl:Ompl{algorithm}", "OmplSettings", SEARCH, f"OMPL's {description}")


PLANNERS = Registry(
    "planner",
    {
        "robotdiffuse": _entry(
            "diffusion.hybrid:RobotDiffuse",
            "RobotDiffuseSettings",
            HYBRID,
            "the diffusion model under guidance, refinement, and search around them (the default)",
        ),
        "diffusion": _entry(
            "diffusion.diffusion:Diffusion",
            "DiffusionSettings",
            LEARNED,
            "the paper's method alone: encoder, sampling, guidance; no search, nothing shortened",
        ),
        "aorrtc": _entry(
            "search.aorrtc:AORRTC",
            "AORRTCSettings",
            SEARCH,
            "two trees below a bound that falls: the shortest paths for the time",
        ),
        "rrt_connect": _entry(
            "search.rrt_connect:RRTConnect",
            "RRTConnectSettings",
            SEARCH,
            "two trees grown towards each other, then simplification; restarts while time is left",
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
            "D* Lite on a lattice of joint values; mends its search when the scene changes",
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
    """A planner by name, with the given settings (its own dataclass) or its default ones.

    weights: folder of a learned planner's own weights, in place of those that come with the package; not
    beside settings, which name them too.

    Raises InputError for an unknown name, settings of another planner, weights that cannot be read or for a
    planner that has none.
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
    """The settings of a planner with some replaced: "range=0.5", "guidance.margin=0.02".

    Raises InputError for an unknown planner, a setting that it does not have and a value that it cannot be.
    """
    kind = PLANNERS.settings(name)
    if kind is None:
        raise InputError(f"planner {name} has no settings")
    return kind().changed(assignments)


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
    """Plan with the default planner, which is loaded once; the arguments are those of
    `planning.planner.Planner.plan`.

    The result holds a verified motion or a status that says why there is none.
    """
    limits = velocity_scaling, acceleration_scaling, jerk
    return _default().plan(problem, time_limit, seed, until, clearance, *limits)
