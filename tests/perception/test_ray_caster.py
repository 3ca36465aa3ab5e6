"""Depth images by rays: they lie on the surfaces, nothing nearer is missed, and another renderer agrees."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings, strategies as st

import robotdiffuse as rd
from helpers.panda import PANDA
from helpers.refusals import refuses
from helpers.sphere_oracles import distance, random_shape
from robotdiffuse.perception.ray_caster import MAX_RANGE, looking_at, ray_cast, voxels_within
from robotdiffuse.perception.voxel_grid import VoxelGrid

SIZE = (64, 48)
INTRINSICS = (60.0, 60.0, 31.5, 23.5)


def random_scene(rng: np.random.Generator, count: int = 6) -> rd.Scene:
    shapes = [random_shape(kind, rng) for kind in rng.choice(["sphere", "box", "cylinder", "capsule"], count)]
    return rd.Scene([replace(shape, center=0.6 * shape.center) for shape in shapes])  # type: ignore


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10_000))
def test_points_lie_on_surfaces_and_nothing_is_nearer(seed: int) -> None:
    rng = np.random.default_rng(seed)
    scene = random_scene(rng)
    position = rng.normal(size=3)
    position *= rng.uniform(1.3, 2.2) / np.linalg.norm(position)
    T = looking_at(position, rng.uniform(-0.3, 0.3, 3), rng.uniform(-3, 3))
    view = ray_cast(scene, T, INTRINSICS, SIZE)
    nearest = np.min([distance(shape, view.points()) for shape in scene.shapes], axis=0)
    assert np.abs(nearest).max(initial=0) < 5e-5, "float32, at 2 m"
    # along each ray, up to the surface or to the end, everything is outside of all shapes
    v, u = np.mgrid[: SIZE[1], : SIZE[0]]
    fx, fy, cx, cy = INTRINSICS
    rays = np.stack([(u - cx) / fx, (v - cy) / fy, np.ones(u.shape)], axis=-1) @ T[:3, :3].T
    ends = np.minimum(view.depth, MAX_RANGE) - 1e-4
    between = position + (ends[..., None] * rays)[..., None, :] * np.linspace(0.02, 1, 60)[:, None]
    assert min(distance(shape, between).min() for shape in scene.shapes) > -5e-5


def test_the_arm_is_its_covering_spheres() -> None:
    q = np.array([0.3, -0.5, 0.0, -2.0, 0.0, 1.5, 0.8])
    view = ray_cast(rd.Scene(), looking_at(np.array([1.5, 0.5, 0.6]), np.array([0.0, 0.0, 0.4])), INTRINSICS, SIZE, PANDA, q)
    spheres = PANDA.placed_spheres(q)
    gaps = np.linalg.norm(view.points()[:, None] - spheres[:, :3], axis=-1) - spheres[:, 3]
    assert len(gaps) > 100 and np.abs(gaps.min(axis=1)).max() < 2e-5
    assert view.configuration is not None and (view.configuration == q).all()


def test_cameras_look_where_they_are_told_and_stand_upright() -> None:
    position, target = np.random.default_rng(0).normal(size=(2, 3))
    T = looking_at(position, target)
    along = T[:3, :3].T @ (target - position)
    np.testing.assert_allclose(along, [0.0, 0.0, float(np.linalg.norm(along))], atol=1e-12)
    assert T[2, 1] < 0 and abs(T[2, 0]) < 1e-12
    down = looking_at(np.array([0.4, 0.0, 1.5]), np.array([0.4, 0.0, 0.0]))
    np.testing.assert_allclose(down[:3, :3], [[0, -1, 0], [-1, 0, 0], [0, 0, -1]], atol=1e-12)


def test_pybullets_camera_sees_the_same(tmp_path: Path) -> None:
    pybullet = pytest.importorskip("pybullet")
    box = rd.Box((0.5, 0.1, 0.2), (0.2, 0.3, 0.4), (0.9, 0.1, 0.2, 0.3))
    ball = rd.Sphere((0.2, 0.5, 0.5), 0.15)
    (width, height), field, near, far = (160, 120), 0.96, 0.1, 4.0
    eye, target = (1.4, 0.6, 0.9), (0.3, 0.1, 0.3)
    client = pybullet.connect(pybullet.DIRECT)
    try:
        file = str(tmp_path / "ball.obj")  # finer than Bullet's own
        trimesh.creation.icosphere(4, ball.radius).export(file)
        seen = (
            (box, pybullet.createVisualShape(pybullet.GEOM_BOX, halfExtents=(box.size / 2).tolist())),
            (ball, pybullet.createVisualShape(pybullet.GEOM_MESH, fileName=file)),
        )
        for shape, visual in seen:
            w, *xyz = shape.wxyz.tolist() if isinstance(shape, rd.Box) else (1.0, 0.0, 0.0, 0.0)
            pybullet.createMultiBody(0.0, -1, visual, shape.center.tolist(), [*xyz, w])
        placed = pybullet.computeViewMatrix(eye, target, (0, 0, 1))
        lens = pybullet.computeProjectionMatrixFOV(np.degrees(field), width / height, near, far)
        *_, depth, bodies = pybullet.getCameraImage(width, height, placed, lens, shadow=0, renderer=pybullet.ER_TINY_RENDERER)
    finally:
        pybullet.disconnect(client)
    found = np.reshape(bodies, (height, width)) >= 0
    image = far * near / (far - (far - near) * np.reshape(np.float64(depth), (height, width)))
    focal = height / 2 / np.tan(field / 2)
    # PyBullet samples at the lower left corner of its pixels
    intrinsics = (focal, focal, width / 2, height / 2 - 1)
    view = ray_cast(rd.Scene([box, ball]), looking_at(np.array(eye), np.array(target)), intrinsics, (width, height))
    both = found & np.isfinite(view.depth)
    off = np.abs(image[both] - view.depth[both])
    assert both.sum() > 1500 and np.median(off) < 1e-3 and np.mean(off > 0.01) < 0.02, "but at edges"
    assert (found != np.isfinite(view.depth)).mean() < 0.01


@pytest.mark.parametrize("seed", range(3))
def test_voxels_that_hold_obstacles(seed: int) -> None:
    scene = random_scene(np.random.default_rng(seed))
    low, shape, voxel = (-0.5, -0.6, -0.4), (20, 25, 22), 0.04
    found = voxels_within(scene, VoxelGrid(low, shape, voxel), 0.01)
    centers = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), -1) * voxel + voxel / 2 + low
    nearest = np.min([distance(one, centers) for one in scene.shapes], axis=0)
    sure = np.abs(nearest - 0.01) > 1e-5
    np.testing.assert_array_equal(found[sure], (nearest <= 0.01)[sure])


def test_what_rays_do_not_know_is_refused() -> None:
    cloud = rd.Scene([rd.PointCloud(np.zeros((1, 3)))])
    refuses("point_cloud is a point_cloud; only spheres, boxes", ray_cast, cloud, np.eye(4), INTRINSICS, SIZE)
