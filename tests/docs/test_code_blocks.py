"""Every code block of the README and of the documentation does what it says; see helpers/code_blocks.py."""

import shutil
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
