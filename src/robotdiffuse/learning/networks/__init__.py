"""The networks by name. A new one is one file and one line in NETWORKS."""

from robotdiffuse.core.registry import Entry, Registry

_ROOM = "robotdiffuse.learning.networks."
NETWORKS = Registry(
    "network",
    {
        "model": Entry(
            "robotdiffuse.learning.motion_model:MotionModel",
            "the diffusion model of motions",
            "MotionModelSettings",
            "planner --robot NAME",
        ),
        "mpnet": Entry(
            _ROOM + "mpnet:MPNetNetwork",
            "MPNet: the next configuration on the way to the goal",
            "MPNetSettings",
        ),
        "mpinets": Entry(
            _ROOM + "mpinets:MPiNetsNetwork",
            "MPiNets: a policy that sees points of scene, arm and target",
            "MPiNetsNetworkSettings",
        ),
        "trajectory_prior": Entry(
            "robotdiffuse.learning.motion_model:MotionModel",
            "the same model without an encoder, for MPD and EDMP",
            "MotionModelSettings",
            "planner --config trajectory_prior --data FOLDER --out FOLDER",
        ),
    },
)
"""Kind: what follows `robotdiffuse train` where a network is trained; empty for a baseline."""
