"""Numba kernel of `ray_caster.voxels_within`: finds the voxels of a grid that lie in shapes."""

import numpy as np

from robotdiffuse.core.kernels import kernel
from robotdiffuse.perception.ray_kernel import BOX, CYLINDER, SPHERE

_ZERO, _HALF = np.float32(0.0), np.float32(0.5)


@kernel()
def _squared_distance(kind, x, y, z, a, b, c):
    """Squared distance of a point to a shape at the origin; 0 inside it."""
    if kind == SPHERE:
        out = max(np.sqrt(x * x + y * y + z * z) - a, _ZERO)
        return out * out
    if kind == BOX:
        x, y, z = max(abs(x) - a, _ZERO), max(abs(y) - b, _ZERO), max(abs(z) - c, _ZERO)
        return x * x + y * y + z * z
    along = max(abs(z) - b, _ZERO)
    if kind == CYLINDER:
        out = max(np.sqrt(x * x + y * y) - a, _ZERO)
        return out * out + along * along
    out = max(np.sqrt(x * x + y * y + along * along) - a, _ZERO)
    return out * out


@kernel()
def fill_voxels(kinds, rows, low, voxel, margin, out):
    """Sets the voxels of out [nx ny nz] whose centre is in a shape, or at most `margin` [m] from it.

    rows: as in `ray_kernel.render_depth`; low: lower corner of the grid. All arrays are float32, except kinds
    and `out`, bool.
    """
    nx, ny, nz = out.shape
    for s in range(len(kinds)):
        row, reach = rows[s], rows[s, 15] + margin
        i0, i1 = (
            int(max((row[0] - reach - low[0]) / voxel, _ZERO)),
            int((row[0] + reach - low[0]) / voxel + 1),
        )
        j0, j1 = (
            int(max((row[1] - reach - low[1]) / voxel, _ZERO)),
            int((row[1] + reach - low[1]) / voxel + 1),
        )
        k0, k1 = (
            int(max((row[2] - reach - low[2]) / voxel, _ZERO)),
            int((row[2] + reach - low[2]) / voxel + 1),
        )
        for i in range(i0, min(i1, nx)):
            px = low[0] + (np.float32(i) + _HALF) * voxel - row[0]
            for j in range(j0, min(j1, ny)):
                py = low[1] + (np.float32(j) + _HALF) * voxel - row[1]
                for k in range(k0, min(k1, nz)):
                    pz = low[2] + (np.float32(k) + _HALF) * voxel - row[2]
                    x = row[3] * px + row[4] * py + row[5] * pz
                    y = row[6] * px + row[7] * py + row[8] * pz
                    z = row[9] * px + row[10] * py + row[11] * pz
                    if _squared_distance(kinds[s], x, y, z, row[12], row[13], row[14]) <= margin * margin:
                        out[i, j, k] = True
