"""PyBullet simulation (extra `sim`): an independent collision oracle, depth cameras, and replay of
motions."""

import os
from contextlib import suppress


def _import_pybullet() -> None:
    """Import PyBullet without the build time that it prints directly to the file descriptors."""
    saved: dict[int, int] = {}
    for stream in (1, 2):
        with suppress(OSError):  # it is closed
            saved[stream] = os.dup(stream)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        for stream in saved:
            os.dup2(nowhere, stream)
        import pybullet  # noqa: F401
    finally:
        for stream, copy in saved.items():
            os.dup2(copy, stream)
            os.close(copy)
        os.close(nowhere)


_import_pybullet()

from robotdiffuse.simulation.camera import DepthCamera, DepthImage, point_cloud, render  # noqa: E402
from robotdiffuse.simulation.recording import FilmSettings, write_gif, write_png  # noqa: E402
from robotdiffuse.simulation.replay import Replay, ReplayContact, ReplaySettings, replay  # noqa: E402
from robotdiffuse.simulation.validator import OracleContact, PyBulletOracle  # noqa: E402
from robotdiffuse.simulation.world import World  # noqa: E402

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
