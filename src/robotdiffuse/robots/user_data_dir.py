"""The folder of the user's robots."""

import os
from pathlib import Path


def user_robots() -> Path:
    """The folder of added robots: $ROBOTDIFFUSE_ROBOTS, or robotdiffuse/robots in the user's data
    directory."""
    chosen = os.environ.get("ROBOTDIFFUSE_ROBOTS")
    if chosen:
        return Path(chosen)
    data = os.environ.get("XDG_DATA_HOME") or Path.home() / ".local" / "share"
    return Path(data) / "robotdiffuse" / "robots"
