"""Files are written whole or not at all, by several threads too."""

import os
import threading
from pathlib import Path

import pytest

from robotdiffuse.core.output_files import JsonLines, write_atomically


def test_threads_that_write_one_file_leave_one_of_their_texts(tmp_path: Path) -> None:
    """They shared a temporary file, which one moved away while another wrote it."""
    file = tmp_path / "a.json"
    errors = list[Exception]()
    texts = [letter * 100_000 for letter in "ab"]

    def write(text: str) -> None:
        try:
            for _ in range(50):
                write_atomically(file, text)
        except Exception as error:
            errors.append(error)

    threads = [threading.Thread(target=write, args=(text,)) for text in texts]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not errors and file.read_text() in texts and list(tmp_path.iterdir()) == [file]


def test_an_interrupted_write_leaves_no_temporary_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(Path, "replace", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_atomically(tmp_path / "a.json", "a")
    assert not list(tmp_path.iterdir())


def test_a_row_that_is_not_written_whole_is_dropped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The next row continued its line, which no reader understood then."""
    lines = JsonLines(tmp_path / "a.jsonl")
    lines.append({"a": 1})

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        with pytest.raises(OSError, match="No space"):
            lines.append({"a": 2})
    lines.append({"a": 3})
    assert lines.rows == JsonLines(tmp_path / "a.jsonl").rows == [{"a": 1}, {"a": 3}]
