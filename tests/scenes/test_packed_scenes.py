"""Scenes packed in arrays: round trips, floors stored separately; clouds made of them are uniform by area."""

import numpy as np
import pytest
import torch

import robotdiffuse as rd
from helpers.refusals import refuses
from helpers.sphere_oracles import distance
from robotdiffuse.core.transforms import rotation_from_quaternion
from robotdiffuse.datasets.surface_clouds import surface_clouds
from robotdiffuse.learning.training.batches import random_scenes
from robotdiffuse.problems.families.rop import ROP_DENSE
from robotdiffuse.scenes.packed_scenes import BOX, SPHERE, PackedScenes
from robotdiffuse.scenes.surface_points import PANDA_REGION


def dense_scenes(n: int, seed: int = 5) -> list[rd.Scene]:
    """Dense scenes with a floor, with all boxes turned at random."""
    rng = np.random.default_rng(seed)
    scenes = []
    for _ in range(n):
        shapes = ROP_DENSE.scene(rng).shapes[1:]
        turned = [rd.Box(s.center, s.size, rng.normal(size=4)) if isinstance(s, rd.Box) else s for s in shapes]
        scenes.append(rd.Scene([rd.Box([0, 0, -0.05], [2, 2, 0.1], name="floor"), *turned]))
    return scenes


@pytest.mark.parametrize("floor", [True, False])
def test_scenes_come_back(floor: bool) -> None:
    scenes = dense_scenes(4)
    packed = PackedScenes.pack(scenes, 13, floor)
    assert packed.kinds.shape == (4, 13) and packed.params.shape == (4, 13, 10)
    back = [packed.scene(i) for i in range(4)]
    for scene, again in zip(scenes, back, strict=True):
        assert [type(shape) for shape in scene.shapes] == [type(shape) for shape in again.shapes]
        assert isinstance(again.shapes[0], rd.Box) and again.shapes[0].bounds[1, 2] == pytest.approx(0, abs=1e-8)
    twice = PackedScenes.pack(back, 13, floor)
    assert (twice.kinds == packed.kinds).all()
    # unpacking makes a quaternion of float32 one of length 1 in float64
    np.testing.assert_allclose(twice.params, packed.params, atol=1e-7)
    if floor:
        assert back[0].shapes[0].name == "floor" and (twice.floors == packed.floors).all()


def test_rows_and_parts() -> None:
    scenes = dense_scenes(5)
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
    (scene,) = dense_scenes(1)
    refuses("2 slots", PackedScenes.pack, [scene], 2)
    refuses("cylinder", PackedScenes.pack, [rd.Scene([rd.Cylinder([0, 0, 0], 1, 1)])], 2)
    for floor in (rd.Capsule([0, 0, 0], 1, 1), rd.Box([0, 0, 0], [1, 1, 1], [1, 1, 0, 0])):
        refuses(f"is a {floor.kind}; it must be a box without rotation", PackedScenes.pack, [rd.Scene([floor])], 2, floor=True)


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def some_scenes(n: int, k: int, seed: int = 0):
    drawn = random_scenes(n, k, np.random.default_rng(seed))
    return PackedScenes(np.pad(drawn.kinds, [(0, 0), (1, 1)]), np.pad(drawn.params, [(0, 0), (1, 1), (0, 0)]))


def test_points_lie_on_surfaces():
    scenes = some_scenes(60, 6)
    clouds, again, other = (surface_clouds(scenes, 200, seeded(seed)) for seed in (0, 0, 1))
    assert clouds.shape == (60, 200, 3) and torch.equal(clouds, again) and not torch.equal(clouds, other)
    for i, cloud in enumerate(clouds.double().numpy()):
        shapes = scenes.scene(i).shapes
        if not shapes:
            assert not cloud.any()
        else:
            # float32 of coordinates of up to 1.5 m
            np.testing.assert_allclose(np.min([np.abs(distance(shape, cloud)) for shape in shapes], axis=0), 0, atol=1e-6)
    near = surface_clouds(scenes, 200, seeded(), region=PANDA_REGION).numpy()
    assert PANDA_REGION.holds(near[near.any((1, 2))]).all() and near.any((1, 2)).sum() > 20


def test_uniform_by_area():
    params = np.zeros((1, 3, 10), np.float32)
    params[0, 1] = [0.5, -0.3, 0.4, 0.2, 0.5, 0.3, 0.5, 0.5, -0.5, 0.5]
    params[0, 2, :4] = [-0.4, 0.2, 0.6, 0.15]
    n = 40_000
    cloud = surface_clouds(PackedScenes(np.array([[0, BOX, SPHERE]], np.int8), params), n, seeded())[0].double().numpy()
    row = params[0, 1].astype(np.float64)
    local = (cloud - row[:3]) @ rotation_from_quaternion(row[6:]) / (row[3:6] / 2)
    on_box = np.isclose(np.abs(local).max(1), 1, atol=1e-5)
    x, y, z = row[3:6]
    areas = np.repeat([y * z, x * z, x * y], 2)
    faces = [(np.isclose(local[:, a], s, atol=1e-5) & on_box).mean() for a in range(3) for s in (-1, 1)]
    np.testing.assert_allclose(faces, areas / (areas.sum() + 4 * np.pi * 0.15**2), atol=4 * np.sqrt(0.25 / n))
    for axis in range(3):  # even on the faces: second and third moments of a uniform number
        on = local[on_box & (np.abs(local[:, axis]) < 0.9999), axis]
        np.testing.assert_allclose([(on**2).mean(), on.mean()], [1 / 3, 0], atol=4 / np.sqrt(len(on)))
    heights = (cloud[~on_box] - params[0, 2, :3]) / 0.15
    np.testing.assert_allclose(heights.mean(0), 0, atol=4 / np.sqrt(3 * len(heights)))
    np.testing.assert_allclose(heights.T @ heights / len(heights), np.eye(3) / 3, atol=0.015)


def test_ordered_clouds_are_the_same_points():
    scenes = some_scenes(30, 4, 2)
    loose = surface_clouds(scenes, 300, seeded()).numpy()
    for a, b in zip(loose, surface_clouds(scenes, 300, seeded(), ordered=True).numpy(), strict=True):
        assert (np.lexsort(b.T[::-1]) == np.arange(300)).all()
        steps = 1e-6 * np.abs(a).max() + 1e-7
        for axis in range(3):
            np.testing.assert_allclose(np.sort(b[:, axis]), np.sort(a[:, axis]), atol=2 * steps)


def test_nothing_to_draw():
    floor = rd.Scene([rd.Box([0, 0, -0.05], [2, 2, 0.1])])
    nothing = PackedScenes.pack([floor] * 3, 4, floor=True)
    assert not surface_clouds(nothing, 5, seeded()).any()
    assert surface_clouds(PackedScenes.pack([floor] * 3, 0, floor=True), 5, seeded()).shape == (3, 5, 3)
    assert surface_clouds(nothing[:0], 5, seeded()).shape == (0, 5, 3)
    out_of_reach = PackedScenes.pack([rd.Scene([]), rd.Scene([rd.Sphere([5, 0, 0.5], 0.2)]), floor], 4)
    assert not surface_clouds(out_of_reach, 5, seeded(), region=PANDA_REGION, ordered=True).any()
    assert surface_clouds(out_of_reach, 5, seeded())[1].any()
