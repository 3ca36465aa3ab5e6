"""Link clearances and their gradients for batches of configurations. Each entry of a batch has its own packed
scene. In training, clearances and gradients are inputs of the denoiser network."""

import numpy as np
from jaxtyping import Float32
from numpy import ndarray

from robotdiffuse.collision.kernel_arrays import BOX_SLACK, EMPTY_BOX, RobotArrays, SceneArrays, compile_scene
from robotdiffuse.collision.kernels.collision_cost import clearances_and_gradients_into
from robotdiffuse.collision.kernels.frames import write_rotation
from robotdiffuse.collision.kernels.lane_clearance import make_clearance_workspace
from robotdiffuse.collision.kernels.simd import W
from robotdiffuse.core.kernels import ONE, inner_kernel, kernel
from robotdiffuse.scenes.packed_scenes import NONE, SPHERE, PackedScenes
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import Box

_NO_BOX_CORNER = np.float32(EMPTY_BOX[0, 0])


@inner_kernel()
def _scene(empty, floors, floor, kinds, params, solids, around):
    """Writes a packed scene to the buffers `solids` and `around`, and returns its SceneArrays, in which they
    are `solids` and `solid_boxes`. `floor` is the row of `floors` that becomes the first solid; -1: no
    floor."""
    n = 0
    if floor >= 0:
        solids[0] = floors[floor]
        n = 1
    for kind, p in zip(kinds, params):  # noqa: B905  (Numba has no strict)
        if kind == NONE:
            continue
        solid = solids[n]
        solid[3:] = np.float32(0.0)
        solid[:3] = p[:3]
        if kind == SPHERE:
            solid[3] = solid[7] = solid[11] = ONE
            solid[15] = p[3]
        else:
            solid[12:15] = p[3:6] * np.float32(0.5)
            # the inverse of the rotation
            write_rotation(p[6], -p[7], -p[8], -p[9], solid[3:12].reshape(3, 3))
        n += 1
    # axis-aligned boxes around the solids, W to a row as in `SceneArrays.solid_boxes`; unused places are
    # empty
    around[:, : 3 * W] = _NO_BOX_CORNER
    around[:, 3 * W :] = -_NO_BOX_CORNER
    for k in range(n):
        solid = solids[k]
        for i in range(3):
            extent = solid[15]
            for j in range(3):
                extent += abs(solid[3 + 3 * j + i]) * solid[12 + j]
            extent += np.float32(BOX_SLACK) * (ONE + abs(solid[i]) + extent)
            around[k // W, i * W + k % W] = solid[i] - extent
            around[k // W, (3 + i) * W + k % W] = solid[i] + extent
    return SceneArrays(
        solids[:n],
        around[: (n + W - 1) // W],
        empty.points,
        empty.point_rows,
        empty.cell_first,
        empty.grid,
        empty.nearest,
        empty.grid_frame,
        empty.may_touch,
    )


@kernel(nogil=True)
def _packed_gradients(robot, empty, floors, floor, kinds, params, q, limit, margin):
    """The results of `packed_clearances_and_gradients`; the arguments from `empty` to `params` are what
    `_arrays` returns."""
    fixed = np.searchsorted(robot.frame, 1)  # number of links that are fixed to the base; they come first
    obstacles = kinds.shape[1] + 1
    out = np.empty((q.shape[0], q.shape[1], len(robot.frame) - fixed), np.float32)
    gradients = np.empty(q.shape, np.float32)
    solids = np.empty((obstacles, 17), np.float32)
    around = np.empty((obstacles // W + 1, 6 * W), np.float32)
    work = make_clearance_workspace(robot, obstacles)
    for b in range(len(q)):
        scene = _scene(empty, floors, floor[b], kinds[b], params[b], solids, around)
        clearances_and_gradients_into(robot, scene, q[b], limit, margin, work, out[b], gradients[b])
    return out, gradients


def packed_clearances_and_gradients(
    robot: RobotArrays,
    scenes: PackedScenes,
    q: Float32[ndarray, "batch waypoints dof"],
    limit: float,
    margin: float = -np.inf,
) -> tuple[Float32[ndarray, "batch waypoints links"], Float32[ndarray, "batch waypoints dof"]]:
    """Signed distances of the moving links to the obstacles and floor of the scene with the same batch index
    [m], at most `limit`; and the gradients that `CollisionChecker.clearances_and_gradients` returns [m/rad],
    0 with the default margin.

    `robot` comes from `compile_robot`.
    """
    return _packed_gradients(robot, *_arrays(scenes), q, np.float32(limit), np.float32(margin))


def _arrays(scenes: PackedScenes) -> tuple[SceneArrays, ndarray, ndarray, ndarray, ndarray]:
    """An empty scene, the distinct floors, the index of each scene's floor (-1 without a floor), and the
    scenes' kinds and parameters."""
    kinds, params = (np.ascontiguousarray(array) for array in (scenes.kinds, scenes.params))
    floors = np.zeros((len(scenes), 6)) if scenes.floors is None else scenes.floors
    distinct, floor = np.unique(floors, axis=0, return_inverse=True)
    has_floor = distinct.any(axis=1)
    boxes = compile_scene(Scene([Box(row[:3], row[3:]) for row in distinct[has_floor]])).solids
    floor_index = np.where(has_floor, np.cumsum(has_floor) - 1, -1)
    return compile_scene(Scene([])), boxes, floor_index[floor.reshape(-1)], kinds, params
