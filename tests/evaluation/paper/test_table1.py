"""Table 1: its ComScores by hand, its rows, and a page from a run that a second call does not repeat."""

import json
from pathlib import Path

import pytest

from robotdiffuse.cli import main
from robotdiffuse.core.errors import InputError
from robotdiffuse.evaluation.paper import table1
from robotdiffuse.evaluation.paper.comscore import PAPER_TABLE_1, Indicators, comscores
from robotdiffuse.evaluation.paper.table1 import ROWS, Row, Table1Settings
from robotdiffuse.evaluation.records import Record, read_records
from robotdiffuse.learning.denoisers import CrossAttentionSettings
from robotdiffuse.learning.encoders import CompressionAutoencoderSettings, PointsSettings
from robotdiffuse.learning.motion_model import MotionModelSettings
from robotdiffuse.learning.weight_files import FORMAT
from robotdiffuse.learning.weights_registry import BUNDLED

ROW_NAMES = {row.paper: row.name for row in ROWS if row.paper}


def test_scores_are_the_papers_and_further_rows_replace_its_method() -> None:
    of = {ROW_NAMES[row.name]: row.indicators for row in PAPER_TABLE_1}
    printed = comscores([row.indicators for row in PAPER_TABLE_1])
    further = Indicators(100.0, 0.0, 14.0, 1.0)
    found = table1.scores(ROWS, of | {"aorrtc": further})
    for row, score in zip(PAPER_TABLE_1, printed, strict=True):
        assert found[ROW_NAMES[row.name]] == pytest.approx(score)
    assert found["aorrtc"] == 1.0  # the best in all four


def test_indicators_of_solved_and_refused_calls() -> None:
    def record(status: str, refused: str = "", **measures: float) -> Record:
        return Record("p", "s", "n", "f", False, 0, 2.0, status, "", 0.5, refused=refused, measures=measures)

    records = [
        record("solved", link_length=4.0),
        record("solved", link_length=6.0),
        record("timeout", "scene_collision"),
        record("timeout"),
    ]
    assert table1.indicators(records) == Indicators(50.0, 25.0, 5.0, 0.5)


def test_the_papers_method_has_a_row_only_with_weights_that_see_the_code_alone(tmp_path: Path) -> None:
    assert Table1Settings(tmp_path).rows == ROWS
    with_weights = Table1Settings(tmp_path, paper_weights=str(BUNDLED / "panda"))
    with pytest.raises(InputError, match="whose inputs include clearances"):
        table1.run_table1(with_weights, lambda _: None, lambda *_: None)
    assert table1.NO_WEIGHTS in table1.notes(Table1Settings(tmp_path))


@pytest.mark.parametrize(
    ("settings", "name"),
    [
        (
            MotionModelSettings(
                encoder="points",
                encoder_settings=PointsSettings(),
                denoiser="cross_attention",
                denoiser_settings=CrossAttentionSettings(),
            ),
            f"{table1.WITHOUT_CLEARANCES}: points, cross_attention, 50 % of 1.6 M samples",
        ),
        (
            MotionModelSettings(
                waypoints=254,
                encoder="compression_autoencoder",
                encoder_settings=CompressionAutoencoderSettings(),
            ),
            f"{table1.AS_IN_PAPER}: compression_autoencoder, transformer, 50 % of 1.6 M samples",
        ),
    ],
)
def test_the_row_of_weights_says_what_they_are(
    settings: MotionModelSettings, name: str, tmp_path: Path
) -> None:
    about = {"format": FORMAT, "settings": settings.to_json(), "training": {"samples": 800_000.0}}
    (tmp_path / "model.json").write_text(json.dumps(about))
    row = Table1Settings(tmp_path, paper_weights=str(tmp_path)).rows[5]
    assert row == Row(name, f"diffusion@{tmp_path}:samples=1:guidance_steps=0:repeat=false")


def test_weights_of_the_package_are_named_without_their_folder(tmp_path: Path) -> None:
    row = Table1Settings(tmp_path, paper_weights="panda_points").rows[5]
    assert row.name.startswith(f"{table1.WITHOUT_CLEARANCES}: points, cross_attention")


@pytest.mark.slow
def test_a_small_page_is_made_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lines = Row(ROWS[4].name, "straight_line", table1.OURS), Row("nearest", "straight_line:goals=nearest")
    monkeypatch.setattr(table1, "ROWS", lines)
    command = ["reproduce", "table1", "--out", str(tmp_path), "--problems", "3", "--time-limit", "2"]
    assert main(command) == 0 and main(command) == 0
    assert [len(records) for records in read_records(tmp_path).values()] == [6, 6]
    page = (tmp_path / "table1.md").read_text()
    assert "Goal: a pose with ten configurations; all problems: 3" in page
    assert "| nearest" in page and "14.218" in page
