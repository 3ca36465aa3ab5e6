"""ROP scenes: what they are drawn from, packing, points for training."""

from dataclasses import replace

import numpy as np
import pytest

from robotdiffuse.errors import InputError
from robotdiffuse.problems.families.rop import ROP, Rop
from robotdiffuse.problems.families.rop_dense import ROP_DENSE
from robotdiffuse.scenes.packed import pack_scene, unpack_scene
from robotdiffuse.scenes.sampling import VisibleRegion, sample_surface, sample_surfaces_batch
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import Box, Cylinder, Sphere

FLOOR = 1


def test_papers_scenes() -> None:
    rng = np.random.default_rng(0)
    shapes = [shape for _ in range(300) for shape in ROP.scene(rng).shapes]
    floors, obstacles = shapes[::3], [shape for shape in shapes if shape.name != "floor"]
    assert len(obstacles) == 600
    for floor in floors:
        assert isinstance(floor, Box) and floor.name == "floor"
        assert floor.bounds.tolist() == [[-1, -1, -0.1], [1, 1, 0]]
    spheres = [shape for shape in obstacles if isinstance(shape, Sphere)]
    cubes = [shape for shape in obstacles if isinstance(shape, Box)]
    assert len(spheres) + len(cubes) == 600 and 220 < len(spheres) < 380
    assert {shape.radius for shape in spheres} == {0.25}
    assert {(*shape.size, *shape.wxyz) for shape in cubes} == {(0.2, 0.2, 0.2, 1, 0, 0, 0)}
    centers = np.array([shape.center for shape in (*spheres, *cubes)])
    assert (centers >= [-1, -1, 0.1]).all() and (centers <= 1).all()
    assert np.abs(centers.mean(axis=0) - [0, 0, 0.55]).max() < 0.1


def test_dense_scenes() -> None:
    rng = np.random.default_rng(1)
    scenes = [ROP_DENSE.scene(rng) for _ in range(200)]
    counts = {len(scene.shapes) - FLOOR for scene in scenes}
    assert counts == set(range(3, 13))
    assert ROP_DENSE.most_obstacles == 12
    radii = [shape.radius for scene in scenes for shape in scene.shapes if isinstance(shape, Sphere)]
    assert 0.08 <= min(radii) < 0.1 and 0.18 < max(radii) <= 0.2


def test_every_setting_counts() -> None:
    settings = Rop(obstacles=(4, 4), kinds=("box",), cube_side=(0.3, 0.4), x=(2.0, 3.0), yaw=True)
    shapes = settings.scene(np.random.default_rng(2)).shapes[FLOOR:]
    assert len(shapes) == 4 == settings.most_obstacles
    for shape in shapes:
        assert isinstance(shape, Box) and 2 <= shape.center[0] <= 3 and 0.3 <= shape.size[0] <= 0.4
        assert 0 < abs(shape.wxyz[3]) <= np.sin(np.pi / 8) and shape.wxyz[1] == shape.wxyz[2] == 0


def test_same_seed_same_scene() -> None:
    packs = [pack_scene(ROP_DENSE.scene(np.random.default_rng(3)), 13) for _ in range(2)]
    assert (packs[0][0] == packs[1][0]).all() and (packs[0][1] == packs[1][1]).all()


def test_obstacles_stay_clear_of_the_base() -> None:
    rng = np.random.default_rng(4)
    keep_out = np.array([[0, 0, 0.1, 0.15], [-0.1, 0, 0.05, 0.1]])
    settings = replace(ROP, x=(-0.5, 0.5), y=(-0.5, 0.5), yaw=True)
    for _ in range(100):
        for shape in settings.scene(rng, keep_out).shapes[FLOOR:]:
            points = sample_surface(Scene([shape]), 200, rng, VisibleRegion(floor=-5.0, reach=9.0))
            gaps = np.linalg.norm(points[:, None] - keep_out[:, :3], axis=2) - keep_out[:, 3]
            assert gaps.min() > 0
            assert isinstance(shape, Sphere | Box) and np.linalg.norm(shape.center - keep_out[0, :3]) > 0.15
    with pytest.raises(InputError, match="widen"):
        replace(ROP, x=(0.0, 0.0), y=(0.0, 0.0), z=(0.1, 0.1)).scene(rng, keep_out)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"kinds": ("sphere", "cone")}, "'cone'; known: box, sphere"),
        ({"x": (1.0, -1.0)}, "x is from 1.0 to -1.0"),
        ({"obstacles": (3, 2)}, "obstacles is from 3 to 2"),
        ({"kinds": ()}, "must allow a scene"),
        ({"sphere_radius": (0.0, 0.1)}, "must be positive"),
    ],
)
def test_wrong_settings(change: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        replace(ROP, **change)  # type: ignore[arg-type]


def test_packing() -> None:
    scene = replace(ROP_DENSE, yaw=True).scene(np.random.default_rng(5))
    kinds, params = pack_scene(scene, 15)
    assert kinds.shape == (15,) and params.shape == (15, 10)
    back = unpack_scene(kinds, params)
    again = pack_scene(back, 15)
    assert [type(shape) for shape in back.shapes] == [type(shape) for shape in scene.shapes]
    assert (again[0] == kinds).all()
    # Unpacking makes a quaternion of float32 one of length 1 in float64.
    np.testing.assert_allclose(again[1], params, atol=1e-7)
    with pytest.raises(InputError, match="2 slots"):
        pack_scene(scene, 2)
    with pytest.raises(InputError, match="cylinder"):
        pack_scene(Scene([Cylinder([0, 0, 0], 1, 1)]), 2)


def test_batch_has_the_distribution_of_single_scenes() -> None:
    """Shares of points by shape and by half of space, against sample_surface on the same scenes."""
    rng = np.random.default_rng(6)
    scenes = [replace(ROP_DENSE, yaw=True).scene(rng) for _ in range(12)]
    kinds, params = map(np.stack, zip(*(pack_scene(scene, 13) for scene in scenes), strict=True))
    batch = sample_surfaces_batch(kinds, params, 4096, rng)
    region = VisibleRegion()
    assert batch.dtype == np.float32 and batch.shape == (12, 4096, 3)
    assert (batch[..., 2] > region.floor - 1e-6).all()
    assert (np.linalg.norm(batch - np.array(region.center), axis=2) < region.reach + 1e-6).all()
    for scene, points in zip(scenes, batch, strict=True):
        single = sample_surface(scene, 4096, rng)
        # Six standard deviations of a mean of points spread over about 1 m; repeats make it less sharp.
        np.testing.assert_allclose(points.mean(axis=0), single.mean(axis=0), atol=0.06)
        np.testing.assert_allclose(points.std(axis=0), single.std(axis=0), atol=0.04)
        assert surface_gap(scene, points.astype(np.float64)).max() < 1e-5


def surface_gap(scene: Scene, points: np.ndarray) -> np.ndarray:
    gaps = []
    for shape in scene.shapes:
        assert isinstance(shape, Sphere | Box)
        local = points - shape.center
        if isinstance(shape, Sphere):
            gaps.append(np.abs(np.linalg.norm(local, axis=1) - shape.radius))
        else:
            gaps.append(np.abs((np.abs(local @ shape.rotation) - shape.size / 2).max(axis=1)))
    return np.min(gaps, axis=0)


def test_batch_of_nothing_visible_is_zero() -> None:
    floor = Box([0, 0, -0.05], [2, 2, 0.1])
    scenes = [Scene([]), Scene([floor]), Scene([floor, Sphere([9, 9, 9], 0.2)])]
    kinds, params = map(np.stack, zip(*(pack_scene(scene, 2) for scene in scenes), strict=True))
    assert (sample_surfaces_batch(kinds, params, 32, np.random.default_rng(7)) == 0).all()
    assert sample_surfaces_batch(kinds[:, :0], params[:, :0], 32, np.random.default_rng(7)).shape == (
        3,
        32,
        3,
    )
