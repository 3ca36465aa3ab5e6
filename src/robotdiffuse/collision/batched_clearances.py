"""Link clearances and their gradients for batches of configurations, each batch entry in a packed scene of
its own: network inputs of the denoiser in training."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float32
from numpy import ndarray

from robotdiffuse.collision.kernel_arrays import BOX_SLACK, EMPTY_BOX, RobotArrays, SceneArrays, compile_scene
from robotdiffuse.collision.kernels.clearance_gradients import clearances_and_gradients_into
from robotdiffuse.collision.kernels.lane_clearance import clearances_into, make_clearance_workspace
from robotdiffuse.collision.kernels.simd import W
from robotdiffuse.core.kernels import allocation_free, inner_kernel, kernel
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.scene_arrays import BOX, SPHERE, PackedScenes
from robotdiffuse.scenes.shapes import Box

_ZERO, _ONE, _NO_BOX_CORNER = np.float32(0.0), np.float32(1.0), np.float32(EMPTY_BOX[0, 0])


@allocation_free()
def _unpack(kinds, params, spheres, boxes):
    """Writes the spheres and boxes of a packed scene as rows of SceneArrays; returns how many there are of
    each."""
    n, m = 0, 0
    for k in range(len(kinds)):
        p = params[k]
        if kinds[k] == SPHERE:
            for i in range(4):
                spheres[n, i] = p[i]
            n += 1
        elif kinds[k] == BOX:
            w, x, y, z = p[6], p[7], p[8], p[9]
            for i in range(3):
                boxes[m, i] = p[i]
                boxes[m, 12 + i] = p[3 + i] * np.float32(0.5)
            # rows of the world-to-box rotation: the columns of the quaternion's matrix
            boxes[m, 3], boxes[m, 4], boxes[m, 5] = (
                1 - 2 * (y * y + z * z),
                2 * (x * y + w * z),
                2 * (x * z - w * y),
            )
            boxes[m, 6], boxes[m, 7], boxes[m, 8] = (
                2 * (x * y - w * z),
                1 - 2 * (x * x + z * z),
                2 * (y * z + w * x),
            )
            boxes[m, 9], boxes[m, 10], boxes[m, 11] = (
                2 * (x * z + w * y),
                2 * (y * z - w * x),
                1 - 2 * (x * x + y * y),
            )
            m += 1
    return n, m


class _Rows(NamedTuple):
    """Memory for rows of SceneArrays, which is reused for one scene after the other."""

    spheres: ndarray
    boxes: ndarray
    solids: ndarray
    solid_boxes: ndarray


@inner_kernel()
def _make_rows(obstacles):
    """Memory for so many obstacles and a floor."""
    return _Rows(
        np.empty((obstacles, 4), np.float32),
        np.empty((obstacles + 1, 15), np.float32),
        np.empty((obstacles + 1, 17), np.float32),
        np.empty((obstacles // W + 1, 6 * W), np.float32),
    )


@inner_kernel()
def _join(spheres, boxes, solids, around):
    """Writes what `kernel_arrays._solids` computes from spheres and boxes; returns the number of rows of
    `around`, each of 16 bounding boxes."""
    n, total = len(spheres), len(spheres) + len(boxes)
    solids[:total] = _ZERO
    rows = (total + W - 1) // W
    around[:rows, : 3 * W], around[:rows, 3 * W :] = _NO_BOX_CORNER, -_NO_BOX_CORNER
    for k in range(total):
        solid = solids[k]
        if k < n:
            solid[:3], solid[15] = spheres[k, :3], spheres[k, 3]
            solid[3], solid[7], solid[11] = _ONE, _ONE, _ONE
        else:
            solid[:15] = boxes[k - n]
        for i in range(3):
            extent = solid[15]
            for j in range(3):
                extent += abs(solid[3 + 3 * j + i]) * solid[12 + j]
            extent += np.float32(BOX_SLACK) * (_ONE + abs(solid[i]) + extent)
            around[k // W, i * W + k % W] = solid[i] - extent
            around[k // W, (3 + i) * W + k % W] = solid[i] + extent
    return rows


@inner_kernel()
def _scene(empty, floors, floor, kinds, params, rows):
    """The SceneArrays of a packed scene, in the memory `rows`; its floor, one of `floors`, is the first
    box."""
    fixed = 0
    if floor >= 0:
        rows.boxes[0] = floors[floor]
        fixed = 1
    n, m = _unpack(kinds, params, rows.spheres, rows.boxes[fixed:])
    spheres, boxes = rows.spheres[:n], rows.boxes[: fixed + m]
    sixteens = _join(spheres, boxes, rows.solids, rows.solid_boxes)
    return SceneArrays(
        spheres,
        boxes,
        empty.cylinders,
        empty.capsules,
        rows.solids[: n + fixed + m],
        rows.solid_boxes[:sixteens],
        empty.points,
        empty.point_rows,
        empty.cell_first,
        empty.grid,
        empty.nearest,
        empty.grid_frame,
        empty.may_touch,
    )


@kernel(nogil=True)
def _packed_link_clearances(robot, empty, floors, floor, kinds, params, q, limit):
    first = np.searchsorted(robot.frame, 1)
    out = np.empty((q.shape[0], q.shape[1], len(robot.frame) - first), np.float32)
    rows = _make_rows(kinds.shape[1])
    work = make_clearance_workspace(robot, len(rows.spheres) + len(rows.boxes) + 1)
    for b in range(len(q)):
        scene = _scene(empty, floors, floor[b], kinds[b], params[b], rows)
        clearances_into(robot, scene, q[b], limit, work, out[b])
    return out


@kernel(nogil=True)
def _packed_gradients(robot, empty, floors, floor, kinds, params, q, limit, margin):
    first = np.searchsorted(robot.frame, 1)
    out = np.empty((q.shape[0], q.shape[1], len(robot.frame) - first), np.float32)
    gradients = np.empty(q.shape, np.float32)
    rows = _make_rows(kinds.shape[1])
    work = make_clearance_workspace(robot, len(rows.spheres) + len(rows.boxes) + 1)
    for b in range(len(q)):
        scene = _scene(empty, floors, floor[b], kinds[b], params[b], rows)
        clearances_and_gradients_into(robot, scene, q[b], limit, margin, work, out[b], gradients[b])
    return out, gradients


def packed_link_clearances(
    robot: RobotArrays, scenes: PackedScenes, q: Float32[ndarray, "batch frames dof"], limit: float
) -> Float32[ndarray, "batch frames links"]:
    """Signed distances of the moving links to obstacles and floor of each sample's own scene [m], at most
    `limit`.

    `robot` comes from `compile_robot`.
    """
    return _packed_link_clearances(robot, *_arrays(scenes), q, np.float32(limit))


def packed_clearances_and_gradients(
    robot: RobotArrays,
    scenes: PackedScenes,
    q: Float32[ndarray, "batch frames dof"],
    limit: float,
    margin: float,
) -> tuple[Float32[ndarray, "batch frames links"], Float32[ndarray, "batch frames dof"]]:
    """`packed_link_clearances` and the gradients of `CollisionChecker.clearances_and_gradients` [m/rad]."""
    return _packed_gradients(robot, *_arrays(scenes), q, np.float32(limit), np.float32(margin))


def _arrays(scenes: PackedScenes) -> tuple[SceneArrays, ndarray, ndarray, ndarray, ndarray]:
    """An empty scene, the distinct floors, the index of each scene's floor or -1, kinds and parameters."""
    kinds, params = (np.ascontiguousarray(array) for array in (scenes.kinds, scenes.params))
    floors = np.zeros((len(scenes), 6)) if scenes.floors is None else scenes.floors
    different, floor = np.unique(floors, axis=0, return_inverse=True)
    there = different.any(axis=1)
    boxes = compile_scene(Scene([Box(row[:3], row[3:]) for row in different[there]])).boxes
    place = np.where(there, np.cumsum(there) - 1, -1)
    return compile_scene(Scene([])), boxes, place[floor.reshape(-1)], kinds, params
