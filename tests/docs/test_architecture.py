"""Every file that the architecture page names exists."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
SOURCE = ROOT / "src" / "robotdiffuse"
PAGE = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
FILES = sorted(set(re.findall(r"`([\w/]+\.py)`", PAGE)))


def test_every_named_file_exists() -> None:
    """A row of the page names a folder once; further files of the row have shorter paths."""
    missing = [name for name in FILES if not (ROOT / name).is_file() and not any(SOURCE.rglob(name))]
    assert not missing, f"docs/architecture.md names {missing}"


def test_every_package_is_described() -> None:
    packages = {folder.name for folder in SOURCE.iterdir() if (folder / "__init__.py").is_file()}
    described = set(re.findall(r"^\| `(\w+)` \|", PAGE, re.MULTILINE))
    assert packages <= described, f"docs/architecture.md lacks {', '.join(sorted(packages - described))}"
