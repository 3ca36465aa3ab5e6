"""Balls on an arm's surface, and which of them a depth image shows to be free."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import KDTree

import robotdiffuse as rd
from robotdiffuse.perception import visibility
from robotdiffuse.perception.ray_caster import looking_at, ray_cast
from robotdiffuse.perception.voxel_grid import VoxelGrid

PANDA = rd.load_robot("panda")
Q = np.array([0.3, -0.5, 0.2, -2.0, 0.4, 1.7, 0.5])
INTRINSICS = (150.0, 150.0, 79.5, 59.5)
SIZE = (160, 120)
T = looking_at(np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.1, 0.4]))
RNG = np.random.default_rng(0)
BALLS = RNG.uniform((0.2, -0.5, 0.2), (1.2, 0.5, 0.9), (2000, 3)).astype(np.float32)


def seen_in(depth: np.ndarray, noise: float = 0.0, border: int = 0, radius: float = 0.02) -> np.ndarray:
    seen = np.zeros(len(BALLS), np.bool_)
    arguments = np.array(INTRINSICS, np.float32), T.astype(np.float32), BALLS, np.float32(radius)
    errors = np.array([0.0, 0.0, noise], np.float32)
    visibility.see_through(depth.astype(np.float32), *arguments, errors, np.float32(border), seen)
    return seen


def returns(depth: np.ndarray, ball: np.ndarray, radius: float, more: int) -> np.ndarray | None:
    """The pixels that a ball projects to, computed from points on its surface; None if some are outside of the image."""
    ways = RNG.standard_normal((400, 3))
    points = (ball + radius * ways / np.linalg.norm(ways, axis=1)[:, None] - T[:3, 3]) @ T[:3, :3]
    fx, fy, cx, cy = INTRINSICS
    u = fx * points[:, 0] / points[:, 2] + cx
    v = fy * points[:, 1] / points[:, 2] + cy
    u0, v0 = (int(np.floor(of.min())) - more for of in (u, v))
    u1, v1 = (int(np.ceil(of.max())) + more for of in (u, v))
    if points[:, 2].min() <= 0 or min(u0, v0) < 0 or u1 >= SIZE[0] or v1 >= SIZE[1]:
        return None
    return depth[v0 : v1 + 1, u0 : u1 + 1]


def test_balls_seen_through_are_those_with_nothing_in_any_of_their_pixels() -> None:
    scene = rd.Scene([rd.Box((0.8, 0.1, 0.5), (0.05, 0.3, 0.3)), rd.Sphere((0.6, -0.2, 0.4), 0.1)])
    depth = ray_cast(scene, T, INTRINSICS, SIZE).depth
    radius = 0.02
    far = (BALLS - T[:3, 3]) @ T[:3, 2] + radius
    seen = seen_in(depth, radius=radius)

    def empty(more: int) -> np.ndarray:
        pixels = (returns(depth, ball, radius, more) for ball in BALLS)
        return np.array([of is not None and bool((of > behind).all()) for of, behind in zip(pixels, far, strict=True)])

    least, most = empty(3), empty(0)
    assert 100 < least.sum() < seen.sum() < most.sum() < len(BALLS) and not (least & ~seen).any() and not (seen & ~most).any()


@pytest.mark.parametrize(("lost", "seen"), [(0.6 * visibility.MAX_LOST_FRACTION, True), (0.6, False), (1.0, False)])
def test_pixels_without_a_return_show_nothing(lost: float, seen: bool) -> None:
    depth = np.where(RNG.random(SIZE[::-1]) < lost, 0.0, np.inf)
    inside = seen_in(np.full(SIZE[::-1], np.inf), radius=0.05)
    assert inside.any() and abs(seen_in(depth, radius=0.05)[inside].mean() - seen) < 0.1


def test_noise_asks_for_more_distance_and_filtered_images_for_more_pixels() -> None:
    depth = np.full(SIZE[::-1], 0.7)
    far = (BALLS - T[:3, 3]) @ T[:3, 2] + 0.02
    seen = seen_in(depth)
    assert seen.any() and (far[seen] < 0.7).all()
    noisy = seen_in(depth, noise=0.1)
    np.testing.assert_array_equal(noisy, seen & (far + 0.1 * far**2 < 0.7))
    assert noisy.sum() < seen.sum()
    depth[60, 80] = 0.01
    assert seen_in(depth, border=2).sum() < seen_in(depth).sum()


def test_balls_lie_within_voxels_if_all_of_them_do() -> None:
    marked = RNG.random((30, 30, 30)) < 0.95
    low, edge, radius = (0.2, -0.3, 0.2), 0.02, 0.008
    within = visibility.within_voxels(BALLS, radius, marked, VoxelGrid(low, marked.shape, edge))
    for ball, found in zip(BALLS[:500].astype(np.float64), within[:500], strict=True):
        corners = np.stack(np.meshgrid(*np.stack([ball - radius, ball + radius], axis=1)), -1).reshape(-1, 3)
        at = np.floor((corners - low) / edge).astype(int)
        assert found == (bool(((at >= 0) & (at < 30)).all()) and bool(marked[tuple(at.T)].all()))
    assert 0.02 < within.mean() < 0.9


def test_balls_cover_the_surface_of_the_arm_and_what_it_holds_and_the_spheres_of_a_link_without_meshes() -> None:
    held = PANDA.attach(rd.Box((0, 0, 0.1), (0.04, 0.06, 0.1), name="held"), "panda_hand")
    covered = list[tuple[rd.Robot, str, np.ndarray]]()
    for link in ("panda_link3", "panda_hand", "held"):
        corners = np.concatenate([mesh.vertices[mesh.faces] for mesh in held.meshes[link]])
        corners = corners[RNG.integers(len(corners), size=400)]
        covered.append((held, link, (RNG.dirichlet((1, 1, 1), 400)[:, None] @ corners)[:, 0]))
    assert len(visibility.surface_balls(held, Q)) > len(visibility.surface_balls(PANDA, Q))
    bare = replace(PANDA, meshes={}, spheres={link: PANDA.spheres[link] for link in ("panda_hand",)})
    ways = RNG.standard_normal((200, 3))
    ways /= np.linalg.norm(ways, axis=1)[:, None]
    spheres = bare.spheres["panda_hand"]
    covered.append((bare, "panda_hand", (spheres[:, None, :3] + spheres[:, None, 3:] * ways).reshape(-1, 3)))
    for robot, link, points in covered:
        T = robot.fk(Q, link)
        away, _ = KDTree(visibility.surface_balls(robot, Q)).query(points @ T[:3, :3].T + T[:3, 3])
        assert away.max() <= visibility.BALL_RADIUS, (link, len(robot.meshes))
