"""The trained networks by name. A new one is one file and one line in NETWORKS."""

from robotdiffuse.core.registry import Entry, Registry

_PACKAGE = "robotdiffuse.learning.networks."
NETWORKS = Registry(
    "network",
    {
        "model": Entry(
            "robotdiffuse.learning.motion_network:MotionNetwork",
            "the diffusion model of motions",
            "robotdiffuse.learning.motion_model:MotionModelSettings",
            "planner --robot NAME",
        ),
        "mpnet": Entry(
            _PACKAGE + "mpnet:MPNetNetwork",
            "MPNet: the next configuration on the way to the goal",
            "MPNetSettings",
        ),
        "mpinets": Entry(
            _PACKAGE + "mpinets:MPiNetsNetwork",
            "MPiNets: a policy with points of scene, arm and target as its input",
            "MPiNetsNetworkSettings",
        ),
        "trajectory_prior": Entry(
            "robotdiffuse.learning.motion_network:MotionNetwork",
            "the same model without an encoder, for MPD and EDMP",
            "robotdiffuse.learning.motion_model:MotionModelSettings",
            "planner --config trajectory_prior --data FOLDER --out FOLDER",
        ),
    },
)
"""An entry's kind is the command after `robotdiffuse train` that trains it; empty: `baseline NAME`."""
