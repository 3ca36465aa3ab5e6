"""Transforms over time: chains, interpolation, and what is missing."""

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from robotdiffuse.core.errors import InputError
from robotdiffuse.interop.depth_recording import TransformHistory


def message(parent: str, child: str, at: float, turn: float = 0.0, x: float = 0.0) -> dict[str, Any]:
    """A transform with a turn about z."""
    stamp = {"sec": int(at), "nanosec": round(1e9 * (at % 1))}
    rotation = {"x": 0.0, "y": 0.0, "z": np.sin(turn / 2), "w": np.cos(turn / 2)}
    place = {"translation": {"x": x, "y": 0.0, "z": 0.0}, "rotation": rotation}
    return {"header": {"stamp": stamp, "frame_id": parent}, "child_frame_id": child, "transform": place}


def history() -> TransformHistory:
    """A link that turns by 1 rad in 0.1 s, logged in the wrong order, and a camera fixed to it."""
    out = TransformHistory()
    out.add(message("base", "link", 5.1, 1.0), static=False)
    out.add(message("base", "link", 5.0, 0.0), static=False)
    out.add(message("/link", "/camera", 0.0, x=2.0), static=True)
    return out


@pytest.mark.parametrize("share", (0.0, 0.25, 1.0))
def test_chains_are_followed_and_interpolated(share: float) -> None:
    T = history().at("base", "camera", 5.0 + 0.1 * share, 0.1, "the image")
    np.testing.assert_allclose(T[:3, :3], Rotation.from_rotvec([0, 0, share]).as_matrix(), atol=1e-6)
    np.testing.assert_allclose(T[:3, 3], [2 * np.cos(share), 2 * np.sin(share), 0.0], atol=1e-6)


def test_the_nearest_transform_counts_at_the_ends() -> None:
    T = history().at("base", "link", 5.15, 0.1, "the image")
    np.testing.assert_allclose(T[:3, :3], Rotation.from_rotvec([0, 0, 1.0]).as_matrix(), atol=1e-6)


def test_what_is_missing_is_said() -> None:
    with pytest.raises(InputError, match=r"no transform of link within 0\.1 s of the image"):
        history().at("base", "camera", 6.0, 0.1, "the image")
    with pytest.raises(InputError, match=r"no transforms lead from world to camera.*lead to link, base"):
        history().at("world", "camera", 5.0, 0.1, "the image")
    circle = history()
    circle.add(message("camera", "base", 5.0), static=True)
    with pytest.raises(InputError, match="no transforms lead from world"):
        circle.at("world", "camera", 5.0, 0.1, "the image")
    bad = message("base", "link", 5.0)
    bad["transform"]["rotation"] = dict.fromkeys("xyzw", 0.0)
    with pytest.raises(InputError, match="the transform of link has the rotation"):
        circle.add(bad, static=False)
