"""Commands run in an empty folder, and draw small pictures."""

from pathlib import Path

import pytest


@pytest.fixture(autouse=True)
def in_empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, small_pictures: None) -> None:
    monkeypatch.chdir(tmp_path)
