"""Furniture scenes: they keep their settings, their regions are free, and nothing is inside the base."""

from dataclasses import replace

import numpy as np
import pytest

from helpers.refusals import refuses
from helpers.sphere_oracles import distance
from robotdiffuse.core.transforms import rotation_from_rpy
from robotdiffuse.problems.families import furniture
from robotdiffuse.scenes.scene_arrays import BOX, PackedScenes
from robotdiffuse.scenes.shapes import Shape

BASE = np.array([[0, 0, 0.1, 0.15], [-0.1, 0, 0.05, 0.1]])
NAMES = ("shelf", "crate", "table", "clutter", "kitchen", "cabinet")
FURNITURE: dict[str, furniture.Furniture] = {name: getattr(furniture, name.upper()) for name in NAMES}
every_family = pytest.mark.parametrize("name", FURNITURE)


def named(furnished: furniture.FurnishedScene, name: str) -> list[Shape]:
    return [shape for shape in furnished.scene.shapes if shape.name.split("_")[0] == name]


@every_family
def test_scenes_stand_on_the_ground_and_have_free_regions_in_reach(name: str) -> None:
    """No obstacle is inside the base, and all obstacles can be packed into arrays."""
    family = FURNITURE[name]
    rng = np.random.default_rng(0)
    assert family.max_obstacles <= 48
    for _ in range(15):
        furnished = family.furnish(rng, BASE)
        floor, *shapes = furnished.scene.shapes
        assert floor is furniture.FLOOR
        packed = PackedScenes.pack([furnished.scene], family.max_obstacles, floor=True)
        assert (packed.kinds > 0).sum() == len(shapes)
        assert (packed.params[packed.kinds == BOX][:, 7:9] == 0).all(), "turned about the vertical only"
        for shape in shapes:
            assert shape.bounds[0, 2] > -1e-12 and (distance(shape, BASE[:, :3]) > BASE[:, 3]).all()
        assert len(furnished.regions) >= 2
        for region in furnished.regions:
            assert (region.size > 0.08).all()
            assert np.linalg.norm(region.center - furniture.SHOULDER) <= family.reach
            assert np.linalg.norm(region.approach) == pytest.approx(1)
            points = region.center + rng.uniform(-0.5, 0.5, (200, 3)) * region.size @ rotation_from_rpy(0.0, 0.0, region.yaw).T
            assert min(distance(shape, points).min() for shape in furnished.scene.shapes) > -1e-9


@pytest.mark.parametrize("name", ["shelf", "crate", "table"])
def test_furniture_is_as_its_settings_say(name: str) -> None:
    rng = np.random.default_rng(0)
    for furnished in (FURNITURE[name].furnish(rng, BASE) for _ in range(60)):
        tops = [table.bounds[1, 2] for table in named(furnished, "table")]
        things = named(furnished, "ball") + named(furnished, "thing")
        if tops:
            assert furniture.TABLE.height[0] <= tops[0] <= furniture.TABLE.height[1]
            assert furniture.TABLE.objects[0] <= len(things) <= furniture.TABLE.objects[1]
            assert all(thing.bounds[0, 2] == pytest.approx(tops[0]) for thing in things)
        assert (2 <= len(named(furnished, "board")) <= 4) == (name == "shelf")
        for region in furnished.regions:
            down = bool((region.approach == [0, 0, -1]).all())
            assert down if name == "crate" else down or region.approach[2] == 0


def test_targets_have_the_fingers_in_the_region() -> None:
    approach = np.array([0.6, 0.0, -0.8])
    region = furniture.Region(np.array([0.5, 0.1, 0.3]), np.array([0.4, 0.2, 2 * furniture.REGION_MARGIN]), 0.7, approach)
    rng = np.random.default_rng(5)
    T = np.stack([furniture.sample_target(region, rng) for _ in range(1000)])
    products = T[:, :3, :3] @ T[:, :3, :3].transpose(0, 2, 1)
    np.testing.assert_allclose(products, np.broadcast_to(np.eye(3), (1000, 3, 3)), atol=1e-12)
    local = (T[:, :3, 3] + 0.1 * T[:, :3, 2] - region.center) @ rotation_from_rpy(0.0, 0.0, 0.7)
    assert (np.abs(local) <= region.size / 2 - furniture.REGION_MARGIN + 1e-12).all()
    assert (np.abs(local).max(axis=0) > 0.95 * (region.size / 2 - furniture.REGION_MARGIN) - 1e-12).all()
    cosines = T[:, :3, 2] @ approach
    least = np.cos(furniture.MAX_TILT)
    assert cosines.min() > least - 1e-12
    # uniform on the cap: the cosine is uniform; mean of 1000 draws within five standard deviations
    assert abs(cosines.mean() - (1 + least) / 2) < 5 * (1 - least) / np.sqrt(12 * 1000)


def test_wrong_settings() -> None:
    refuses(r"boards\[0\] is 1; it must be at least 2", replace, furniture.SHELF, boards=(1, 3))
    refuses(r"thickness\[0\] is 0.0; it must be positive", replace, furniture.CRATE, thickness=(0.0, 0.02))
    refuses("wall_share is 0.8 and pillar_share 0.3", replace, furniture.TABLE, wall_share=0.8)


@every_family
def test_impossible_settings(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(furniture, "MAX_TRIES", 5)
    short = replace(FURNITURE[name], reach=0.01)
    refuses("each of 5 scenes of .*; change distance, reach or objects", short.furnish, np.random.default_rng(6), BASE)
