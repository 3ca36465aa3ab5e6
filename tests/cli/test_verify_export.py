"""The commands `verify`, `certificate check`, `export` and `publish`."""

import json
from pathlib import Path

import pytest
import yaml

import robotdiffuse as rd
from helpers.commands import BALL, PROBLEM, Said, run
from helpers.full_disk import full_disk

POSES = [{"position": [0.5, 0.0, 0.5], "orientation": [0, 0, 0, 1]}]
OBJECT = {"header": {"frame_id": "panda_link0"}, "id": "ball", "primitives": [{"type": "sphere", "dimensions": [0.15]}]}
SCENE = {"world": {"collision_objects": [OBJECT | {"primitive_poses": POSES}]}}


@pytest.fixture(autouse=True)
def planned(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a result, its motion in formats of other programs, and scenes."""
    folder = tmp_path_factory.getbasetemp() / "handed"
    monkeypatch.chdir(tmp_path_factory.mktemp("here"))
    if not folder.exists():
        folder.mkdir()
        (folder / "problem.json").write_text(json.dumps(PROBLEM))
        beside = [BALL, {"sphere": {"center": [0.3, 0.45, 0.5], "radius": 0.1, "name": "new"}}]
        (folder / "other.json").write_text(json.dumps(PROBLEM | {"scene": beside}))
        (folder / "scene.yaml").write_text(yaml.safe_dump(SCENE))
        out = [word for file in ("r.json", "m.rosbag2", "m.yaml") for word in ("--out", folder / file)]
        assert run("plan", folder / "problem.json", "--planner", "rrt_connect", "--time-limit", 5, *out) == 0
    return folder


def test_a_certificate_is_written_and_checked(planned: Path, said: Said) -> None:
    assert "wrote c.json" in said(0, "verify", planned / "r.json", "--certificate", "c.json")
    lines = said(0, "certificate", "check", "c.json").splitlines()
    assert lines[0].startswith("robot: panda, ") and lines[1] == "problem: the one in the certificate"
    assert lines[2].startswith("not checked: ") and lines[3].startswith("holds: at least")
    assert run("certificate", "check", "c.json", "--problem", planned / "problem.json") == 0
    assert "scene: new was added" in said(1, "certificate", "check", "c.json", "--problem", planned / "other.json")
    assert "is not a certificate" in said(2, "certificate", "check", planned / "r.json")


@pytest.mark.parametrize("command", ["export {} --out m.csv", "export {} --out m.rosbag2", "verify {} --certificate c.json"])
def test_a_full_disk_is_status_3(command: str, planned: Path, said: Said) -> None:
    """Regression: the status was 2, that of bad input, so scripts could not distinguish the two."""
    with full_disk():
        error = said(3, *command.format(planned / "r.json").split())
    assert error.count("\n") == 1 and "cannot be written" in error


def test_motions_from_other_programs(planned: Path, said: Said) -> None:
    for file in ("m.rosbag2", "m.yaml", "r.json"):
        assert "trajectory: valid" in said(0, "verify", planned / file, "--problem", planned / "problem.json")
    assert run("verify", planned / "m.yaml", "--scene", planned / "scene.yaml", "--robot", "panda") == 0
    assert run("export", planned / "r.json", "--out", "m.mcap") == 0
    assert run("verify", "m.mcap") == 0  # the problem is in it
    assert "holds no problem; give --problem FILE, or --scene FILE" in said(2, "verify", planned / "m.yaml")
    assert "--scene and --robot belong together" in said(2, "verify", planned / "m.yaml", "--scene", planned / "scene.yaml")
    # Regression: the certificate replaced the scene
    Path("scene.json").write_text("{}")
    asked = ("verify", planned / "m.yaml", "--scene", "scene.json", "--robot", "panda", "--certificate", "scene.json")
    assert "scene.json is an input of this command" in said(2, *asked)


def test_waypoints_among_moving_obstacles_have_a_note(tmp_path: Path, said: Said) -> None:
    """Regression: waypoints through a moving obstacle were valid, without a word."""
    problem = tmp_path / "p.yaml"
    ball = "moving: [{sphere: {center: [0.5, 0, 0.5], radius: 0.25}, velocity: [0, 0, 0]}]"
    problem.write_text(f"robot: panda\nscene: []\nstart: ready\ngoal: {{joints: ready}}\n{ball}\n")
    start = rd.load_problem(problem).start
    names = [f"panda_joint{i}" for i in range(1, 8)]
    (tmp_path / "m.csv").write_text(f"{','.join(names)}\n{','.join(map(str, start))}\n")
    assert "contacts with moving obstacles are not checked" in said(0, "verify", tmp_path / "m.csv", "--problem", problem)


def test_all_violations_are_listed(planned: Path, said: Said) -> None:
    asked = ("verify", planned / "m.yaml", "--problem", planned / "other.json")
    first = said(1, *asked, "--certificate", "c.json")
    assert first.count("not valid") == 1 and "inside new" in first
    assert not Path("c.json").exists()
    every = said(1, *asked, "--all").splitlines()
    assert len(every) > 1 and all("new" in line for line in every)
    times = [float(line.rpartition("(at ")[2].rstrip(")")) for line in every]
    assert times == sorted(times)


def test_only_valid_motions_are_exported(planned: Path, said: Said) -> None:
    assert run("export", planned / "r.json", "--out", "a.csv", "--out", "a.rrd") == 0
    record = json.loads((planned / "r.json").read_text())
    record["problem"] = json.loads((planned / "other.json").read_text())
    Path("bad.json").write_text(json.dumps(record))
    for command in (("export", "bad.json", "--out", "b.yaml"), ("publish", "bad.json", "--to", "localhost")):
        assert "is refused: its motion is not valid" in said(2, *command)
    assert not Path("b.yaml").exists()
    assert "'70000' is not a port" in said(2, "publish", planned / "r.json", "--to", "host:70000")
    assert run("export", planned / "r.json", "--out", "fine.csv", "--rate", "1000") == 0
    assert Path("fine.csv").read_text().splitlines()[2].startswith("0.001,")
    assert run("export", planned / "r.json", "--out", "fine.csv", "--rate", "-1") == 2
    assert "known: .json, .csv, .mcap, .rosbag2, .rrd, .yaml" in said(2, "export", planned / "r.json", "--out", "a.foo")


def test_a_problem_without_scene_is_no_result(tmp_path: Path, said: Said) -> None:
    """Regression: the message listed the fields that a result would have."""
    (tmp_path / "p.json").write_text('{"robot": "panda", "start": "ready", "goal": "extended"}')
    assert "has no scene" in said(2, "view", tmp_path / "p.json", "--out", "x.html")


def test_options_that_would_be_ignored_are_refused(planned: Path, said: Said) -> None:
    assert "--ignore-joints is for MoveIt files" in said(2, "verify", planned / "r.json", "--ignore-joints")
    assert "--index says which" in said(2, "verify", planned / "r.json", "--index", 3)
    assert "--topic is for bags" in said(2, "verify", planned / "r.json", "--topic", "/x")
    assert "--shell is for pictures" in said(2, "view", planned / "r.json", "--shell", 0.05, "--out", "a.png")
