"""Compiled exact Euclidean distance transform of a grid: finds, for each voxel, the nearest one that contains
points."""

import numpy as np

from robotdiffuse.core.kernels import allocation_free, kernel

# Squared distance that stands for infinity, in lines without any points [voxels²]
_NO_POINTS = np.int32(1 << 30)
# Added before a position along a line is rounded down [voxels]. It is more than the rounding error. Positions
# are fractions with small denominators; the next integer above a fraction is farther away than this.
_ROUNDING_SLACK = 1e-6


@kernel(fastmath=True)
def nearest_voxels(run):
    """For each voxel the squared distance to the nearest voxel with points [voxels²], and the value of `run`
    at this nearest voxel.

    run int32[nx, ny, nz] is the index of the voxel's run: its points, which follow each other in the list of
    all points. It is -1 without points; at least one voxel has points. The transform goes axis by axis
    (A. Meijster, J. Roerdink, W. Hesselink, 2000).
    """
    nx, ny, nz = run.shape
    # along z: a scan in both directions; then along y and x: lower envelopes of parabolas
    squares = np.full((nx, ny, nz), _NO_POINTS, np.int32)
    holders = run.copy()
    for i in range(nx):
        for j in range(ny):
            for direction in (1, -1):
                last = -1
                for k in range(nz) if direction == 1 else range(nz - 1, -1, -1):
                    last = k if run[i, j, k] >= 0 else last
                    square = (k - last) ** 2
                    if last >= 0 and square < squares[i, j, k]:
                        squares[i, j, k] = square
                        holders[i, j, k] = run[i, j, last]
    longest = max(nx, ny)
    envelope = np.empty(longest, np.int32)
    since = np.empty(longest, np.int32)
    before = np.empty(longest, np.int32)
    owners = np.empty(longest, np.int32)
    for i in range(nx):
        for k in range(nz):
            _nearest_in_line(squares[i, :, k], holders[i, :, k], envelope, since, before, owners)
    for j in range(ny):
        for k in range(nz):
            _nearest_in_line(squares[:, j, k], holders[:, j, k], envelope, since, before, owners)
    return squares, holders


@allocation_free(fastmath=True)
def _nearest_in_line(squares, holders, envelope, since, before, owners):
    """Updates the squared distances of a line's voxels, and the values of `run` at their nearest voxels
    (`holders`), from the other voxels of the line.

    Voxel s contributes the parabola before[s] + (u - s)² at position u; the new squared distance is the lower
    envelope of all parabolas. The first `top` + 1 entries of `envelope` are the voxels whose parabolas form
    the envelope, in order; that of envelope[i] is lowest from position since[i] on. `before` and `owners` are
    copies of the old `squares` and `holders`.
    """
    n = len(squares)
    top = -1
    for u in range(n):
        before[u] = squares[u]
        owners[u] = holders[u]
        if before[u] == _NO_POINTS:
            continue
        while (
            top >= 0
            and before[envelope[top]] + (since[top] - envelope[top]) ** 2 > before[u] + (since[top] - u) ** 2
        ):
            top -= 1
        from_here = 0
        if top >= 0:
            s = envelope[top]
            offset = np.float64(u * u - s * s + before[u] - before[s])
            from_here = 1 + int(offset / np.float64(2 * (u - s)) + _ROUNDING_SLACK)
        if from_here < n:
            top += 1
            envelope[top] = u
            since[top] = from_here
    if top < 0:
        return
    for u in range(n - 1, -1, -1):
        s = envelope[top]
        squares[u] = before[s] + (u - s) ** 2
        holders[u] = owners[s]
        if u == since[top]:
            top -= 1
