"""The cost functions of guidance by name. A new one is one file and one line in COSTS."""

from robotdiffuse.core.registry import Entry, Registry

_ROOM = "robotdiffuse.learning.costs."
COSTS = Registry(
    "guidance cost",
    {
        "collision": Entry(_ROOM + "collision:COLLISION", "of spheres close to the scene"),
        "self_collision": Entry(_ROOM + "self_collision:SELF_COLLISION", "of links close to each other"),
        "limits": Entry(_ROOM + "limits:LIMITS", "of joint values close to their limits"),
        "smoothness": Entry(_ROOM + "smoothness:SMOOTHNESS", "of accelerations"),
        "length": Entry(_ROOM + "length:LENGTH", "of velocities"),
    },
)
"""Values of type `cost.Cost`. These five are compiled and have a setting each; others are given their
strength by name in `GuidanceSettings.extra_costs`."""
