"""Free, occupied and unknown voxels from depth views that are made by hand, mostly of a wall."""

import numpy as np
import pytest

import robotdiffuse as rd
from helpers.panda import HOME, PANDA
from helpers.refusals import refuses
from helpers.sphere_oracles import depth_of_balls
from robotdiffuse.perception.observed_volume import ObservedVolume, minimum_table, observe
from robotdiffuse.perception.voxel_grid import LOW, SHAPE, VOXEL

AWAY = np.array([3.0, 0.0, 0.0, -0.1, 0.0, 1.571, 0.785])
"""The arm stretched upwards, out of the way of what these views look at."""
WIDTH, HEIGHT, FOCAL = 320, 240, 262.0
INTRINSICS = (FOCAL, FOCAL, (WIDTH - 1) / 2, (HEIGHT - 1) / 2)
WALL = 0.83
"""Where the wall stands: x = 1.6 - WALL in the base frame [m]."""


def camera(x: float = 1.6, y: float = 0.0, z: float = 0.5, back: bool = False) -> np.ndarray:
    """T_base_camera of a camera that looks along -x or, from behind, along x."""
    T = np.eye(4)
    sign = -1.0 if back else 1.0
    T[:3, :3] = np.array([[0, 0, -sign], [sign, 0, 0], [0, -1, 0]])
    T[:3, 3] = x, y, z
    return T


def view(depth: np.ndarray, T: np.ndarray | None = None, q: np.ndarray = AWAY) -> rd.DepthView:
    return rd.DepthView(depth, INTRINSICS, camera() if T is None else T, q)


def flat(depth: float) -> np.ndarray:
    return np.full((HEIGHT, WIDTH), depth, np.float32)


def centers() -> np.ndarray:
    return np.stack(np.meshgrid(*(np.arange(n) for n in SHAPE), indexing="ij"), -1) * VOXEL + VOXEL / 2 + LOW


def ahead(seen: ObservedVolume) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Of voxels straight ahead of the camera: their x, and whether they are occupied, free, behind a surface."""
    j, k = (int((at - low) / VOXEL) for at, low in zip((0.01, 0.51), LOW[1:], strict=True))
    return centers()[:, j, k, 0], seen.occupied[:, j, k], seen.free[:, j, k], seen.behind[:, j, k]


def test_before_a_wall_is_free_on_it_occupied_and_behind_unknown() -> None:
    seen = observe([view(flat(WALL))], PANDA, AWAY)
    x, occupied, free, behind = ahead(seen)
    wall = 1.6 - WALL
    np.testing.assert_array_equal(occupied, np.abs(x - wall) < VOXEL / 2)
    np.testing.assert_array_equal(free, x > wall + VOXEL / 2)
    hidden = x < wall - VOXEL / 2
    np.testing.assert_allclose(behind[hidden], (wall - x)[hidden], atol=1e-5)
    assert (behind[~hidden] == 0).all() and not (seen.free & seen.occupied).any()


def test_what_is_beside_the_image_is_out_of_view() -> None:
    seen = observe([view(flat(WALL))], PANDA, AWAY)
    away = centers() - (1.6, 0.0, 0.5)
    slopes = np.abs(away[..., 1:]) / -away[..., :1]
    half = np.array([WIDTH / 2, HEIGHT / 2]) / FOCAL
    np.testing.assert_array_equal(seen.out_of_view, ((slopes > half) | (away[..., :1] >= 0)).any(axis=-1))
    assert (seen.unknown | seen.free | seen.occupied).all() and not seen.free[seen.out_of_view].any()


@pytest.mark.parametrize("seed", range(3))
def test_free_voxels_hold_no_point_of_any_pixel(seed: int) -> None:
    """Random discs in front of a wall: no point lies in a free voxel, and no disc hides a corner of one."""
    rng = np.random.default_rng(seed)
    u, v = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    depth = flat(2.5)
    for _ in range(30):
        a, b, r = rng.uniform((0, 0, 3), (WIDTH, HEIGHT, 40))
        depth[(u - a) ** 2 + (v - b) ** 2 < r * r] = rng.uniform(0.6, 2.4)
    seen = observe([view(depth)], PANDA, AWAY)
    index = np.floor((view(depth).points() - LOW) / VOXEL).astype(int)
    assert not seen.free[tuple(index[((index >= 0) & (index < SHAPE)).all(axis=1)].T)].any()
    corners = np.stack(np.meshgrid(*[[-0.499, 0.499]] * 3, indexing="ij"), -1).reshape(-1, 3) * VOXEL
    away = (centers()[seen.free][:, None] + corners).reshape(-1, 3) - (1.6, 0.0, 0.5)
    at = np.rint(np.stack([away[:, 1], -away[:, 2]], 1) / -away[:, :1] * FOCAL + [159.5, 119.5]).astype(int)
    at = at.clip(0, (WIDTH - 1, HEIGHT - 1))
    hidden = depth[at[:, 1], at[:, 0]] <= -away[:, 0]
    assert hidden.mean() < 1e-4, "but for single pixels between two surfaces, which count as flying"


def test_several_views_add_up() -> None:
    front = view(flat(WALL))
    back = view(flat(0.82), camera(x=-1.6, back=True))
    both = observe([front, back], PANDA, AWAY)
    for one in (observe([front], PANDA, AWAY), observe([back], PANDA, AWAY)):
        assert both.occupied[one.occupied].all() and (both.free | both.occupied)[one.free].all()
    x, occupied, free, behind = ahead(both)
    assert occupied.sum() == 2 and free[x > 0.8].all() and free[x < -0.81].all()
    between = ~occupied & ~free
    np.testing.assert_allclose(behind[between], np.minimum(x + 0.78, 0.77 - x)[between], atol=1e-5)


def test_the_arm_is_no_obstacle_and_casts_a_shadow() -> None:
    T = camera()
    depth = np.minimum(depth_of_balls(PANDA.placed_spheres(HOME), T, INTRINSICS, (WIDTH, HEIGHT)), 2.2)
    assert (depth < 2.19).any()
    seen = observe([view(depth.astype(np.float32), q=HOME)], PANDA, AWAY)
    assert {*np.nonzero(seen.occupied)[0]} == {int((1.6 - 2.2 - LOW[0]) / VOXEL)}, "the wall behind alone"
    elsewhere = observe([view(depth.astype(np.float32), q=AWAY)], PANDA, AWAY)
    assert elsewhere.occupied.sum() > 50, "with the arm elsewhere, the points are an obstacle's"
    along = (PANDA.fk(HOME, "panda_hand")[:3, 3] - T[:3, 3]) * 1.4 + T[:3, 3]
    assert seen.shadow[tuple(((along - LOW) / VOXEL).astype(int))] and not (seen.shadow & (seen.free | seen.occupied)).any()


def test_a_pixel_that_saw_nothing_in_range_is_free_and_one_without_return_says_nothing() -> None:
    image = flat(np.inf)
    image[:8] = 40.0  # a surface far away, as without one the camera may be broken
    nothing = observe([view(image)], PANDA, AWAY)
    assert nothing.free.any() and not nothing.occupied.any() and (nothing.behind == 0).all()
    for lost in (0.0, np.nan, -1.0):
        blind = observe([view(flat(lost))], PANDA, AWAY)
        assert blind.unknown.all() and not blind.shadow.any() and (blind.behind == 0).all()


@pytest.mark.parametrize("depth", [0.0, np.nan, np.inf])
def test_a_covered_or_broken_camera_says_nothing_beside_another_one(depth: float) -> None:
    """Regression: a view of zeros lowered the confidence of a good one, and one of infinite depths made hidden space free."""
    alone = observe([view(flat(WALL))], PANDA, AWAY)
    both = observe([view(flat(WALL)), view(flat(depth))], PANDA, AWAY)
    assert (both.free == alone.free).all() and (both.unknown == alone.unknown).all() and (both.lost == alone.lost).all()


def test_a_cloud_that_ends_at_open_space_loses_nothing() -> None:
    """Regression: what a cloud does not reach counted as lost, and confidences were 0.2 lower than of the same image."""
    v, u = np.indices((HEIGHT, WIDTH))
    seen = view(np.where(2 * v > u, flat(WALL), np.inf))
    cloud = rd.DepthView.from_cloud(seen.points(), seen.T_base_camera)
    assert observe([cloud], PANDA, AWAY).lost.mean() < 0.05


def test_missing_returns_and_flying_pixels_change_little() -> None:
    rng = np.random.default_rng(1)
    clean = flat(WALL)
    clean[:, :100] = 2.0
    clean[:, 100:160] = 1.2
    exact = observe([view(clean)], PANDA, AWAY)
    flying, lost = clean.copy(), clean.copy()
    flying[:, 100] = rng.uniform(1.3, 1.9, HEIGHT)
    lost[rng.random(lost.shape) < 0.05] = 0
    for image in (flying, lost):
        seen = observe([view(image)], PANDA, AWAY)
        assert not (seen.occupied & ~exact.occupied).any() and (exact.occupied & ~seen.occupied).mean() < 1e-3
        assert (seen.free & ~exact.free).mean() < 1e-3 and (exact.free & ~seen.free).mean() < 1e-2


@pytest.mark.parametrize("shape", [(1, 1), (5, 3), (3, 40)])
def test_minima_of_squares_in_images_narrower_than_the_squares(shape: tuple[int, int]) -> None:
    """Regression: the table was written beyond its ends, which ended the process."""
    depth = np.random.default_rng(0).random(shape).astype(np.float32)
    table = minimum_table(depth, 6)
    for k, v, u in np.ndindex(table.shape):
        assert table[k, v, u] == depth[v : v + 2**k, u : u + 2**k].min()


def test_no_views_and_another_robots_configuration_are_refused() -> None:
    refuses("views is empty", observe, [], PANDA, HOME)
    refuses("has 3 numbers; panda plans 7", observe, [view(flat(1.0), q=np.zeros(3))], PANDA, HOME)


def test_a_return_too_near_to_count_does_not_undo_empty_space() -> None:
    image = np.where(np.arange(64) < 40, np.full((48, 64), 1.6), 0.0)
    counts = set()
    for image[10, 10] in (0.0, 1e-3, 1e-30):
        view = rd.DepthView(image, (50, 50, 31.5, 23.5), rd.pose([0, -1, 0.5], rpy=[-np.pi / 2, 0, 0]), range=1.8)
        counts.add(int(observe([view], PANDA, HOME).free.sum()))
    assert len(counts) == 1
