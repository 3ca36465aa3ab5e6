"""The moments of an exploration, and what is shown of each."""

from helpers.explorations import recorded
from robotdiffuse.visualization.exploration import frustum, in_known_scene, moments, shown_voxels, title


def test_moments_show_what_was_known_before_them() -> None:
    _, explorer = recorded()
    known = in_known_scene(explorer)
    found = moments(explorer)
    assert [moment.number for moment in found] == list(range(1, len(explorer.acts) + 1))
    for moment in found:
        assert moment.known.act < moment.number - 1 or moment.known.act == -1
        shown = shown_voxels(moment.known, moment.act, known)
        assert not (shown.occupied & known).any() and not (shown.predicted & ~shown.unknown).any()
        assert title(moment.act).startswith(
            {"done": "at the goal"}.get(moment.act.step.kind, moment.act.step.kind)
        )
        assert len(frustum(explorer, moment.act)) == (5 if moment.act.T_base_camera is not None else 0)
