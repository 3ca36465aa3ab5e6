"""Scenes packed in arrays: round trips, floors stored separately."""

import numpy as np
import pytest

from helpers.refusals import refuses
from robotdiffuse import Box, Capsule, Cylinder, Scene
from robotdiffuse.problems.families.rop import ROP_DENSE
from robotdiffuse.scenes.scene_arrays import PackedScenes

FLOOR = Box([0, 0, -0.05], [2, 2, 0.1], name="floor")


def some_scenes(n: int, seed: int = 5) -> list[Scene]:
    """Dense scenes with a floor, with all boxes turned at random."""
    rng = np.random.default_rng(seed)
    scenes = []
    for _ in range(n):
        shapes = ROP_DENSE.scene(rng).shapes[1:]
        turned = [Box(s.center, s.size, rng.normal(size=4)) if isinstance(s, Box) else s for s in shapes]
        scenes.append(Scene([FLOOR, *turned]))
    return scenes


@pytest.mark.parametrize("floor", [True, False])
def test_scenes_come_back(floor: bool) -> None:
    scenes = some_scenes(4)
    packed = PackedScenes.pack(scenes, 13, floor)
    assert packed.kinds.shape == (4, 13) and packed.params.shape == (4, 13, 10)
    back = [packed.scene(i) for i in range(4)]
    for scene, again in zip(scenes, back, strict=True):
        assert [type(shape) for shape in scene.shapes] == [type(shape) for shape in again.shapes]
        assert isinstance(again.shapes[0], Box) and again.shapes[0].bounds[1, 2] == pytest.approx(0, abs=1e-8)
    twice = PackedScenes.pack(back, 13, floor)
    assert (twice.kinds == packed.kinds).all()
    # unpacking makes a quaternion of float32 one of length 1 in float64
    np.testing.assert_allclose(twice.params, packed.params, atol=1e-7)
    if floor:
        assert back[0].shapes[0].name == "floor" and (twice.floors == packed.floors).all()


def test_rows_and_parts() -> None:
    scenes = some_scenes(5)
    packed = PackedScenes.pack(scenes, 12, floor=True)
    parts = PackedScenes.joined([packed[3:], packed[np.array([0, 2, 1])]])
    assert len(parts) == 5
    for i, j in enumerate((3, 4, 0, 2, 1)):
        np.testing.assert_array_equal(parts.params[i], packed.params[j])
        assert len(parts.scene(i).shapes) == len(scenes[j].shapes)
    without = PackedScenes(packed.kinds, packed.params)
    assert PackedScenes.joined([without[:2], without[2:]]).floors is None
    assert without.floor(0) is None and len(without.scene(0).shapes) == len(scenes[0].shapes) - 1
    assert packed.floors is not None
    packed.floors[0] = 0
    assert packed.floor(0) is None and packed.floor(1) is not None


def test_what_cannot_be_packed() -> None:
    (scene,) = some_scenes(1)
    refuses("2 slots", PackedScenes.pack, [scene], 2)
    refuses("cylinder", PackedScenes.pack, [Scene([Cylinder([0, 0, 0], 1, 1)])], 2)
    for floor in (Capsule([0, 0, 0], 1, 1), Box([0, 0, 0], [1, 1, 1], [1, 1, 0, 0])):
        refuses(f"is a {floor.kind}; it must be a box without rotation", PackedScenes.pack, [Scene([floor])], 2, floor=True)
