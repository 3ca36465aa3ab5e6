"""ROP scenes: what they are drawn from, packing, points for training."""

from dataclasses import replace

import numpy as np
import pytest

from robotdiffuse import Box, InputError, Scene, Sphere
from robotdiffuse.problems.families.rop import ROP, ROP_DENSE, Rop
from robotdiffuse.scenes.surface_points import VisibleRegion, sample_surface

FLOOR = 1


def test_papers_scenes() -> None:
    rng = np.random.default_rng(0)
    shapes = [shape for _ in range(300) for shape in ROP.scene(rng).shapes]
    floors = shapes[::3]
    obstacles = [shape for shape in shapes if shape.name != "floor"]
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
    assert ROP_DENSE.max_obstacles == 12
    radii = [shape.radius for scene in scenes for shape in scene.shapes if isinstance(shape, Sphere)]
    assert 0.08 <= min(radii) < 0.1 and 0.18 < max(radii) <= 0.2


def test_every_setting_counts() -> None:
    settings = Rop(obstacles=(4, 4), kinds=("box",), cube_side=(0.3, 0.4), x=(2.0, 3.0), yaw=True)
    shapes = settings.scene(np.random.default_rng(2)).shapes[FLOOR:]
    assert len(shapes) == 4 == settings.max_obstacles
    for shape in shapes:
        assert isinstance(shape, Box) and 2 <= shape.center[0] <= 3 and 0.3 <= shape.size[0] <= 0.4
        assert 0 < abs(shape.wxyz[3]) <= np.sin(np.pi / 8) and shape.wxyz[1] == shape.wxyz[2] == 0


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
