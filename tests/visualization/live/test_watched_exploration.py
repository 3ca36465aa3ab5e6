"""The page of an exploration in a real browser: what it shows while the arm moves, and its buttons."""

from collections.abc import Iterator
from typing import Any

import pytest

import robotdiffuse as rd
from helpers.browsers import MARKS, opened
from helpers.explorations import BEYOND, FLOOR, HOME, WALL
from helpers.waiting import until

pytest.importorskip("viser", reason="the page needs viser: pip install 'robotdiffuse[live]'")

from robotdiffuse.visualization.live import exploration as live
from robotdiffuse.visualization.live.server import PageServer, free_port

pytestmark = MARKS


@pytest.fixture
def view() -> Iterator[tuple[Any, live.ExplorationSession, dict[str, Any]]]:
    """A browser at the page, the session, and the drawn objects by name."""
    problem = rd.Problem(rd.load_robot("panda"), rd.Scene([FLOOR, WALL]), HOME, BEYOND)
    session = live.ExplorationSession(problem, rd.ExplorerSettings(time_limit=5.0), False, 0, speed=0.1)
    page = live.ExplorationPage(session, PageServer("127.0.0.1", free_port("127.0.0.1", 0)))
    with opened(page.server.url) as view:
        yield view, session, page.server.scene._handle_from_node_name
    page.close()


def test_people_watch_pause_go_on_and_restart(view: Any) -> None:
    page, session, drawn = view
    until(lambda: session.state.phase == live.MOVING)  # it runs since the page was opened
    session.set_mode(live.PAUSED)
    [record] = session.state.steps
    page.get_by_text(f"1. {record.step.kind}").first.wait_for()
    page.get_by_text("of the map").wait_for()
    of_a_look = {"/pyramid", "/wanted"} if record.step.wanted is not None else set()
    until(lambda: {"/occupied", "/unknown", "/trace"} | of_a_look <= drawn.keys())
    beside = "xpath=following::input[not(@type='hidden')][1]"
    page.get_by_text("Unknown space", exact=True).locator(beside).uncheck(force=True)
    until(lambda: "/unknown" not in drawn)
    page.get_by_text("Unknown space", exact=True).locator(beside).check(force=True)
    until(lambda: "/unknown" in drawn)
    page.get_by_role("button", name="Run").click()
    page.get_by_role("button", name="Pause").click()
    until(lambda: session.state.mode == live.PAUSED)
    session.set_speed(10.0)
    page.get_by_role("button", name="Run").click()
    until(lambda: session.state.phase == live.ENDED)
    page.locator("[data-validity=valid], [data-validity=none]").wait_for()
    page.get_by_role("button", name="Restart").click()
    until(lambda: session.state.phase != live.ENDED)
    page.get_by_text("Noise", exact=True).locator(beside).check(force=True)
    until(lambda: session.state.noise and session.state.steps)  # a step of any kind
    assert session.state.mode == live.RUNNING
