"""The PyBullet world (extra `sim`): a collision oracle that shares no code with ours, cameras and replay."""

from robotdiffuse.simulation.camera import DepthCamera, DepthImage, point_cloud, render
from robotdiffuse.simulation.film import FilmSettings, write_gif, write_png
from robotdiffuse.simulation.oracle import OracleContact, PyBulletOracle
from robotdiffuse.simulation.replay import Replay, ReplayContact, ReplaySettings, replay
from robotdiffuse.simulation.world import World

__all__ = [
    "DepthCamera",
    "DepthImage",
    "FilmSettings",
    "OracleContact",
    "PyBulletOracle",
    "Replay",
    "ReplayContact",
    "ReplaySettings",
    "World",
    "point_cloud",
    "render",
    "replay",
    "write_gif",
    "write_png",
]
