"""RecordedExplorer: times, cameras, and what was known after each view."""

from itertools import pairwise

import numpy as np

from helpers.explorations import FLOOR, ZONE, recorded
from robotdiffuse import Explorer, Scene


def test_steps_and_views_are_kept_with_their_times() -> None:
    problem, explorer = recorded()
    acts = explorer.acts
    views = explorer.views
    assert len(acts) >= 2 and acts[-1].step.motion is None
    np.testing.assert_array_equal(acts[0].configuration, problem.start)
    for before, after in pairwise(acts):
        assert after.begins == before.begins + before.duration
        assert before.trajectory is not None
        np.testing.assert_allclose(before.trajectory.positions[-1], after.configuration, atol=1e-9)
    assert explorer.duration == acts[-1].begins
    times = [view.time for view in views]
    assert times == sorted(times) and times[-1] == explorer.duration
    for view in views:
        if view.act >= 0:
            act = acts[view.act]
            assert act.begins < view.time <= act.begins + act.duration
    assert [view.camera for view in views[:2]] == [None, 0], "the camera beside the arm, then that on it"
    looks = [act for act in acts if act.step.kind == "look"]
    assert looks and all(act.T_base_camera is not None for act in looks)
    assert all(act.T_base_camera is None for act in acts if act.step.kind != "look")


def test_what_was_known_is_the_map_of_the_views_until_then() -> None:
    problem, explorer = recorded()
    again = Explorer(problem.robot, explorer.cameras, Scene([FLOOR]), ZONE)
    for view in explorer.views[:3]:
        again.observe(view.view)
        np.testing.assert_array_equal(view.occupied, again.map.occupied)
        np.testing.assert_array_equal(view.free, again.map.free)
        np.testing.assert_array_equal(view.unknown, again.map.unknown)
