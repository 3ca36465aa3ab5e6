"""The command line as a whole: bad calls, help, closed output, Ctrl-C; the smaller commands."""

import json
import subprocess
import sys
import threading
import time
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest
import rich.console
import yaml

from helpers.code_blocks import PAGES, ROOT, code_blocks
from helpers.commands import PROBLEM, Said, python, run, write_problem
from helpers.made_arms import chain, row, written
from helpers.quick_preparation import QUICK, coarse_grids
from robotdiffuse.cli import COMMANDS, console
from robotdiffuse.core import registry
from robotdiffuse.core.loading import compiled
from robotdiffuse.planning import PLANNERS
from robotdiffuse.problems.fields import problem_schema
from robotdiffuse.robots import load_robot
from robotdiffuse.scenes.files import SHAPES

PLAN = ["plan", "problem.json"]
TRAIN = ["train", "planner", "--data", "d", "--encoder", "dgcnn", "--out", "o"]
BAD_CALL = {
    "no command": ([], "COMMAND"),
    "unknown command": (["plna"], "did you mean plan?"),
    "missing file": (["plan", "missing.yaml"], "missing.yaml"),
    "weights of a planner without": ([*PLAN, "--planner", "rrt_connect", "--weights", "w"], "rrt_connect has no weights"),
    "weights of a name too long": ([*PLAN, "--planner", "diffusion", "--weights", "w" * 5000], "wwww... File name too long"),
    "weights that are none": ([*PLAN, "--planner", "diffusion", "--weights", "."], "holds no model"),
    "unknown planner": ([*PLAN, "--planner", "rrt"], "known: a_star, aorrtc, control"),
    "no time": ([*PLAN, "--time-limit", "0"], "time_limit is 0"),
    "negative clearance": ([*PLAN, "--clearance", "-1"], "clearance is -1.0"),
    "unknown ending": ([*PLAN, "--out", "r.xml"], "unknown ending '.xml'; known: .json"),
    "the problem as output": ([*PLAN, "--out", "./problem.json"], "problem.json is an input"),
    "the result as output": (["export", "problem.json", "--out", "problem.json"], "problem.json is an input"),
    "the motion as certificate": (["verify", "problem.json", "--certificate", "problem.json"], "is an input"),
    "missing folder": ([*PLAN, "--out", "no/r.json"], "the folder no does not exist"),
    "unknown option": ([*PLAN, "--tme-limit=3"], "did you mean --time-limit?"),
    "unknown robot": (["robot", "info", "pandaa"], "pandaa"),
    "no workers": (["data", "generate", "--out", "d", "--workers", "0"], "'0' is not an integer"),
    "no folder": (["data", "generate", "--out", ""], "--out: empty"),
    "no planner": (["bench", "run", "--problems", "rop", "--planners", "aorrtc,", "--out", "d"], "--planners: empty"),
    "a family without its share": (["data", "generate", "--out", "d", "--mix", "rop"], "'rop' is not NAME=NUMBER"),
    "shares without a sum": (["data", "generate", "--out", "d", "--mix", "rop=1e308,shelf=1e308"], "at most 1e9"),
    "a seed that is too large": (["train", "encoder", "--out", "e", "--seed", "9" * 20], "below 2^63"),
    "a seed of more than 308 digits": (["train", "encoder", "--out", "e", "--seed", "9" * 400], "below 2^63"),
    "more motions than a disk holds": (["data", "generate", "--out", "d", "--trajectories", "9" * 20], "at most 10^9"),
    "train without out": (["train", "encoder"], "--out"),
    "train twice as long": (["train", "encoder", "--out", "e", "--minutes", "1", "--samples", "9"], "not allowed with"),
    "no data": (["data", "info", "."], "no data set"),
    "no data file": (["data", "import", "x.npz", "--out", "y"], "x.npz does not exist"),
    "ending of a replay": (["explore", "problem.json", "--out", "seen.gif"], ".html, .png"),
    "ending of a recording": (["explore", "problem.json", "--record", "seen.bag"], ".mcap"),
    "unknown policy": (["explore", "problem.json", "--policy", "bold"], "unknown explorer.policy"),
    "two policies": (["explore", "problem.json", "--policy", "probabilistic", "--see-goal"], "see_goal needs policy 'strict'"),
    "files of a live page": (["explore", "problem.json", "--live", "--view"], "--live writes no files"),
    "speed of no page": (["explore", "problem.json", "--speed", "2"], "add --live"),
    "two demos": (["demo", "--explore", "--camera"], ""),
    "unknown sampler": ([*TRAIN, "--sampler", "heun"], "known: ddim, ddpm"),
    "too few waypoints": ([*TRAIN, "--waypoints", "2"], "waypoints is 2"),
    "more threads than a machine has": ([*TRAIN, "--threads", "1000000"], "threads is 1000000; it must be between"),
    "unknown device": ([*TRAIN, "--device", "tpu"], "known: cpu, cuda"),
    "a file as data": (["data", "info", "problem.json"], "there is no problem.json/manifest.json"),
    "a page below a file": (["view", "problem.json", "--out", "problem.json/x.html"], "problem.json is a file, not a folder"),
    "an output that no folder takes": (["explore", "problem.json", "--record", "/proc/x.mcap"], "x.mcap cannot be written"),
    "ending of exported data": (["data", "export", ".", "x.txt"], "unknown ending '.txt'; known: .npz"),
    "a recording as result": (["view", "x.mcap"], "unknown result file format of x.mcap: '.mcap'; known: .json"),
    "a recording as certificate": (["certificate", "check", "x.mcap"], "unknown certificate format of x.mcap"),
    "a port that none has": (["serve", "--port", "65536"], "--port: '65536' is not a port, an integer from 0 to 65535"),
    "an encoder that is none": (["train", "encoder", "--encoder", "e", "--out", "o"], "trained alone 'e'; known:"),
    "training without data": (["train", "planner", "--data", "d", "--out", "o"], "no data set"),
    "problems that are none": (["bench", "run", "--planners", "aorrtc", "--problems", "p", "--out", "o"], "'p' are neither"),
    "a control without its data": (["reproduce", "table1", "--data", "d", "--out", "o"], "there is no d/manifest.json"),
    "an encoder for data to come": (["train", "planner", "--robot", "panda", "--encoder", "e", "--out", "o"], "e holds no"),
    "workers for existing data": ([*TRAIN, "--workers", "2"], "--workers is for data to be generated"),
}  # fmt: skip


@pytest.mark.parametrize(("argv", "named"), BAD_CALL.values(), ids=BAD_CALL)
def test_bad_call_is_status_2_in_one_line(argv: list[str], named: str, tmp_path: Path, said: Said) -> None:
    write_problem(tmp_path)
    error = said(2, *argv)
    assert "error: " in error and named in error and error.count("\n") == 1
    assert [file.name for file in tmp_path.iterdir()] == ["problem.json"]


def test_what_does_not_fit_into_memory_is_one_line(monkeypatch: pytest.MonkeyPatch, said: Said) -> None:
    monkeypatch.setattr("robotdiffuse.cli.data.generate", lambda *_: np.empty(2**55))
    error = said(2, "data", "generate", "--out", "d", "--waypoints", "999999999")
    assert "not enough memory" in error and error.count("\n") == 1


def test_help_and_version(said: Said) -> None:
    assert "--time-limit" in said(0, "plan", "--help")
    assert said(0, "--version").startswith("robotdiffuse 0.")
    printed = said(0, "--help")
    topics = [line for line in printed.splitlines() if line.endswith(":") and not line.startswith(" ")]
    assert topics[1:] == [f"{topic}:" for topic in COMMANDS], "every command is below a topic"
    assert "\n  plan         plan a motion" in printed


def test_output_that_leads_nowhere() -> None:
    """There is no traceback, and the exit status differs from that of a problem without a motion."""
    for command, status, said in (
        ("{} > /dev/full", 3, "the output could not be written: No space left on device"),
        ("{} | true; exit ${{PIPESTATUS[0]}}", 3, ""),
        ("{} >&-", 0, ""),
        ("PYTHONIOENCODING=ascii {} > /dev/null", 0, ""),
    ):
        line = command.format(f"{sys.executable} -m robotdiffuse robot info panda")
        ended = subprocess.run(["bash", "-c", line], capture_output=True, text=True)
        assert (ended.returncode, ended.stderr.strip()) == (status, f"robotdiffuse: {said}" if said else "")


def test_ctrl_c_while_the_command_line_is_imported_is_one_line() -> None:
    code = """
import sys
class Interrupted:
    def find_spec(self, name, *_):
        if name == "robotdiffuse.cli":
            raise KeyboardInterrupt
sys.meta_path.insert(0, Interrupted())
from robotdiffuse.__main__ import main
sys.exit(main())
"""
    ended = python(code, 130)
    assert (ended.stdout, ended.stderr) == ("", "robotdiffuse: stopped\n")


def test_planners_are_listed_without_loading_them_and_so_are_their_settings(said: Said) -> None:
    listed = python("from robotdiffuse.cli import *; main(['planner', 'list']); sys.exit('torch' in sys.modules)").stdout
    assert all(name in listed for name in PLANNERS)
    printed = said(0, "planner", "info", "rrt_connect")
    assert "range" in printed and "0.7" in printed and "Longest extension of a tree" in printed
    assert "unknown planner 'teleport'" in said(2, "planner", "info", "teleport")
    assert said(2, "planner", "info", "aorrt").endswith("did you mean aorrtc?\n")


def test_a_module_of_the_current_folder_adds_planners_and_shapes(tmp_path: Path, monkeypatch, said: Said) -> None:
    """Regression: results with an added shape could be planned, but not verified, drawn or exported."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.setattr(registry, "imported", [])
    (tmp_path / "added.py").write_text(
        "from dataclasses import replace\nfrom robotdiffuse.planning import PLANNERS\n"
        "PLANNERS['mine'] = replace(PLANNERS['aorrtc'], description='my own')\n"
        "from robotdiffuse.scenes.files import SHAPES\nfrom robotdiffuse.scenes.shapes import Sphere\n"
        "class Ball(Sphere):\n    kind = 'ball'\nSHAPES['ball'] = Ball\n"
    )
    problem = write_problem(tmp_path, scene=[{"ball": {"center": [0.5, 0.0, 1.5], "radius": 0.1}}])
    with patch.dict(PLANNERS), patch.dict(SHAPES):
        assert "my own" in said(0, "planner", "list", "--import", "added")
        assert run("plan", problem, "--planner", "mine", "--import", "added", "--out", "result.json") == 0
        SHAPES.pop("ball")
        assert "ball" in said(2, "verify", "result.json")
        monkeypatch.setattr(registry, "imported", [])
        monkeypatch.delitem(sys.modules, "added")
        again = ("verify", "a.csv", "--problem", problem)
        for command in (("verify", "result.json"), ("export", "result.json", "--out", "a.csv"), again):
            assert run(*command, "--import", "added") == 0
    error = said(2, "bench", "confirm", "runs", "--import", "no_such_module")
    assert "module 'no_such_module' cannot be imported: ModuleNotFoundError" in error


def test_a_working_folder_that_was_deleted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, said: Said) -> None:
    """Regression: every command, and `save`, ended with "No such file or directory" without a name."""
    folder = tmp_path / "gone"
    folder.mkdir()
    problem = write_problem(tmp_path)
    monkeypatch.chdir(folder)
    folder.rmdir()
    assert "result.json cannot be written: No such file" in said(2, "plan", problem, "--out", "result.json")
    assert "module 'added' cannot be imported: FileNotFound" in said(2, "planner", "list", "--import", "added")


def test_a_log_says_what_is_compiled(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    """Regression: without a terminal, `demo` printed nothing for a minute and a half on a new machine."""
    monkeypatch.setattr(console, "SPINNER_DELAY", 0.0)
    monkeypatch.setattr(console, "LOG_INTERVAL", 0.01)
    with console.Spinner("planning"):
        compiled.append("search")
        said = ""
        while "\n" not in said:
            time.sleep(0.01)
            said += capsys.readouterr().err
    assert said.splitlines()[0] == "planning: compiling, once on this machine; 1 so far (search)"


def test_a_spinner_that_ends_as_it_appears_gives_stdout_back(monkeypatch: pytest.MonkeyPatch) -> None:
    """Regression: a plan of two seconds printed its result to standard error, since rich had replaced sys.stdout for good."""
    ending = threading.Event()
    stop = console.Spinner.stop

    class Terminal(rich.console.Console):
        def __init__(self, **_: object) -> None:
            ending.wait()
            super().__init__(stderr=True, force_terminal=True)

    def begin_to_stop(spinner: console.Spinner) -> None:
        ending.set()
        stop(spinner)

    monkeypatch.setattr(console.Spinner, "stop", begin_to_stop)
    monkeypatch.setattr(console, "SPINNER_DELAY", 0.0)
    monkeypatch.setattr(rich.console, "Console", Terminal)
    before = sys.stdout
    with console.Spinner("planning"):
        pass
    assert sys.stdout is before


def test_progress_without_a_terminal_is_a_line_at_once(capsys: pytest.CaptureFixture) -> None:
    """Regression: `data check` of a few motions printed nothing for 25 s."""
    with console.progress("checking motions") as update:
        update(0, 4)
        assert capsys.readouterr().err == "checking motions: 0 of 4\n"
        update(4, 4)
    assert capsys.readouterr().err == ""


def test_the_schema_accepts_the_problems_of_the_documentation_and_none_of_other_fields(said: Said) -> None:
    validator = pytest.importorskip("jsonschema").Draft202012Validator(problem_schema())
    blocks = (block for page in PAGES for block in code_blocks(page))
    documented = [yaml.safe_load(block.code) for block in blocks if block.language == "yaml"]
    problems = [one for one in documented if isinstance(one, dict) and {"robot", "scene"} <= one.keys()]
    files = [yaml.safe_load(file.read_text()) for file in (ROOT / "examples").glob("*.yaml")]
    assert len(problems) > 5 and len(files) > 2
    for problem in problems + files:
        assert [error.message for error in validator.iter_errors(problem)] == []
    assert json.loads(said(0, "schema")) == problem_schema()
    for shape in ({"ball": {}}, {"box": {"center": [0, 0, 0]}}):
        assert not validator.is_valid(PROBLEM | {"scene": [shape]}), shape
    for changes in ({"gaol": []}, {"unknown": "free"}, {"clearance": 5}, {"goal": {"pose": {"xyz": [0, 0, 0]}}}):
        assert not validator.is_valid(PROBLEM | changes), changes


def completed(script: str, *words: str) -> list[str]:
    """What bash proposes to complete the last of these words."""
    line = " ".join(f'"{word}"' for word in words)
    asks = f"COMP_WORDS=({line}); COMP_CWORD={len(words) - 1}; _robotdiffuse"
    asks += "; printf '%s\\n' \"${COMPREPLY[@]}\""
    return subprocess.run(["bash", "-c", f"{script}\n{asks}"], capture_output=True, text=True, check=True).stdout.split()


def test_bash_completes_commands_and_options(said: Said) -> None:
    script = said(0, "completion", "bash")
    assert completed(script, "robotdiffuse", "pl") == ["plan", "planner"]
    assert completed(script, "robotdiffuse", "plan", "--cl") == ["--clearance"]
    assert completed(script, "robotdiffuse", "data", "inf") == ["info"]
    assert "--page" in completed(script, "robotdiffuse", "data", "info", "folder", "--")
    assert completed(script, "robotdiffuse", "completion", "") == ["bash", "zsh"]
    assert completed(script, "robotdiffuse", "plan", "prob") == []  # then bash completes names of files
    assert "bashcompinit" in said(0, "completion", "zsh")


def test_robot_add_with_srdf_and_robot_list(tmp_path: Path, capsys, said: Said, monkeypatch) -> None:
    """Pairs that an SRDF or the command allows, the comparison with sampling, progress without a terminal."""
    monkeypatch.setenv("ROBOTDIFFUSE_ROBOTS", str(tmp_path / "robots"))
    monkeypatch.setattr("robotdiffuse.robots.fitting.preparation.PreparationSettings", lambda: QUICK)
    file = written(tmp_path, chain("base", row("j", 4), xyz="0 0 0.07", limits='lower="-3" upper="3"'))
    pairs = ("base", "j4_link", "User"), ("base", "j3_link", "Never"), ("base", "j1_link", "Adjacent")
    rows = (f'<disable_collisions link1="{a}" link2="{b}" reason="{why}"/>' for a, b, why in pairs)
    (tmp_path / "made.srdf").write_text(f"<robot name='made'>{''.join(rows)}</robot>")
    with coarse_grids():
        assert run("robot", "add", str(file), "--allow", "j1_link", "j4_link") == 0
    told = capsys.readouterr()
    assert "pairs that differ from made.srdf" in told.out and "User" in told.out and "named 1" in told.out
    assert "5 of 12: spheres of base" in told.err and "12 of 12: done" in told.err
    allowed = load_robot("made").allowed_collisions
    assert frozenset(("j1_link", "j4_link")) in allowed
    assert frozenset(("base", "j4_link")) not in allowed  # found beside: compared, not taken
    with coarse_grids():
        assert run("robot", "add", file, "--srdf", tmp_path / "made.srdf", "--name", "by_srdf") == 0
    assert frozenset(("base", "j4_link")) in load_robot("by_srdf").allowed_collisions
    assert "unknown link in allow 'moon'" in said(2, "robot", "add", str(file), "--allow", "base", "moon")
    refused = said(2, "robot", "add", str(file), "--out", "made.srdf")
    assert "folder made.srdf: it is a file" in refused and refused.count("\n") == 1  # before the first step
    out = said(0, "robot", "list")
    assert all(name in out for name in ("panda", "made", "by_srdf"))
    assert len(str(load_robot("panda")).splitlines()) <= 10
    printed = said(0, "robot", "info", "panda")
    assert "panda_joint7" in printed and "2.8973" in printed and "spheres on" in printed
