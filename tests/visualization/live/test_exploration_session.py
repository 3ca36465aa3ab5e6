"""The exploration of the live page, without a browser: single steps, pauses, restarts and errors."""

import time
from collections.abc import Iterator
from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest

import robotdiffuse as rd
from helpers.explorations import BEYOND, FLOOR, HOME, WALL
from helpers.waiting import state_when, until
from robotdiffuse.planning.exploration.steps import DONE, LOOK

pytest.importorskip("viser", reason="the page needs viser: pip install 'robotdiffuse[live]'")

from helpers.refusals import refuses
from robotdiffuse.visualization.live import exploration as live
from robotdiffuse.visualization.live.session import NO_MOTION, VALID

SETTINGS = rd.ExplorerSettings(time_limit=20.0, look_attempts=2, max_views=2)
"""A time limit so long that other work on the machine changes no step."""


@pytest.fixture
def session() -> Iterator[live.ExplorationSession]:
    problem = rd.Problem(rd.load_robot("panda"), rd.Scene([FLOOR, WALL]), HOME, BEYOND)
    session = live.ExplorationSession(problem, SETTINGS, noise=False, seed=0, speed=1000.0)
    yield session
    session.close()


@pytest.mark.slow
def test_it_goes_one_step_and_then_to_the_end(session: live.ExplorationSession) -> None:
    seen: list[live.ExplorationState] = []
    session.on_change = lambda: seen.append(session.state)
    assert session.state.phase == live.WAITING and session.state.known is None
    assert live.exploration_badge(session.state).headline == "not begun"
    session.set_mode(live.STEPPING)
    state = state_when(session, lambda state: state.steps and state.phase == live.WAITING)
    [record] = state.steps
    assert record.trajectory is not None and state.mode == live.PAUSED
    np.testing.assert_allclose(state.configuration, record.trajectory.positions[-1], atol=1e-9)
    if record.step.kind == LOOK:
        assert record.step.wanted is not None and record.step.wanted.any()
    badge = live.exploration_badge(replace(state, phase=live.MOVING))
    assert badge.headline.startswith("1. ") and badge.lines[0] == record.step.reason
    assert badge.lines[-1].startswith("of the map ")
    session.set_mode(live.RUNNING)
    state = state_when(session, lambda state: state.phase == live.ENDED)
    assert live.exploration_badge(state).kind == (VALID if state.steps[-1].step.kind == DONE else NO_MOTION)
    assert not state.failure and not state.violation and state.steps[-1].step.motion is None
    assert {live.CHOOSING, live.MOVING} <= {one.phase for one in seen}
    assert state.known is state.explorer.views[-1]  # type: ignore[union-attr]


def test_a_pause_holds_the_arm_and_a_restart_begins_anew(session: live.ExplorationSession) -> None:
    session.set_speed(0.2)
    session.set_mode(live.RUNNING)
    state_when(session, lambda state: state.phase == live.MOVING and (state.configuration != HOME).any())
    session.set_mode(live.PAUSED)

    def rests() -> bool:
        held = session.state.configuration
        time.sleep(0.2)
        return session.state.configuration is held

    until(rests)  # after the frame that was being computed
    assert session.state.phase == live.MOVING
    refuses(r"unknown explorer\.policy 'bold'", session.restart, policy="bold")
    session.restart(policy="probabilistic", noise=True)
    assert session.state.configuration.tolist() == HOME.tolist() and not session.state.steps
    assert (session.state.settings.policy, session.state.noise) == ("probabilistic", True)
    state = state_when(session, lambda state: state.explorer is not None and state.phase == live.WAITING)
    assert state.explorer is not None and state.explorer.settings.policy == "probabilistic"


def test_an_error_is_shown_and_a_restart_helps(session: live.ExplorationSession, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(live, "simulated_explorer", Mock(side_effect=ValueError("no camera")))
        session.set_mode(live.RUNNING)
        state = state_when(session, lambda state: state.phase == live.ENDED)
        assert live.exploration_badge(state).lines == ("ValueError: no camera",)
    session.restart()
    state_when(session, lambda state: state.steps)
