"""Searches that solve the problems of data sets, by name."""

from robotdiffuse.core.registry import Entry, Registry

SEARCHES = Registry(
    "planner of data",
    {
        "shared_tree_rrt_star": Entry(
            "robotdiffuse.planning.search.shared_tree:SharedTreeSearch",
            "the paper's: one tree towards all goals of a target, with the cost of each",
            "SharedTreeSettings",
        ),
        "aorrtc": Entry(
            "robotdiffuse.generation.aorrtc_solver:AORRTCSearch",
            "shorter paths in less time at the same safety distance, with the cost of one goal",
            "AORRTCSearchSettings",
        ),
    },
)
