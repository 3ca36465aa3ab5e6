"""Drawings of explorations: their moments, faces of voxels, the strip of pictures, and the page, also in a browser."""

import base64
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from helpers.browsers import CHROMIUM, opened, page_data
from helpers.explorations import FLOOR, recorded
from helpers.refusals import refuses
from robotdiffuse.perception.voxel_grid import MAP
from robotdiffuse.visualization import exploration
from robotdiffuse.visualization.picture import PictureSettings


def test_a_cube_has_six_faces_around_it() -> None:
    inside = np.zeros((4, 5, 6), np.bool_)
    inside[1, 2, 3] = True
    numbers, first = exploration.faces_between(inside, ~inside)
    size = inside.size
    at = (1 * 5 + 2) * 6 + 3
    assert numbers.tolist() == [at - 30, at, size + at - 6, size + at, 2 * size + at - 1, 2 * size + at]
    assert first.tolist() == [False, True] * 3
    outside = np.zeros_like(inside)
    outside[0, 2, 3] = True
    assert exploration.faces_between(inside, outside)[0].tolist() == [at - 30], "between the two sets alone"
    surface = exploration.faces_surface(inside, ~inside, (255, 0, 0))
    away = surface.vertices - np.array([1.5, 2.5, 3.5]) * MAP.edge - MAP.low
    np.testing.assert_allclose(np.abs(away), MAP.edge / 2)
    np.testing.assert_allclose((away * surface.normals).sum(axis=1), MAP.edge / 2)
    assert len(surface.faces) == 12 and (surface.colors == [1, 0, 0]).all()


@pytest.mark.usefixtures("small_pictures")
@pytest.mark.slow
def test_each_moment_has_a_picture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    problem, explorer, _ = recorded()
    monkeypatch.setattr(exploration, "TILE", PictureSettings(width=240, height=150, ghosts=1))
    exploration.write_exploration_picture(explorer, problem.scene, tmp_path / "explore.png")
    count = len(explorer.steps)
    columns = min(count, 3 if count > 4 else 2)
    with Image.open(tmp_path / "explore.png") as image:
        width = columns * (240 + exploration.GAP) - exploration.GAP
        assert image.size == (width, -(-count // columns) * (150 + exploration.GAP) - exploration.GAP)
        first = np.asarray(image)[:100, :240].astype(int)
    assert (first[..., 2] > first[..., 0] + 25).sum() > 50, "the wall was seen"
    for write, ending in ((exploration.write_exploration_picture, "html"), (exploration.write_exploration, "png")):
        refuses(f"unknown ending '.{ending}'", write, explorer, problem.scene, tmp_path / f"explore.{ending}")


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    problem, explorer, _ = recorded()
    file = tmp_path_factory.mktemp("page") / "explore.html"
    exploration.write_exploration(explorer, problem.scene, file)
    return file


def numbers(text: str) -> list[int]:
    """The numbers that the page decodes: differences in groups of 7 bits, the lowest bits first."""
    out = []
    last = value = shift = 0
    for byte in base64.b64decode(text):
        value = value + ((byte & 127) << shift)
        shift = shift + 7
        if byte < 128:
            last += value
            out.append(last)
            value = shift = 0
    return out


def test_the_page_holds_what_was_known_at_each_time(page: Path) -> None:
    _, explorer, _ = recorded()
    data = page_data(page)
    told = data["exploration"]
    assert [shape["name"] for shape in data["scene"]] == [FLOOR.name]
    assert [shape["name"] for shape in told["true_scene"]] == ["floor", "wall"]
    assert len(told["steps"]) == len(explorer.steps)
    for number, (record, one) in enumerate(zip(explorer.steps, told["steps"], strict=True)):
        assert one["time"] == pytest.approx(record.begins + number * exploration.READING_TIME, abs=1e-3)
        assert one["title"].startswith(f"{number + 1}  ") and one["reason"] == record.step.reason
        assert bool(one["look"]) == (record.T_base_camera is not None) == (one["end"] is not None)
    reading = exploration.READING_TIME * (len(explorer.steps) - 1)
    assert data["times"][-1] == pytest.approx(explorer.duration + reading, abs=1e-3)
    times = [known["time"] for known in told["known"]]
    assert times == sorted(times) and times[0] == 0.0
    unknown: set[int] = set()
    for known in told["known"]:
        unknown ^= set(numbers(known["layers"][2]))
    last = explorer.views[-1]
    assert unknown <= set(exploration.faces_between(last.unknown, last.free)[0].tolist())
    assert len(unknown) > 1000, "the boundary of unknown space, without that at the known floor"


@pytest.mark.browser
@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium")
def test_a_browser_shows_the_steps(page: Path) -> None:
    _, explorer, _ = recorded()
    errors: list[str] = []
    with opened("about:blank", 480, 300) as shown:
        shown.on("pageerror", lambda error: errors.append(str(error)))
        shown.goto(f"{page.as_uri()}#at=1")
        rows = shown.evaluate("[...document.querySelectorAll('#steps li')].map((row) => row.ariaCurrent)")
        toggles = shown.evaluate("[...document.querySelectorAll('#toggles button')].map((b) => b.textContent)")
        pixels = shown.evaluate("layers.map((layer) => layer.meshes[0].geometry.index.count)")
    assert not errors and rows == ["false"] * (len(explorer.steps) - 1) + ["true"]
    assert toggles[:5] == ["Occupied", "Predicted", "Unknown", "Next view", "True scene"]
    assert np.array(pixels)[[0, 2]].min() > 6000


@pytest.mark.browser
@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium")
def test_buttons_leave_the_title_free_in_a_window_of_900_pixels(page: Path) -> None:
    with opened("about:blank", 900, 600) as shown:
        shown.goto(page.as_uri(), wait_until="commit")
        title = shown.locator("header").bounding_box()
        shown.wait_for_selector("#toggles button")
        assert title["x"] + title["width"] < shown.locator("#toggles").bounding_box()["x"]
