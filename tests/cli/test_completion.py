"""The commands `schema` and `completion`."""

import json
import subprocess
from pathlib import Path

import pytest
import yaml

from helpers.code_blocks import PAGES, code_blocks
from helpers.commands import PROBLEM, Said
from robotdiffuse.problems.fields import problem_schema

ROOT = Path(__file__).parents[2]
BLOCKS = [
    yaml.safe_load(block.code) for page in PAGES for block in code_blocks(page) if block.language == "yaml"
]
PROBLEMS = [block for block in BLOCKS if isinstance(block, dict) and {"robot", "scene"} <= block.keys()]


def test_the_schema_accepts_the_problems_of_the_documentation() -> None:
    jsonschema = pytest.importorskip("jsonschema")
    validator = jsonschema.Draft202012Validator(problem_schema())
    files = [yaml.safe_load(file.read_text()) for file in (ROOT / "examples").glob("*.yaml")]
    assert len(PROBLEMS) > 5 and len(files) > 2
    for problem in [*PROBLEMS, *files]:
        assert [error.message for error in validator.iter_errors(problem)] == []


@pytest.mark.parametrize(
    "changes",
    [
        {"gaol": []},
        {"scene": [{"ball": {}}]},
        {"scene": [{"box": {"center": [0, 0, 0]}}]},
        {"unknown": "free"},
        {"clearance": 5},
        {"goal": {"pose": {"xyz": [0, 0, 0]}}},
    ],
)
def test_the_schema_refuses_what_files_may_not_hold(changes: dict[str, object]) -> None:
    jsonschema = pytest.importorskip("jsonschema")
    assert not jsonschema.Draft202012Validator(problem_schema()).is_valid(PROBLEM | changes)


def test_the_schema_is_printed(said: Said) -> None:
    assert json.loads(said(0, "schema")) == problem_schema()


def completed(script: str, *words: str) -> list[str]:
    """What bash proposes for the last of these words."""
    line = " ".join(f'"{word}"' for word in words)
    asks = f"COMP_WORDS=({line}); COMP_CWORD={len(words) - 1}; _robotdiffuse"
    asks += "; printf '%s\\n' \"${COMPREPLY[@]}\""
    ended = subprocess.run(["bash", "-c", f"{script}\n{asks}"], capture_output=True, text=True, check=True)
    return ended.stdout.split()


def test_bash_completes_commands_and_options(said: Said) -> None:
    script = said(0, "completion", "bash")
    assert completed(script, "robotdiffuse", "pl") == ["plan", "planner"]
    assert completed(script, "robotdiffuse", "plan", "--cl") == ["--clearance"]
    assert completed(script, "robotdiffuse", "data", "inf") == ["info"]
    assert "--page" in completed(script, "robotdiffuse", "data", "info", "folder", "--")
    assert completed(script, "robotdiffuse", "completion", "") == ["bash", "zsh"]
    assert completed(script, "robotdiffuse", "plan", "prob") == []  # then bash completes names of files
    assert "bashcompinit" in said(0, "completion", "zsh")
