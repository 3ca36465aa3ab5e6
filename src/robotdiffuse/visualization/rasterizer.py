"""Compiled triangle rasterizer and shading of pictures: no GPU or window, the same pixels on every
machine."""

import numpy as np

from robotdiffuse.core.kernels import kernel


@kernel()
def draw(near, ident, screen, faces):
    """Draw triangles into a z-buffer.

    near[h, w]: nearness, any measure that is linear on the screen (1/z for perspective); larger is nearer,
    and only larger values are drawn. ident[h, w]: index of the visible face. screen[v, 3]: x and y in pixels,
    and nearness; triangles with a nearness of 0 or less are skipped.
    """
    h, w = near.shape
    for f in range(faces.shape[0]):
        a = faces[f, 0]
        b = faces[f, 1]
        c = faces[f, 2]
        x0 = screen[a, 0]
        y0 = screen[a, 1]
        z0 = screen[a, 2]
        x1 = screen[b, 0]
        y1 = screen[b, 1]
        z1 = screen[b, 2]
        x2 = screen[c, 0]
        y2 = screen[c, 1]
        z2 = screen[c, 2]
        if z0 <= 0 or z1 <= 0 or z2 <= 0:
            continue
        area = (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0)
        if area == 0:
            continue
        top = max(0, int(np.ceil(min(y0, y1, y2) - 0.5)))
        bottom = min(h - 1, int(np.floor(max(y0, y1, y2) - 0.5)))
        left = max(0, int(np.ceil(min(x0, x1, x2) - 0.5)))
        right = min(w - 1, int(np.floor(max(x0, x1, x2) - 0.5)))
        for row in range(top, bottom + 1):
            py = row + 0.5
            for column in range(left, right + 1):
                px = column + 0.5
                u = ((x1 - px) * (y2 - py) - (x2 - px) * (y1 - py)) / area
                v = ((x2 - px) * (y0 - py) - (x0 - px) * (y2 - py)) / area
                t = 1 - u - v
                if u >= 0 and v >= 0 and t >= 0:
                    z = u * z0 + v * z1 + t * z2
                    if z > near[row, column]:
                        near[row, column] = z
                        ident[row, column] = f


@kernel()
def _corner_weights(screen, a, b, c, px, py):
    """Perspective-correct weights of the three corners at a pixel (nearness is 1/z)."""
    x0, y0, x1, y1, x2, y2 = (
        screen[a, 0], screen[a, 1], screen[b, 0], screen[b, 1], screen[c, 0], screen[c, 1],
    )  # fmt: skip
    area = (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0)
    u = ((x1 - px) * (y2 - py) - (x2 - px) * (y1 - py)) / area * screen[a, 2]
    v = ((x2 - px) * (y0 - py) - (x0 - px) * (y2 - py)) / area * screen[b, 2]
    t = ((x0 - px) * (y1 - py) - (x1 - px) * (y0 - py)) / area * screen[c, 2]
    total = u + v + t
    return u / total, v / total, t / total


@kernel()
def _lit(light, x, y, z, nx, ny, nz, offset, stride):
    """Cosine-weighted fraction of directional lights that reach a point; uses every stride-th light.

    Each light has an orthographic map of the surfaces nearest to it. The point is moved along its normal by
    `bias` so that surfaces do not shadow themselves.
    """
    maps, directions, scale, center, size, bias = light
    x = x + nx * bias - center[0]
    y = y + ny * bias - center[1]
    z = z + nz * bias - center[2]
    got = 0.0
    total = 0.0
    for k in range(offset, maps.shape[0], stride):
        d = directions[k]
        cosine = nx * d[2, 0] + ny * d[2, 1] + nz * d[2, 2]
        total += 1.0
        if cosine <= 0:
            continue
        column = int((x * d[0, 0] + y * d[0, 1] + z * d[0, 2]) * scale + 0.5 * size)
        row = int((x * d[1, 0] + y * d[1, 1] + z * d[1, 2]) * scale + 0.5 * size)
        if 0 <= column < size and 0 <= row < size:
            depth = x * d[2, 0] + y * d[2, 1] + z * d[2, 2]
            # a texel of a surface seen edge-on spans more depth
            if maps[k, row, column] > depth + bias * min(4.0, 0.5 / cosine) + 100.0:
                continue
        got += cosine
    return got / total


@kernel()
def _grid(x, y, spacing, width, footprint):
    """Coverage of a pixel by the lines of a grid on the ground, softened by the pixel's footprint."""
    best = 0.0
    for value in (x, y):
        off = abs(value - spacing * np.floor(value / spacing + 0.5))
        soft = max(width, footprint)
        best = max(best, (width / soft) * max(0.0, 1.0 - max(0.0, off - 0.5 * width) / soft))
    return best


@kernel()
def _ray(rays, row, column):
    """The ray through the middle of a pixel, with depth 1."""
    px = column + 0.5
    py = row + 0.5
    rx = rays[0, 0] * px + rays[0, 1] * py + rays[0, 2]
    ry = rays[1, 0] * px + rays[1, 1] * py + rays[1, 2]
    rz = rays[2, 0] * px + rays[2, 1] * py + rays[2, 2]
    return rx, ry, rz


@kernel()
def _normal(normals, i, j, k, u, v, t):
    """The normal between three corners, and its length."""
    nx = u * normals[i, 0] + v * normals[j, 0] + t * normals[k, 0]
    ny = u * normals[i, 1] + v * normals[j, 1] + t * normals[k, 1]
    nz = u * normals[i, 2] + v * normals[j, 2] + t * normals[k, 2]
    return nx, ny, nz, np.sqrt(nx * nx + ny * ny + nz * nz) + 1e-9


@kernel()
def _surface(row, column, near, ident, screen, faces, normals, camera, height):
    """The surface at a pixel: depth (0 for none), ray, normal towards the eye, corner weights, whether
    solid."""
    eye, rays = camera
    px = column + 0.5
    py = row + 0.5
    rx, ry, rz = _ray(rays, row, column)
    if rz < 0 and eye[2] > height and rz / (height - eye[2]) > near[row, column]:
        return (height - eye[2]) / rz, rx, ry, rz, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, False
    if near[row, column] <= 0:
        return 0.0, rx, ry, rz, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, False
    f = ident[row, column]
    i = faces[f, 0]
    j = faces[f, 1]
    k = faces[f, 2]
    u, v, t = _corner_weights(screen, i, j, k, px, py)
    nx, ny, nz, length = _normal(normals, i, j, k, u, v, t)
    if nx * rx + ny * ry + nz * rz > 0:
        length = -length
    return 1 / near[row, column], rx, ry, rz, nx / length, ny / length, nz / length, u, v, t, True


@kernel()
def light_lattice(spacing, near, ident, screen, faces, normals, camera, height, sky, key):
    """Light at every `spacing`-th pixel, [rows, columns, 7]: depth, normal, sky, key, whether solid."""
    rows = near.shape[0] // spacing
    columns = near.shape[1] // spacing
    lattice = np.zeros((rows, columns, 7), np.float32)
    eye = camera[0]
    for row in range(rows):
        for column in range(columns):
            depth, rx, ry, rz, nx, ny, nz, _, _, _, solid = _surface(
                row * spacing, column * spacing, near, ident, screen, faces, normals, camera, height
            )
            if depth <= 0:
                continue
            x = eye[0] + depth * rx
            y = eye[1] + depth * ry
            z = eye[2] + depth * rz
            at = lattice[row, column]
            at[0] = depth
            at[1] = nx
            at[2] = ny
            at[3] = nz
            at[6] = 1.0 if solid else 0.0
            at[4] = _lit(sky, x, y, z, nx, ny, nz, 0, 1)
            at[5] = _lit(key, x, y, z, nx, ny, nz, 0, 1)
    return lattice


@kernel()
def _gathered(lattice, spacing, row, column, depth, nx, ny, nz, solid):
    """Light interpolated from the surrounding lattice points that show the same smooth surface."""
    y = row / spacing
    x = column / spacing
    top = int(y)
    first_column = int(x)
    sky = 0.0
    key = 0.0
    total = 0.0
    for i in range(2):
        for j in range(2):
            if top + i >= lattice.shape[0] or first_column + j >= lattice.shape[1]:
                continue
            at = lattice[top + i, first_column + j]
            alike = nx * at[1] + ny * at[2] + nz * at[3]
            if (at[6] > 0.5) != solid or alike < 0.96 or (solid and abs(at[0] - depth) > 0.015 * depth):
                continue
            weight = (1 - abs(y - top - i)) * (1 - abs(x - first_column - j))
            sky += weight * at[4]
            key += weight * at[5]
            total += weight
    return sky, key, total


@kernel()
def shade(
    image,
    lattice,
    spacing,
    near,
    ident,
    screen,
    faces,
    normals,
    colors,
    camera,
    ground,
    background,
    sky,
    key,
    light,
):
    """Compute the linear color of every pixel of the solid surfaces and the ground.

    camera: (eye[3], rays[3, 3]) so that the ray through pixel (x, y) is rays @ (x, y, 1), with z-depth 1.
    lattice, spacing: from light_lattice. At edges, where the lattice does not fit, a pixel uses a quarter of
    the lights itself, a different quarter for each pixel in a square of four. ground: (height, radius, base
    color[3], line color[3]); background: (top color[3], bottom color[3]); sky, key: (maps, axes, scale,
    center, size, bias); light: colors[3] of key, sky and bounce.
    """
    h, w = near.shape
    eye, rays = camera
    height, radius, base, line = ground
    toward = key[1][0, 2]
    for row in range(h):
        for column in range(w):
            depth, rx, ry, rz, nx, ny, nz, u, v, t, solid = _surface(
                row, column, near, ident, screen, faces, normals, camera, height
            )
            norm = np.sqrt(rx * rx + ry * ry + rz * rz)
            up = min(1.0, max(0.0, 0.5 + 1.1 * rz / norm))
            for c in range(3):
                image[row, column, c] = background[0][c] * up + background[1][c] * (1 - up)
            if depth <= 0:
                continue
            x = eye[0] + depth * rx
            y = eye[1] + depth * ry
            z = eye[2] + depth * rz
            far = min(1.0, np.sqrt(x * x + y * y) / radius)
            mix = 1.0 if solid else (1 - far * far) ** 2
            if mix <= 0:
                continue
            s, q, total = _gathered(lattice, spacing, row, column, depth, nx, ny, nz, solid)
            if total > 0.25:
                s = s / total
                q = q / total
            else:
                part = (row % 2) * 2 + column % 2
                s = _lit(sky, x, y, z, nx, ny, nz, part, 4)
                q = _lit(key, x, y, z, nx, ny, nz, part, 4)
            stripe = 0.0
            gloss = 0.0
            if solid:
                f = ident[row, column]
                hx = toward[0] - rx / norm
                hy = toward[1] - ry / norm
                hz = toward[2] - rz / norm
                half = max(0.0, (nx * hx + ny * hy + nz * hz) / np.sqrt(hx * hx + hy * hy + hz * hz))
                edge = 1 + (nx * rx + ny * ry + nz * rz) / norm
                gloss = 0.20 * min(1.0, 3 * q) * half**60 + 0.12 * s * edge**4
            else:
                pixel = depth * np.sqrt(rays[0, 0] ** 2 + rays[1, 0] ** 2)
                footprint = pixel * norm / max(0.1 * norm, -rz)
                stripe = max(0.4 * _grid(x, y, 0.25, 0.003, footprint), _grid(x, y, 1.0, 0.005, footprint))
            for c in range(3):
                if solid:
                    base_color = (
                        u * colors[faces[f, 0], c] + v * colors[faces[f, 1], c] + t * colors[faces[f, 2], c]
                    )
                else:
                    base_color = base[c] + stripe * (line[c] - base[c])
                lit = light[0][c] * q + light[1][c] * s + light[2][c] * (0.5 - 0.5 * nz)
                image[row, column, c] += mix * (base_color * lit + gloss - image[row, column, c])


@kernel()
def blend_ghost(image, solid, near, ident, screen, faces, normals, colors, camera, toward, tint, alpha):
    """Blend one see-through arm over the image: its nearest surface, more opaque where it is seen edge-on."""
    h, w = near.shape
    _, rays = camera
    for row in range(h):
        for column in range(w):
            # It must be slightly nearer than the solid arm: links that only turn about their axis coincide.
            if near[row, column] <= 1.003 * solid[row, column]:
                continue
            px = column + 0.5
            py = row + 0.5
            f = ident[row, column]
            i = faces[f, 0]
            j = faces[f, 1]
            k = faces[f, 2]
            u, v, t = _corner_weights(screen, i, j, k, px, py)
            rx, ry, rz = _ray(rays, row, column)
            nx, ny, nz, length = _normal(normals, i, j, k, u, v, t)
            facing = (nx * rx + ny * ry + nz * rz) / (length * np.sqrt(rx * rx + ry * ry + rz * rz))
            bright = 0.62 + 0.38 * max(0.0, (nx * toward[0] + ny * toward[1] + nz * toward[2]) / length)
            cover = min(1.0, alpha * (0.7 + 1.1 * (1 - abs(facing)) ** 2))
            for c in range(3):
                base_color = u * colors[i, c] + v * colors[j, c] + t * colors[k, c]
                value = bright * tint[c] * (0.45 + 0.55 * base_color)
                image[row, column, c] += cover * (value - image[row, column, c])
