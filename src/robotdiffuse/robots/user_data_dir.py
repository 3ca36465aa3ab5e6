"""Where a user's robots are, with what was made for them."""

import os
from pathlib import Path


def user_robots() -> Path:
    """Where robots that were added are kept: $ROBOTDIFFUSE_ROBOTS or the user's data directory."""
    chosen = os.environ.get("ROBOTDIFFUSE_ROBOTS")
    if chosen:
        return Path(chosen)
    data = os.environ.get("XDG_DATA_HOME") or Path.home() / ".local" / "share"
    return Path(data) / "robotdiffuse" / "robots"
