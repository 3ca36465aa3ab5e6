"""The paper's tables: problems with both kinds of goal, ComScores by hand, rows, a page made once; configs, the runner."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import robotdiffuse as rd
from helpers.commands import Said
from helpers.refusals import refuses
from robotdiffuse.cli import main
from robotdiffuse.evaluation import ablation, paper
from robotdiffuse.evaluation.bench_comparisons import Indicators, comscores
from robotdiffuse.evaluation.runs import read_records
from robotdiffuse.learning.denoisers import DENOISERS
from robotdiffuse.learning.encoders import ENCODERS, make_encoder
from robotdiffuse.learning.motion_model import MotionModelSettings
from robotdiffuse.learning.motion_network import MotionNetwork
from robotdiffuse.learning.training.config import CONFIGS, planner_training
from robotdiffuse.learning.training.tasks import model_settings
from robotdiffuse.learning.weight_files import BUNDLED, FORMAT, RobotIdentity
from robotdiffuse.problems.files import CaseFile
from robotdiffuse.validation.tolerances import goal_error

ROW_NAMES = {row.paper: row.name for row in paper.ROWS if row.paper}


def test_scores_are_the_papers_and_further_rows_replace_its_method() -> None:
    of = {ROW_NAMES[row.name]: row.indicators for row in paper.PAPER_TABLE_1}
    found = paper.scores(paper.ROWS, of | {"aorrtc": Indicators(100.0, 0.0, 14.0, 1.0)})
    for row, score in zip(paper.PAPER_TABLE_1, comscores([row.indicators for row in paper.PAPER_TABLE_1]), strict=True):
        assert found[ROW_NAMES[row.name]] == pytest.approx(score)
    assert found["aorrtc"] == 1.0  # the best in all four


def test_the_papers_method_has_a_row_only_with_weights_that_see_the_code_alone(tmp_path: Path) -> None:
    assert paper.Table1Settings(tmp_path).rows == paper.ROWS
    with_weights = paper.Table1Settings(tmp_path, paper_weights=str(BUNDLED / "panda"))
    too_fast = paper.Table1Settings(tmp_path, time_limit=1e-4, paper_weights="panda_points")
    refuses("whose inputs include clearances", paper.run_table1, with_weights, lambda _: None, lambda *_: None)
    refuses(r"single sample takes about .* denoising steps", paper.run_table1, too_fast, lambda _: None, lambda *_: None)
    assert not list(tmp_path.iterdir())
    # Regression: the weights of panda_points had two rows, and the error named neither
    planners = [row.planner for row in too_fast.rows]
    assert len(planners) == len({*planners}) == len(paper.ROWS) + 1
    assert paper.NO_WEIGHTS in paper.notes(paper.Table1Settings(tmp_path))
    assert not {*"*`"} & {*paper.NO_WEIGHTS}, "notes are plain text"


def test_the_commands_of_pages_name_data_weights_and_family(tmp_path: Path) -> None:
    of_figures = paper.Table1Settings(tmp_path, problems=3, paper_weights="paper", data="rop").command("figures")
    assert of_figures.endswith(" figures --out FOLDER --problems 3 --time-limit 10 --paper-weights FOLDER --data DATA")
    settings = ablation.AblationSettings(data="rop", out="out", family="shelf", problems=1)
    half = ablation.Evaluation(*(np.full(1, 0.5) for _ in range(5)))
    page = ablation.table2(settings, [ablation.RowResult("Ours", half, half, (0.5,))])
    assert "--problems 1 --family shelf --seeds 1 --rows 'Ours'\n" in page.markdown


@pytest.mark.parametrize(
    ("parts", "name"),
    [
        ({"encoder": "points", "denoiser": "cross_attention"}, paper.WITHOUT_CLEARANCES),
        ({"waypoints": 254, "encoder": "compression_autoencoder"}, paper.AS_IN_PAPER),
    ],
)
def test_the_row_of_weights_says_what_they_are(parts: dict[str, Any], name: str, tmp_path: Path) -> None:
    defaults = {"encoder_settings": ENCODERS.defaults(parts["encoder"])}
    if "denoiser" in parts:
        defaults["denoiser_settings"] = DENOISERS.defaults(parts["denoiser"])
    settings = MotionModelSettings(**parts, **defaults)
    about = {"format": FORMAT, "settings": settings.to_json(), "training": {"samples": 800_000.0}}
    (tmp_path / "model.json").write_text(json.dumps(about))
    guided, unguided = paper.Table1Settings(tmp_path, paper_weights=str(tmp_path)).rows[5:7]
    name = f"{name}: {parts['encoder']}, {settings.denoiser}, 50 % of 1.6 M samples"
    assert guided == paper.Row(name, f"diffusion@{tmp_path}:samples=1:repeat=false")
    assert unguided == paper.Row(f"{name}, no guidance", f"diffusion@{tmp_path}:samples=1:guidance_steps=0:repeat=false")


@pytest.mark.slow
def test_a_small_page_is_made_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ours = paper.Row(paper.ROWS[4].name, "straight_line", paper.PAPER_METHOD)
    monkeypatch.setattr(paper, "ROWS", (ours, paper.Row("nearest", "straight_line:goals=nearest")))
    command = ["reproduce", "table1", "--out", str(tmp_path), "--problems", "3", "--time-limit", "2"]
    assert main(command) == 0 and main(command) == 0
    assert [len(records) for records in read_records(tmp_path).values()] == [6, 6]
    page = (tmp_path / "table1.md").read_text()
    assert "Goal: a pose with ten configurations; 3 non-trivial problems" in page
    assert "Trivial problems, in which the straight line" in page
    assert "| nearest" in page and "14.218" in page


def test_both_goals_are_of_one_problem() -> None:
    drawn = paper.draw_problem(3)
    pose, joint = drawn[paper.POSE], drawn[paper.JOINT]
    assert isinstance(pose.goal, rd.PoseGoal)
    np.testing.assert_array_equal(pose.start, joint.start)
    assert goal_error(pose.robot, pose.goal, paper.goal_configurations(joint)[0]) is None
    several = paper.goal_configurations(pose)
    assert 2 <= len(several) <= 10
    assert all(goal_error(pose.robot, pose.goal, q) is None for q in several)
    lengths = [length for length in paper.free_lines(pose, several) if length is not None]
    assert lengths == sorted(lengths)


def test_problems_are_written_once(tmp_path: Path) -> None:
    said: list[str] = []
    paper.write_problems(tmp_path, 2, said.append)
    before = paper.problem_file(tmp_path, paper.POSE).read_bytes()
    paper.write_problems(tmp_path, 2, said.append)
    assert len(said) == 1 and paper.problem_file(tmp_path, paper.POSE).read_bytes() == before
    cases = CaseFile(paper.problem_file(tmp_path, paper.POSE)).cases()
    assert len(cases) == 2 and not any(case.trivial for case in cases)
    for case in cases:
        assert not any(paper.free_lines(case.problem, paper.goal_configurations(case.problem)))
    numbers = [int(case.name.removeprefix("rop_pose/")) for case in cases]
    assert numbers == sorted(numbers)
    assert paper.trivial_share(tmp_path, paper.POSE) == 1 - 2 / (numbers[1] + 1)


@pytest.mark.parametrize("name", CONFIGS)
def test_every_config_makes_a_model(name: str) -> None:
    given = {"data": "data"} if "encoder" in CONFIGS[name].changes else {"data": "data", "encoder": "folder"}
    settings = planner_training(name, given)
    encoder = settings.encoder if settings.jointly else "compression_autoencoder"
    made = None if settings.encoder is None else make_encoder(encoder or "")
    model = MotionNetwork(RobotIdentity.of(rd.load_robot("panda")), model_settings(settings, made))
    assert isinstance(model.denoiser, DENOISERS.load(settings.denoiser))
    assert (settings.minutes is None) != (settings.samples is None)


def test_what_is_given_beside_a_config_wins() -> None:
    settings = planner_training("paper", {"data": "d", "encoder": "e", "minutes": 3.0, "batch": 8})
    assert (settings.minutes, settings.samples, settings.batch) == (3.0, None, 8)
    refuses("table2_unet", planner_training, "papr", {"data": "d", "encoder": "e"})
    refuses("config compact needs an encoder", planner_training, "compact", {"data": "d"})


def test_bad_input(tmp_path: Path, said: Said) -> None:
    base = ["reproduce", "table2", "--data", tmp_path, "--out", tmp_path / "out"]
    assert "known: " in said(2, *base, "--rows", "Ourz")
    assert "known: cabinet, clutter, crate" in said(2, *base, "--family", "ropp")
    assert "no data set" in said(2, *base)
    assert "is an input of this command" in said(2, *base[:-1], tmp_path)
    for part in ("table1", "figures"):
        options = ("--out", tmp_path / "out", "--workers", "2", "--cluster", "ray")
        assert "--workers cannot be combined with --cluster" in said(2, "reproduce", part, *options)
    assert not (tmp_path / "out").exists()


def test_the_mean_of_two_trainings_leaves_unsolved_problems_out() -> None:
    def evaluation(single: list[float], length: list[float]) -> ablation.Evaluation:
        each = np.array(single, float)
        return ablation.Evaluation(each, each, each, np.array(length, float), each)

    nan = float("nan")
    mean = ablation.Evaluation.mean([evaluation([0, 1, 0], [nan, 4, nan]), evaluation([1, 1, 0], [3, 6, nan])])
    np.testing.assert_array_equal(mean.single, [0.5, 1, 0])
    np.testing.assert_array_equal(mean.length, [3, 5, nan])
    assert [ablation.Training("table2_jpc", seed).folder for seed in (0, 1)] == ["table2_jpc", "table2_jpc_seed1"]
