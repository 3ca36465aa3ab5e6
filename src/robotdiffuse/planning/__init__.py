"""The planners by name. A new planner is one file and one entry in PLANNERS."""

import inspect
import re
from collections.abc import Iterable, Mapping
from functools import lru_cache
from typing import TYPE_CHECKING, Any

from robotdiffuse.core.errors import InputError, shown
from robotdiffuse.core.files import file_name
from robotdiffuse.core.registry import Entry, Registry
from robotdiffuse.core.settings import Settings
from robotdiffuse.core.types import CONVERGED, TIME

if TYPE_CHECKING:
    from robotdiffuse.core.types import PlanResult
    from robotdiffuse.planning.planner import Planner
    from robotdiffuse.problems.problem import Problem


# Kinds of planners: SEARCH planners use no network; LEARNED planners return motions that a network proposes.
SEARCH = "search"
LEARNED = "learned"
# Features that not every planner supports.
PATH_CONSTRAINTS = "path constraints"
CLEARANCE = "a requested clearance"


def _entry(location: str, settings: str, kind: str, description: str, *supports: str) -> Entry:
    return Entry(f"robotdiffuse.{location}", description, settings, kind, frozenset(supports))


def _ompl(algorithm: str, description: str) -> Entry:
    return _entry(f"baselines.ompl:Ompl{algorithm}", "OmplSettings", SEARCH, f"OMPL's {description}")


PLANNERS = Registry(
    "planner",
    {
        "robotdiffuse": _entry(
            "planning.search.rrt:RobotDiffuse",
            "AORRTCSettings",
            SEARCH,
            "the default: AORRTC, same as aorrtc",
            PATH_CONSTRAINTS,
            CLEARANCE,
        ),
        "diffusion": _entry(
            "planning.diffusion:Diffusion",
            "DiffusionSettings",
            LEARNED,
            "the diffusion model alone: sampling under guidance; no search, no simplification",
            PATH_CONSTRAINTS,
        ),
        "aorrtc": _entry(
            "planning.search.rrt:AORRTC",
            "AORRTCSettings",
            SEARCH,
            "AORRTC: anytime, asymptotically optimal RRT-Connect",
            PATH_CONSTRAINTS,
            CLEARANCE,
        ),
        "rrt_connect": _entry(
            "planning.search.rrt:RRTConnect",
            "RRTConnectSettings",
            SEARCH,
            "two trees grown towards each other, then simplification; restarts while time is left",
            PATH_CONSTRAINTS,
            CLEARANCE,
        ),
        "shared_tree_rrt_star": _entry(
            "planning.search.shared_tree:SharedTreeRRTStar",
            "SharedTreeSettings",
            SEARCH,
            "the paper's planner for training data: one tree, all goals, near-optimal, 5 cm of clearance",
        ),
        "mpnet": _entry(
            "baselines.mpnet:MPNet",
            "MPNetPlannerSettings",
            LEARNED,
            "MPNet: a network with dropout proposes waypoints from the start and from the goal",
        ),
        "mpinets": _entry(
            "baselines.mpinets:MPiNets",
            "MPiNetsSettings",
            LEARNED,
            "MPiNets: rolls out a policy that sees points of the scene, the arm and the target",
        ),
        "mpd": _entry(
            "baselines.guided_prior:MPD",
            "MPDSettings",
            LEARNED,
            "MPD: an unconditional diffusion prior, guided by costs while it samples",
        ),
        "edmp": _entry(
            "baselines.guided_prior:EDMP",
            "EDMPSettings",
            LEARNED,
            "EDMP: the diffusion prior of MPD, guided by an ensemble of costs",
        ),
        "straight_line": _entry(
            "baselines.controls:StraightLine",
            "StraightLineSettings",
            SEARCH,
            "no planner: the straight line in joint space, as a baseline for all others",
        ),
        "control": _entry(
            "baselines.controls:Control",
            "ControlSettings",
            SEARCH,
            "no planner: baselines by fixed waypoints, nearest motions of a data set or smooth noise",
        ),
        "a_star": _entry(
            "baselines.lattice:AStar", "AStarSettings", SEARCH, "A* on a lattice of joint values"
        ),
        "d_star_lite": _entry(
            "baselines.lattice:DStarLite",
            "DStarLiteSettings",
            SEARCH,
            "D* Lite on a lattice of joint values; repairs its search when the scene changes",
        ),
        "ompl_rrt": _ompl("RRT", "RRT, then its path simplifier"),
        "ompl_rrt_connect": _ompl("RRTConnect", "RRT-Connect, then its path simplifier"),
        "ompl_prm": _ompl("PRM", "PRM, then its path simplifier"),
        "ompl_rrt_star": _ompl("RRTStar", "RRT*, until the time limit"),
        "ompl_informed_rrt_star": _ompl("InformedRRTStar", "Informed RRT*, until the time limit"),
        "ompl_bit_star": _ompl("BITStar", "BIT*, until the time limit"),
        "ompl_aorrtc": _ompl("AORRTC", "AORRTC, until the time limit"),
    },
    group="robotdiffuse.planners",
)
DEFAULT_PLANNER = "robotdiffuse"
MAX_LOADED = 8
"""Largest number of planners with different settings that `plan` keeps loaded."""


def load_planner(name: str, settings: object | None = None, weights: str | None = None) -> "Planner[Any]":
    """Load a planner.

    Args:
        name: A name that `robotdiffuse planner list` shows.
        settings: The settings that differ from the defaults, such as {"range": 0.5}, or the planner's own
            dataclass.
        weights: Folder with weights for a learned planner, in place of the bundled weights; the same as its
            setting `weights`.

    Returns:
        The planner; its `plan` takes the arguments of `rd.plan`.

    Raises:
        InputError: For an unknown name, settings that are unknown, out of bounds or those of another planner,
            weights that cannot be read, weights for a planner without a network, and weights that are given
            twice.

    Examples:
        >>> planner = rd.load_planner("rrt_connect", {"range": 0.5})
        >>> problem = rd.Problem(rd.load_robot("panda"), rd.Scene(), "ready", "extended")
        >>> planner.plan(problem, until="first").solved
        True
    """
    if isinstance(settings, Mapping):
        settings = _default_settings(name).replaced(settings)
    if weights is not None:
        if PLANNERS.entry(name).kind == SEARCH:
            learned = ", ".join(candidate for candidate, entry in PLANNERS.items() if entry.kind != SEARCH)
            raise InputError(f"planner {name} has no weights; planners with weights: {learned}")
        chosen = _default_settings(name) if settings is None else PLANNERS.make(name, settings).settings
        given = getattr(chosen, "weights", None)
        if given is not None:
            raise InputError(f"planner {name} got weights twice: {weights}, and in the settings {given}")
        settings = chosen.replaced({"weights": str(file_name(weights, "weights"))})
    return PLANNERS.make(name, settings)


def planner_settings(name: str, assignments: Iterable[str]) -> Settings:
    """The default settings of a planner with some replaced: "range=0.5", "guidance.margin=0.02".

    Raises InputError for an unknown planner or one without settings, for text that is not NAME=VALUE, for an
    unknown setting, and for a value of the wrong type or out of bounds.
    """
    return _default_settings(name).changed(assignments)


def _default_settings(name: str) -> Settings:
    defaults = PLANNERS.defaults(name)
    if defaults is None:
        raise InputError(f"planner {name} has no settings")
    return defaults


def planners_that_support(what: str) -> list[str]:
    """The names of the planners that support PATH_CONSTRAINTS or CLEARANCE."""
    return [name for name, entry in PLANNERS.items() if what in entry.supports]


# a planner stays loaded for later calls with the same settings
_loaded = lru_cache(MAX_LOADED)(load_planner)


def plan(
    problem: "Problem",
    time_limit: float = 1.0,
    seed: int = 0,
    until: str = CONVERGED,
    clearance: float | None = None,
    velocity_scaling: float = 1.0,
    acceleration_scaling: float = 1.0,
    jerk: float | None = None,
    objective: str = TIME,
    *,
    planner: str = DEFAULT_PLANNER,
    settings: "Settings | Mapping[str, object] | None" = None,
) -> "PlanResult":
    """Plan a motion.

    Args:
        problem: The problem; `rd.load_problem` reads one from a file.
        time_limit: Wall time of the call [s]. Loading code, weights and a robot's arrays, which happens once,
            does not count.
        seed: Seed of all random numbers, at least 0. The same seed gives the same path, unless time runs out.
        until: "first": return the first verified motion. "converged": improve the motion until more time
            hardly improves it. "time_limit": improve it until time runs out. Planners other than aorrtc,
            rrt_connect and robotdiffuse ignore it, with one exception: for a problem with views whose unknown
            space is `predicted`, "first" makes them plan fewer motions.
        clearance: Distance to obstacles that aorrtc, rrt_connect and robotdiffuse keep wherever start, goal
            and passages allow it, at most 0.5 [m]. Elsewhere the distance is smaller, and a note says so.
            None: the problem's clearance, or 1 cm if it has none. Other planners refuse a clearance.
        velocity_scaling: Fraction of the velocity limits that the motion uses, from 0.001 to 1.
        acceleration_scaling: Fraction of the acceleration limits that the motion uses, from 0.001 to 1.
        jerk: Largest jerk of any joint [rad/s³], at least 0.01. None: each joint's own jerk limit; for a
            joint without one, 10 times its acceleration limit, per second. Infinite (on the command line:
            `none`): no limit.
        objective: What aorrtc, rrt_connect and robotdiffuse minimize: "time", the motion's duration, or
            "length" of the path in joint space.
        planner: A name that `robotdiffuse planner list` shows. A planner stays loaded for later calls with
            the same settings.
        settings: Settings of the planner that differ from the defaults, such as {"range": 0.5}, or its
            dataclass.

    Returns:
        A result with a verified motion, or with a status and a reason why there is none.

    Raises:
        InputError: For arguments of the wrong type or out of bounds, unknown planners and settings, and
            problems that the planner does not support.

    Examples:
        >>> ball = rd.Sphere([0.5, 0.0, 0.7], 0.2)
        >>> start, goal = [-1, 0.3, 0, -1.8, 0, 2.1, 0.8], [1, 0.3, 0, -1.8, 0, 2.1, 0.8]
        >>> problem = rd.Problem(rd.load_robot("panda"), rd.Scene([ball]), start, goal)
        >>> rd.plan(problem, time_limit=10.0, until="first").status.value
        'solved'
    """
    if settings is not None and not isinstance(settings, Settings | Mapping):
        raise InputError(
            f"settings is {shown(settings)}; it must be a table of settings, such as {{'range': 0.5}}"
        )
    PLANNERS.entry(planner)  # an unknown planner is reported before unknown settings
    if isinstance(settings, Mapping):
        settings = _default_settings(planner).replaced(settings)
    return _loaded(planner, settings).plan(
        problem, time_limit, seed, until, clearance, velocity_scaling, acceleration_scaling, jerk, objective
    )


def described_arguments() -> dict[str, str]:
    """The arguments of `plan`, as its docstring describes them, for the command line and the server."""
    _, _, arguments = (inspect.getdoc(plan) or "").partition("Args:\n")
    texts = re.findall(r"^    (\w+): (.*(?:\n {8}.*)*)", arguments, re.MULTILINE)
    return {name: " ".join(text.split()) for name, text in texts}
