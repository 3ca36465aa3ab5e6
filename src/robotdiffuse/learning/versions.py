"""What a checkpoint was made with."""

from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version

import torch


def versions() -> dict[str, str]:
    """Versions of this package and of PyTorch, and the day."""
    try:
        own = version("robotdiffuse")
    except PackageNotFoundError:
        own = "from source"
    return {"robotdiffuse": own, "torch": torch.__version__, "made": datetime.now(UTC).strftime("%Y-%m-%d")}
