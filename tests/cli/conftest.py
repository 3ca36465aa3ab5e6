"""Commands run in an empty folder, and draw small pictures."""

from pathlib import Path

import pytest

from helpers.commands import Said, run


@pytest.fixture(autouse=True)
def in_empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, small_pictures: None) -> None:
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def said(capsys: pytest.CaptureFixture[str]) -> Said:
    def of(status: int, *argv: object) -> str:
        assert run(*argv) == status
        printed = capsys.readouterr()
        return printed.err if status > 1 else printed.out

    return of
