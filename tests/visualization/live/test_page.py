"""The page in a real browser: clicks, drags, and what it shows."""

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import robotdiffuse as rd
from helpers.browsers import MARKS, opened
from helpers.waiting import until
from robotdiffuse.core.transforms import rotation_from_quaternion, transform
from robotdiffuse.visualization.live import session as live

pytest.importorskip("viser", reason="the page needs viser: pip install 'robotdiffuse[live]'")

from robotdiffuse.visualization.live.page import Page
from robotdiffuse.visualization.live.server import PageServer, free_port

VALID = "[data-validity=valid]"
pytestmark = MARKS


@pytest.fixture(scope="module")
def page() -> Iterator[Page]:
    server = PageServer("127.0.0.1", free_port("127.0.0.1", 0))
    page = Page(live.Session(live.first_problem(None, None), live.PageOptions("aorrtc", 10.0)), server)
    until(lambda: page.session.state.motion is not None)
    yield page
    page.close()


@pytest.fixture(scope="module")
def view(page: Page) -> Iterator[Any]:
    """A browser with the open page and a valid motion."""
    with opened(page.server.url, height=500) as view:
        view.locator(VALID).wait_for()
        yield view


def beside(view: Any, label: str) -> Any:
    """The input field with this label."""
    return view.get_by_text(label, exact=True).locator("xpath=following::input[not(@type='hidden')][1]")


def test_an_obstacle_in_the_way_turns_it_red_and_the_next_plan_green(view: Any, page: Page) -> None:
    session = page.session
    beside(view, "Plan automatically").uncheck(force=True)
    until(lambda: not session.state.options.follow)
    view.get_by_role("tab", name="Obstacles").click()
    view.get_by_role("button", name="Add").click()
    view.get_by_role("button", name="Delete").wait_for()
    motion = session.state.motion
    assert motion is not None and motion.trajectory is not None
    q = motion.trajectory.positions[len(motion.trajectory.times) // 2]
    hand = transform(session.state.problem.robot.fk(q, "panda_hand")[:3, 3])
    session.change_obstacle("sphere", lambda shape: live.moved_to(shape, hand))
    red = view.locator("[data-validity=invalid]")
    red.wait_for()
    assert "inside sphere" in red.inner_text() and "at 0." in red.inner_text()
    assert session.state.motion is motion
    session.change_obstacle("sphere", lambda shape: live.moved_to(shape, transform(np.array([-0.5, 0.0, 1.2]))))
    view.locator(VALID).wait_for()
    view.get_by_role("button", name="Delete").click()
    until(lambda: all(shape.name != "sphere" for shape in session.state.problem.scene.shapes))
    session.set_options(follow=True)
    until(lambda: session.state.answer is not None)


def test_a_size_is_typed_beside_its_slider(view: Any, page: Page) -> None:
    view.get_by_role("tab", name="Obstacles").click()
    page.select("ball")
    entry = beside(view, "radius")
    entry.fill("0.05")
    entry.press("Enter")
    until(lambda: page.session.state.obstacles["ball"].radius == 0.05)  # type: ignore[attr-defined]
    page.select("")


def test_the_target_is_dragged(view: Any, page: Page) -> None:
    """Drags the target by an arrow of its gizmo."""
    before = page.session.state.goal_pose.copy()
    dragged = any(drag_arrow(view, page, before, axis) for axis in (2, 0, 1))
    assert dragged and isinstance(page.session.state.problem.goal, rd.PoseGoal)
    page.session.move_goal(before)
    until(lambda: page.session.state.answer is not None)
    view.locator(VALID).wait_for()


def drag_arrow(view: Any, page: Page, T: np.ndarray, axis: int) -> bool:
    """Whether the target follows when the mouse drags an arrow of its gizmo, which may point at the camera."""
    arrow = page.goal_gizmo.handle.scale * T[:3, axis]
    view.mouse.move(*on_screen(view, page, T[:3, 3] + 0.7 * arrow))
    time.sleep(0.1)
    view.mouse.down()
    view.mouse.move(*on_screen(view, page, T[:3, 3] + 0.9 * arrow), steps=4)
    view.mouse.up()
    time.sleep(0.3)
    return not np.array_equal(page.session.state.goal_pose, T)


def on_screen(view: Any, page: Page, point: np.ndarray) -> tuple[float, float]:
    """Pixel of a point [m], computed from the camera that the browser reports."""
    [client] = page.server.get_clients().values()
    camera = client.camera
    x, y, z = rotation_from_quaternion(np.array(camera.wxyz)).T @ (point - camera.position)
    size = view.viewport_size
    focal = 0.5 * size["height"] / np.tan(0.5 * camera.fov)
    return 0.5 * size["width"] + focal * x / z, 0.5 * size["height"] + focal * y / z


def test_the_trees_of_the_search_are_drawn_when_asked_for(view: Any, page: Page) -> None:
    drawn = page.server.scene._handle_from_node_name
    answer = page.session.state.answer
    view.get_by_role("tab", name="Plan").click()
    box = beside(view, "Search trees")
    box.check(force=True)
    until(lambda: {"/trees/start", "/trees/goal"} <= drawn.keys())
    box.uncheck(force=True)
    until(lambda: not {"/trees/start", "/trees/goal"} & drawn.keys())
    assert answer is not None and len(answer.trees) == 2
    assert page.session.state.answer is answer, "drawing them is no reason to plan"


def test_it_plays_and_is_scrubbed(view: Any, page: Page) -> None:
    view.get_by_role("button", name="Play").click()
    until(lambda: page.player.playing and page.player.time > 0)
    view.get_by_role("button", name="Pause").click()
    view.get_by_role("button", name="Play").wait_for()
    entry = beside(view, "Time")

    def scrubbed() -> bool:
        entry.fill("0.5")
        entry.press("Enter")
        view.wait_for_timeout(300)
        return page.player.time == 0.5

    until(scrubbed)  # a time that the page receives late replaces what is typed
    assert not page.player.playing


def test_files_are_loaded_and_saved_and_broken_ones_are_a_note(view: Any, page: Page, tmp_path: Path) -> None:
    session = page.session
    view.get_by_role("tab", name="Files").click()
    with view.expect_download() as saved:
        view.get_by_role("button", name="Save problem").click()
    assert Path(saved.value.path()).read_bytes() == live.problem_text(session.state.problem)
    with view.expect_download() as saved:
        view.get_by_role("button", name="Save replay").click()
    assert b"shelf" not in Path(saved.value.path()).read_bytes()[:100]
    assert Path(saved.value.path()).read_bytes().startswith(b"<!doctype html>")
    before = session.state.problem
    upload = view.locator("input[type=file]")
    upload.set_input_files({"name": "broken.yaml", "mimeType": "text/yaml", "buffer": b"robot: panda\nscene: 3\n"})
    view.get_by_text("broken.yaml: problem has no start").wait_for()
    assert session.state.problem is before
    other = live.problem_text(live.first_problem(None, "ur5e"))
    upload.set_input_files({"name": "other.yaml", "mimeType": "text/yaml", "buffer": other})
    until(lambda: session.state.problem.robot.name == "ur5e" and session.state.answer is not None)
    view.locator(VALID).wait_for()


def test_it_comes_back_after_the_server_restarts(view: Any, page: Page) -> None:
    problem = page.session.state.problem
    view.set_viewport_size({"width": 500, "height": 400})
    number = 0
    for planner in ("aorrtc", "rrt_connect"):
        server = PageServer("127.0.0.1", free_port("127.0.0.1", number))
        page = Page(live.Session(problem, live.PageOptions(planner, 10.0)), server)
        if not number:
            number = server.get_port()
            view.goto(server.url)
        until(lambda: beside(view, "Planner").input_value() == planner)  # noqa: B023
        until(lambda: view.locator(VALID).is_visible())
        page.close()
