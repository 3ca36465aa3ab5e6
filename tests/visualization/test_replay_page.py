"""Replays: content, size, self-containment, and errors for bad output files."""

import base64
import re
from pathlib import Path

import numpy as np
import pytest

import robotdiffuse as rd
from helpers.browsers import page_data
from helpers.panda import GOAL, PANDA, START
from helpers.refusals import refuses
from robotdiffuse.core.transforms import transform
from robotdiffuse.drawables import decimated
from robotdiffuse.visualization import PictureSettings, write_picture, write_replay
from robotdiffuse.visualization.picture import DrawnArm
from robotdiffuse.visualization.replay_page import COLLIDING, write_problem

pytestmark = pytest.mark.usefixtures("few_lights")
SMALL = PictureSettings(width=320, height=200, ghosts=2)


def test_replay_holds_everything_and_loads_nothing(arm, scene, motion, tmp_path):
    path = rd.Path(arm.joint_names, motion.positions)
    told = rd.Status.SOLVED, "", "robotdiffuse", arm.name, 0.0123, 0, "refinement", path, motion
    result = rd.PlanResult(*told, min_clearance=0.042)
    file = tmp_path / "replay.html"
    write_replay(arm, scene, motion, file, result=result, title="a < b </script> {{data}}")
    text = file.read_text("utf-8")
    data = page_data(file)
    assert "a &lt; b &lt;/script&gt; {{data}}" in text
    assert data["robot"]["joints"] == list(arm.joint_names)
    assert [shape["kind"] for shape in data["scene"]] == [shape.kind for shape in scene.shapes]
    assert len(data["times"]) == len(data["positions"]) == 121, "60 rows a second and no more"
    np.testing.assert_allclose(data["positions"][0], motion.positions[0], atol=1e-5)
    np.testing.assert_allclose(data["positions"][-1], motion.positions[-1], atol=1e-5)
    assert dict(data["facts"])["clearance"] == "42.0 mm" and dict(data["facts"])["planner"] == "robotdiffuse · refinement"
    assert data["robot"]["spheres"] == [[3, 0.0, 0.0, 0.1, 0.12]] and file.stat().st_size < 800_000
    # The one address is the name of a namespace, which no browser opens.
    assert set(re.findall(r"https?://[^\s\"'`)]+", text)) <= {"http://www.w3.org/1999/xhtml"}
    for loading in (r"<link\b", r"\bsrc\s*=\s*[\"']", r"@import", r"url\((?!#)", r"\bimport\s*\("):
        assert not re.search(loading, text.split("<script>")[0]), loading
    assert not re.search(r"<script[^>]+src", text)
    for surface, part in zip(DrawnArm(arm).surfaces, data["robot"]["frames"], strict=True):
        raw = np.frombuffer(base64.b64decode(part["vertices"]), "<u2").reshape(-1, 3)
        np.testing.assert_allclose(part["low"] + raw * part["step"], surface.vertices, atol=1e-5)
        np.testing.assert_array_equal(np.frombuffer(base64.b64decode(part["faces"]), "<u2").reshape(-1, 3), surface.faces)


@pytest.mark.parametrize("rows", [1, 2])
def test_path_that_does_not_move(arm, rows, tmp_path):
    path = rd.Path(arm.joint_names, np.tile([0.1, 0.2, 0.1], (rows, 1)))
    write_replay(arm, rd.Scene(), path, tmp_path / "still.html")
    write_picture(arm, rd.Scene([rd.PointCloud(np.zeros((0, 3)))]), path, tmp_path / "still.png", settings=SMALL)
    assert page_data(tmp_path / "still.html")["times"] == [0.0] * rows


def test_large_input_stays_small(arm, tmp_path):
    rng = np.random.default_rng(5)
    n = 200
    x, y = np.meshgrid(np.linspace(0, 1, n), np.linspace(0, 1, n))
    vertices = np.stack([x, y, 0.05 * np.sin(20 * x)], axis=-1).reshape(-1, 3)
    i = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).reshape(-1)
    faces = np.concatenate([np.stack([i, i + 1, i + n], 1), np.stack([i + 1, i + n + 1, i + n], 1)])
    scene = rd.Scene([rd.PointCloud(rng.uniform(-1, 1, (100_000, 3))), rd.Mesh(vertices, faces)])
    write_replay(arm, scene, rd.Path(arm.joint_names, rng.uniform(0, 0.2, (10_000, 3))), tmp_path / "large.html")
    assert (tmp_path / "large.html").stat().st_size < 3_000_000
    fewer, kept = decimated(vertices, faces)
    assert 10_000 < len(kept) <= 60_000
    np.testing.assert_allclose(np.ptp(fewer, axis=0), np.ptp(vertices, axis=0), atol=0.02)


@pytest.mark.parametrize("name", ["motion.jpg", "motion", "missing/motion.{}", "folder.{}", "folder.{}/motion.{}x"])
@pytest.mark.parametrize(("write", "ending"), [(write_picture, "png"), (write_replay, "html")])
def test_bad_output_is_one_line(arm, motion, write, ending, name, tmp_path):
    (tmp_path / f"folder.{ending}").mkdir()
    refuses(".", write, arm, rd.Scene(), motion, tmp_path / name.format(ending, ending))
    assert [entry.name for entry in tmp_path.iterdir()] == [f"folder.{ending}"], "nothing is left behind"


def test_names_of_obstacles_stay_text_in_a_replay(arm, motion, tmp_path) -> None:
    name = "</script><script>alert(1)</script>"
    write_replay(arm, rd.Scene([rd.Sphere([1, 1, 1], 0.1, name=name)]), motion, tmp_path / "replay.html")
    text = (tmp_path / "replay.html").read_text("utf-8")
    assert "<script>alert" not in text and page_data(tmp_path / "replay.html")["scene"][0]["name"] == name


def test_moving_obstacles_are_on_the_page_and_in_the_picture(arm, motion, tmp_path):
    ball = rd.MovingObstacle(rd.Sphere([0.5, 0.2, 0.3], 0.1, name="ball"), velocity=[0.0, -0.3, 0.0])
    write_replay(arm, rd.Scene(), motion, tmp_path / "replay.html", moving=[ball])
    [mover] = page_data(tmp_path / "replay.html")["moving"]
    assert mover["shape"]["name"] == "ball"
    np.testing.assert_allclose(mover["track"][0], [0, 0, 0, 1, 0, 0, 0], atol=1e-6)
    np.testing.assert_allclose(mover["track"][-1][1], -0.3 * motion.duration, atol=1e-5)
    for name, moving in (("with", [ball]), ("without", [])):
        write_picture(arm, rd.Scene(), motion, tmp_path / f"{name}.png", settings=SMALL, moving=moving)
    assert (tmp_path / "with.png").read_bytes() != (tmp_path / "without.png").read_bytes()


AT_START = rd.Sphere(PANDA.fk(START, "panda_hand")[:3, 3], 0.05, "ball")
FAR = transform(np.array([1.5, 0.0, 0.0]))


def page(problem: rd.Problem, file: Path) -> dict:
    write_problem(problem, file)
    return page_data(file)


def marks(data: dict, color: tuple[int, int, int]) -> list[dict]:
    return [shape for shape in data["scene"] if tuple(shape["color"]) == color]


def test_links_that_collide_are_red(tmp_path: Path) -> None:
    problem = rd.Problem(PANDA, rd.Scene([AT_START]), START, GOAL)
    data = page(problem, tmp_path / "a.html")
    assert len(marks(data, COLLIDING)) == len(problem.is_free(START).links) > 0
    assert data["positions"] == [START.tolist(), GOAL.tolist()] and data["times"] == [0.0, 0.0]
    assert dict(data["facts"])["start"].endswith("inside ball") and dict(data["facts"])["goal"] == "free"
    assert not marks(page(rd.Problem(PANDA, rd.Scene(), START, GOAL), tmp_path / "b.html"), COLLIDING)


@pytest.mark.parametrize("moved", [False, True])
def test_a_goal_out_of_reach_has_axes(moved: bool, tmp_path: Path) -> None:
    problem = rd.Problem(PANDA, rd.Scene(), START, rd.PoseGoal("panda_hand", FAR))
    if moved:
        T = transform(np.array([1.0, 2.0, 0.5]))
        problem = rd.Problem.in_world(T, PANDA, rd.Scene(), START, rd.PoseGoal("panda_hand", T @ FAR))
    data = page(problem, tmp_path / "a.html")
    assert data["positions"] == [START.tolist()] and len(data["scene"]) == 3
    assert dict(data["facts"])["goal"] == "no configuration within the joint limits"


def test_of_several_goals_a_free_one_is_drawn(tmp_path: Path) -> None:
    problem = rd.Problem(PANDA, rd.Scene([AT_START]), GOAL, [START, GOAL])
    assert page(problem, tmp_path / "a.html")["positions"][1] == GOAL.tolist()


def test_a_motion_of_other_joints_is_not_drawn(tmp_path: Path) -> None:
    for names, rows in ((PANDA.joint_names[::-1], np.stack([START, GOAL])), (PANDA.joint_names, np.full((2, 7), np.nan))):
        for write, name in ((write_picture, "a.png"), (write_replay, "a.html")):
            refuses("^the motion (moves|has)", write, PANDA, rd.Scene(), rd.Path(names, rows), tmp_path / name)
