"""Simulated errors of depth cameras, by their statistics."""

from dataclasses import replace

import numpy as np
import pytest

from robotdiffuse import DepthView, InputError
from robotdiffuse.perception.depth_view import DepthNoise


def test_noise_is_as_its_settings_say() -> None:
    rng = np.random.default_rng(1)
    none = DepthNoise(0.0, 0.0, 0.0, 0.0, 0.0, grazing=0.0)
    depth = np.full((200, 300), 2.0, np.float32)
    depth[:, 150:] = 1.0
    depth[:20] = np.inf
    view = DepthView(depth, (300.0, 300.0, 150.0, 100.0), np.eye(4))
    noisy = replace(none, spread=0.003, missing=0.05).applied(view, rng).depth
    missing = noisy == 0
    near = noisy[20:, 150:]
    far = noisy[20:, :150]
    assert abs(missing.mean() - 0.05) < 0.005
    for part, at in ((near[near > 0], 1.0), (far[far > 0], 2.0)):
        assert abs(part.std() / (0.003 * at**2) - 1) < 0.03 and abs(part.mean() - at) < 1e-3
    assert not np.isfinite(noisy[:20][~missing[:20]]).any()
    flying = replace(none, flying=0.4).applied(view, rng).depth[20:]
    between = (flying > 1.001) & (flying < 1.999)
    assert not np.delete(between, 149, axis=1).any() and 0.3 < between[:, 149].mean() < 0.5
    same = none.applied(view, rng).depth
    np.testing.assert_array_equal(same, depth)
    with pytest.raises(InputError, match="missing is 1"):
        DepthNoise(missing=1.0)


def test_stray_pixels_lie_before_the_surface() -> None:
    view = DepthView(np.full((200, 300), 2.0), (300.0, 300.0, 150.0, 100.0), np.eye(4))
    noisy = DepthNoise(spread=0.0, stray=0.1).applied(view, np.random.default_rng(0)).depth
    stray = noisy < 2.0
    assert abs(stray.mean() - 0.1) < 0.01 and (noisy > 0).all()


@pytest.mark.parametrize("angle", (0.1, 0.25))
def test_a_floor_at_a_grazing_angle_gives_no_return(angle: float) -> None:
    """A floor 1 m below a camera that looks ahead: a row sees it at its angle below the horizon."""
    focal = 200.0
    rows = np.arange(1, 150)
    depth = np.broadcast_to((focal / rows)[:, None], (len(rows), 40))
    view = DepthView(depth, (focal, focal, 20.0, -1.0), np.eye(4))
    noise = DepthNoise(spread=0.0, stray=0.0, flying=0.0, edge_missing=0.0, grazing=angle)
    seen = np.asarray((noise.applied(view, np.random.default_rng(0)).depth > 0).all(axis=1))
    expected = np.asarray(np.arctan(rows / focal) > angle)
    assert (seen[5:-5] == expected[5:-5]).mean() > 0.97, "differences of pixels, not derivatives"
