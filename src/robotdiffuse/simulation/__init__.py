"""PyBullet simulation (extra `sim`): an independent collision oracle, and replay of motions."""

import os
import tempfile
from contextlib import suppress

from robotdiffuse.core.errors import needs

# beginning of the line that PyBullet prints when it is imported
BUILD_TIME = b"pybullet build time"


def _import_pybullet() -> None:
    """Import PyBullet, and suppress the build time that it prints directly to a file descriptor. Output of
    other threads during the import is printed afterwards."""
    saved = dict[int, int]()
    for stream in (1, 2):
        with suppress(OSError):  # the stream is closed
            saved[stream] = os.dup(stream)
    printed = {stream: tempfile.TemporaryFile() for stream in saved}  # noqa: SIM115  (closed below)
    try:
        for stream, file in printed.items():
            os.dup2(file.fileno(), stream)
        with needs("PyBullet, whose wheels stop at Python 3.11", "sim"):
            import pybullet  # noqa: F401
    finally:
        for stream, file in printed.items():
            os.dup2(saved[stream], stream)
            os.close(saved[stream])
            with file, suppress(OSError):
                file.seek(0)
                os.write(stream, b"".join(line for line in file if not line.startswith(BUILD_TIME)))


_import_pybullet()

from robotdiffuse.simulation.validator import OracleContact, PyBulletOracle  # noqa: E402
from robotdiffuse.simulation.world import Replay, ReplayContact, ReplaySettings, World, replay  # noqa: E402

__all__ = ["OracleContact", "PyBulletOracle", "Replay", "ReplayContact", "ReplaySettings", "World", "replay"]
