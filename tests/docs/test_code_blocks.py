"""Every code block of the README and the documentation does what it says; what docs/extending.md adds to tables is used."""

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest

import robotdiffuse as rd
from helpers.code_blocks import PAGES, ROOT, Notebook, code_blocks
from robotdiffuse.collision.exact_meshes import ExactCollision
from robotdiffuse.evaluation.metrics import METRICS
from robotdiffuse.learning.denoisers import DENOISERS
from robotdiffuse.learning.diffusion import SAMPLERS
from robotdiffuse.learning.encoders import ENCODERS
from robotdiffuse.planning import PLANNERS
from robotdiffuse.problems.families import FAMILIES, load_family
from robotdiffuse.problems.families.family import Family
from robotdiffuse.problems.files import problem_record
from robotdiffuse.scenes.files import SHAPES
from robotdiffuse.scenes.surface_points import sample_surface
from robotdiffuse.simulation import PyBulletOracle
from robotdiffuse.visualization.replay_page import write_replay

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
        paths = os.environ | {"PYTHONPATH": str(ROOT / "src")}
        done = subprocess.run([sys.executable, "page.py"], cwd=tmp_path, env=paths, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        assert sum(line.startswith("solved ") for line in done.stdout.splitlines()) >= 2, done.stdout


ARGUMENTS = """
import numpy as np
import robotdiffuse as rd

ball = rd.Sphere([0, 0, 1], 0.1)
tube = rd.Capsule((0, 0, 1), 0.1, 0.2, wxyz=np.ones(4))
middle: np.ndarray = rd.Cylinder([0, 0, 0], 0.1, 0.2).center + tube.center
meshes = (rd.Box(middle, [1, 1, 1]), rd.Mesh(np.zeros((4, 3)), np.zeros((4, 3), int), xyz=[0, 0, 1]))
clouds = (rd.PointCloud(np.zeros((5, 3), np.float32)), rd.HeightMap([[0.0, 0.1], [0.2, 0.3]], 0.1))
carried = rd.Payload(1.0, [0, 0, 0.1])
moving = rd.MovingObstacle(ball, times=[0, 1], poses=[np.eye(4), np.eye(4)])
goal = rd.AnyGoal((rd.JointGoal([[0.0] * 7]), rd.PoseGoal("hand", np.eye(4).tolist(), xyz_tolerance=[0.1, 0.1, 0.1])))
region = (rd.PositionBox("hand", [0, 0, 0], [1, 1, 1]), rd.AxisCone("hand", [0, 0, 1], [0, 0, -1], 0.1))
surface = (rd.OnPlane("hand", [0, 0, 0], [0, 0, 1], 0.01), rd.OnLine("hand", [0, 0, 0], [0, 0, 1], 0.01))
planned = rd.load_planner("rrt_connect").plan(rd.load_problem("ball.yaml"))
"""


@pytest.mark.parametrize("checker", ["pyright", "mypy"])
def test_code_of_pages_passes_the_type_checkers(checker: str, tmp_path: Path) -> None:
    """In one run, since each checks the package first. Regression: for mypy, `rd.Sphere([0, 0, 1], 0.1)` was an error."""
    pytest.importorskip(checker)
    for name in ("README", "docs/quick_start", "docs/how_to/plan"):
        (tmp_path / f"{Path(name).name}_page.py").write_text(script(ROOT / f"{name}.md"), encoding="utf-8")
    (tmp_path / "arguments.py").write_text(ARGUMENTS)
    settings = {"extraPaths": [str(ROOT / "src")], "typeCheckingMode": "basic", "pythonVersion": "3.11"}
    (tmp_path / "pyrightconfig.json").write_text(json.dumps(settings))
    options = {"pyright": ("--pythonpath", sys.executable), "mypy": ("--strict", "--follow-imports=silent", ".")}
    command = [sys.executable, "-m", checker, *options[checker]]
    paths = os.environ | {"MYPYPATH": str(ROOT / "src")}
    done = subprocess.run(command, cwd=tmp_path, env=paths, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout


def script(page: Path) -> str:
    """The Python blocks of a page that run, one after the other."""
    blocks = [block for block in code_blocks(page) if block.language == "python"]
    return "\n".join(b.code for b in blocks if "file" not in b.marks and b.marks.get("test") != "parse")


@pytest.fixture(scope="module")
def names(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Any]]:
    """The names that the page's Python defines, while its entries are in the tables."""
    folder = tmp_path_factory.mktemp("extending")
    notebook = Notebook(folder)
    with pytest.MonkeyPatch.context() as patch, ExitStack() as as_before:
        patch.chdir(folder)
        patch.syspath_prepend(folder)
        for table in (PLANNERS, FAMILIES, METRICS, SHAPES, DENOISERS, ENCODERS, SAMPLERS, sys.modules):
            as_before.enter_context(mock.patch.dict(table))
        for block in code_blocks(ROOT / "docs" / "extending.md"):
            notebook.try_block(block)
        yield notebook.names


def test_planners_solve_parts_of_networks_are_used_by_name_and_a_metric_is_measured(names: dict[str, Any]) -> None:
    bent = names["bent"]
    assert bent.solved and bent.planner == "one_bend" and len(bent.path.positions) == 3
    assert rd.verify(names["problem"], bent.path).valid
    assert rd.load_planner("one_bend").plan(names["problem"], seed=1).solved
    sampled = names["sampled"]
    assert sampled.solved and sampled.stage == "network" and sampled.planner == "shortened_sample"
    assert rd.verify(names["problem"], sampled.path).valid
    assert names["training"].denoiser == "by_waypoint" and names["motions"].shape == (2, 48, 7)
    assert names["embedding"].shape == (5, names["encoder"].settings.code)
    at_once = names["at_once"]
    assert at_once.planner == "diffusion" and "samples of the network" in at_once.reason
    assert names["values"]["steps"] == 2


def test_a_family_draws_problems(names: dict[str, Any]) -> None:
    family = load_family("posts")
    assert isinstance(family, Family)
    assert len(names["drawn"].scene.shapes) <= 1 + family.max_obstacles
    first, again = (family.draw(names["problem"].robot, np.random.default_rng(3)) for _ in range(2))
    assert np.array_equal(first.start, again.start)


def test_a_shape_is_everywhere(names: dict[str, Any], tmp_path: Path) -> None:
    problem = names["around_cone"]
    result = names["result"]
    [cone] = problem.scene.shapes
    assert result.solved and problem_record(problem)["scene"][0]["cone"]["height"] == cone.height  # type: ignore[index]
    line = np.linspace(problem.start, problem.goal.positions[0], 50)
    assert ExactCollision(problem.robot, problem.scene).collides(line).any(), "the cone is in the way"
    with PyBulletOracle(problem.robot, problem.scene) as oracle:
        assert any(oracle.collides(q) for q in line)
        assert oracle.check_path(result.path) is None
    cloud = sample_surface(problem.scene, 500, np.random.default_rng(0)) - cone.center
    radius = np.linalg.norm(cloud[:, :2], axis=1)
    assert (radius <= (1 - cloud[:, 2] / cone.height) * cone.radius * 1.01 + 1e-9).all()
    write_replay(problem.robot, problem.scene, result.trajectory, tmp_path / "cone.html")
