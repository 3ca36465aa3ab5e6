"""Worlds in which a motion is free, in compiled code."""

import numpy as np

from robotdiffuse.core.kernels import kernel

TILE = 64
"""Coarse voxels of the periodic field along each axis: a power of two, and more than the observed volume."""


@kernel(nogil=True)
def highest_in_cells(probability, marked):
    """Coarse voxels with marked fine voxels that may be occupied: indices int64[n, 3], and the highest
    probability of these in each, float32[n], the highest first."""
    nx, ny, nz = marked.shape
    highest = np.zeros((nx // 2, ny // 2, nz // 2), np.float32)
    for i in range(nx):
        for j in range(ny):
            for k in range(nz):
                if marked[i, j, k] and probability[i, j, k] > highest[i // 2, j // 2, k // 2]:
                    highest[i // 2, j // 2, k // 2] = probability[i, j, k]
    cells = np.argwhere(highest > 0)
    values = np.empty(len(cells), np.float32)
    for n in range(len(cells)):
        values[n] = highest[cells[n, 0], cells[n, 1], cells[n, 2]]
    order = np.argsort(-values)
    return cells[order], values[order]


@kernel(nogil=True)
def count_free(field, shifts, cells, values):
    """The number of shifts of the field at which it is nowhere below the values of the cells.

    field: float32[TILE, TILE, TILE], periodic; shifts int64[m, 3]; cells int64[n, 3]; values float32[n].
    """
    free = 0
    for s in range(len(shifts)):
        blocked = False
        for n in range(len(cells)):
            i, j, k = (cells[n, 0] + shifts[s, 0], cells[n, 1] + shifts[s, 1], cells[n, 2] + shifts[s, 2])
            if field[i & (TILE - 1), j & (TILE - 1), k & (TILE - 1)] < values[n]:
                blocked = True
                break
        free += not blocked
    return free
