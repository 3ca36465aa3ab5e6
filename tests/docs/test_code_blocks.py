"""Every code block of the README and of the documentation does what it says; see helpers/code_blocks.py."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from helpers.code_blocks import PAGES, ROOT, Notebook, code_blocks

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_code_blocks_of_a_page(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("ROBOTDIFFUSE_ROBOTS", str(tmp_path / "robots"))
    shutil.copytree(ROOT / "examples", tmp_path / "examples")
    notebook = Notebook(tmp_path)
    for block in code_blocks(page):
        try:
            notebook.try_block(block)
        except BaseException as error:
            error.add_note(f"in the code block at {block.where}")
            raise


def test_a_page_that_starts_processes_runs_as_one_script(tmp_path: Path) -> None:
    """Each process imports the script again; without a guard in the script, processes would start processes without end."""
    scripts = {page: script(page) for page in PAGES}
    guarded = {page: text for page, text in scripts.items() if '"__main__"' in text}
    assert [page.name for page in guarded] == ["plan.md"]
    shutil.copytree(ROOT / "examples", tmp_path / "examples")
    for text in guarded.values():
        (tmp_path / "page.py").write_text(text, encoding="utf-8")
        command = [sys.executable, "page.py"]
        paths = os.environ | {"PYTHONPATH": str(ROOT / "src")}
        done = subprocess.run(command, cwd=tmp_path, env=paths, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        assert sum(line.startswith("solved ") for line in done.stdout.splitlines()) >= 2, done.stdout


def test_code_of_pages_passes_the_type_checker(tmp_path: Path) -> None:
    """In one run, since each checks the package first."""
    for name in ("README", "docs/quick_start", "docs/how_to/plan"):
        (tmp_path / f"{Path(name).name}_page.py").write_text(script(ROOT / f"{name}.md"), encoding="utf-8")
    settings = {"extraPaths": [str(ROOT / "src")], "typeCheckingMode": "basic", "pythonVersion": "3.11"}
    (tmp_path / "pyrightconfig.json").write_text(json.dumps(settings))
    command = [sys.executable, "-m", "pyright", "--pythonpath", sys.executable]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout


def script(page: Path) -> str:
    """The Python blocks of a page that run, one after the other."""
    blocks = [block for block in code_blocks(page) if block.language == "python"]
    return "\n".join(b.code for b in blocks if "file" not in b.marks and b.marks.get("test") != "parse")
