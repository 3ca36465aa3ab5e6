"""The machine and the versions of packages that figures were measured with."""

import os
import platform
from collections.abc import Iterable
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path as FilePath


def processor() -> str:
    """The name of the processor."""
    info = FilePath("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    names = (line.split(": ")[1] for line in lines if line.startswith("model name"))
    return next(names, platform.processor())


def versions(packages: Iterable[str]) -> dict[str, str]:
    """Versions of packages; `none` for one that is not installed."""
    found = {}
    for name in packages:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "none"
    return found


def about(packages: Iterable[str]) -> str:
    """Processor, load and versions, as one line for the head of a report."""
    names = ", ".join(f"{name} {number}" for name, number in versions(packages).items())
    return (
        f"{processor()}, {os.cpu_count()} cores, load average {os.getloadavg()[0]:.1f} before; "
        f"Python {platform.python_version()}, {names}"
    )
