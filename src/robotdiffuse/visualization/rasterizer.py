"""Compiled triangle rasterizer and shading of pictures. It needs no GPU or window, and gives the same pixels
on every machine."""

import numpy as np

from robotdiffuse.core.kernels import kernel
from robotdiffuse.robots.frame_kernel import dot

GROUND_RADIUS = 3.2
"""Radius of the visible ground [m]."""
# linear colors of the ground and its lines, of the background at the top and at the bottom, and of the lights
GROUND = 0.8148, 0.8308, 0.8550
GROUND_LINES = 0.5457, 0.5841, 0.6376
BACKGROUND = (0.9301, 0.9387, 0.9560), (0.7913, 0.8148, 0.8469)
KEY_COLOR = 0.72, 0.70, 0.66
SKY_COLOR = 0.80, 0.82, 0.86
BOUNCE_COLOR = 0.16, 0.15, 0.14


@kernel()
def _row(rows, i):
    """The three numbers of a row."""
    return rows[i, 0], rows[i, 1], rows[i, 2]


@kernel()
def draw(near, ident, screen, faces):
    """Draw triangles into a z-buffer.

    near[h, w] is the buffer of nearness: a measure that is linear on the screen (1/z for perspective) and
    larger for nearer points. ident[h, w] is the index of the visible face. Both are updated where a triangle
    is nearer than the buffer. screen[v, 3] are the vertices: x and y in pixels, and nearness. Triangles with
    a nearness of 0 or less at a vertex are skipped.
    """
    h, w = near.shape
    for f in range(faces.shape[0]):
        a, b, c = _row(faces, f)
        x0, y0, z0 = _row(screen, a)
        x1, y1, z1 = _row(screen, b)
        x2, y2, z2 = _row(screen, c)
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
def _lit(light, at, n, first):
    """Fraction of directional lights that reach a point `at` with normal n, weighted by the cosine of their
    angles. Only every fourth light from `first` on is used.

    Each light has an orthographic map. For the surface that is nearest to the light, a texel holds the
    coordinate along the direction to the light, plus 100 m so that it is positive. The point is moved along
    its normal, so that surfaces do not shadow themselves.
    """
    maps, directions, scale, center = light
    bias = 2 / scale
    size = maps.shape[1]
    x = at[0] + n[0] * bias - center[0], at[1] + n[1] * bias - center[1], at[2] + n[2] * bias - center[2]
    received = 0.0
    total = 0.0
    for k in range(first, maps.shape[0], 4):
        d = directions[k]
        cosine = dot(n, d[2])
        total += 1.0
        if cosine <= 0:
            continue
        column = int(dot(x, d[0]) * scale + 0.5 * size)
        row = int(dot(x, d[1]) * scale + 0.5 * size)
        # a texel of a surface that the light meets at a flat angle spans more depth
        beyond = dot(x, d[2]) + bias * min(4.0, 0.5 / cosine) + 100.0
        inside = 0 <= column < size and 0 <= row < size
        if not (inside and maps[k, row, column] > beyond):
            received += cosine
    return received / total


@kernel()
def _grid(x, y, spacing, width, footprint):
    """Coverage of a pixel by the lines of a grid on the ground; lines are blurred by the pixel's footprint
    [m]."""
    best = 0.0
    for value in (x, y):
        off = abs(value - spacing * np.floor(value / spacing + 0.5))
        soft = max(width, footprint)
        best = max(best, (width / soft) * max(0.0, 1.0 - max(0.0, off - 0.5 * width) / soft))
    return best


@kernel()
def _surface(row, column, near, seen, camera, height):
    """The surface that is visible at a pixel.

    Returns its depth (0 without a surface), the ray with depth 1 through the middle of the pixel, the normal
    towards the eye, the perspective-correct weights of the face's corners, and whether it is a solid surface
    rather than the ground. `height` is the height of the ground [m].
    """
    ident, screen, faces, normals, _ = seen
    eye, rays = camera
    pixel = column + 0.5, row + 0.5, 1.0
    ray = dot(rays[0], pixel), dot(rays[1], pixel), dot(rays[2], pixel)
    no_weights = 0.0, 0.0, 0.0
    up = 0.0, 0.0, 1.0
    if ray[2] < 0 and eye[2] > height and ray[2] / (height - eye[2]) > near[row, column]:
        return (height - eye[2]) / ray[2], ray, up, no_weights, False
    if near[row, column] <= 0:
        return 0.0, ray, up, no_weights, False
    i, j, k = _row(faces, ident[row, column])
    x0, y0, z0 = _row(screen, i)
    x1, y1, z1 = _row(screen, j)
    x2, y2, z2 = _row(screen, k)
    px, py, _ = pixel
    area = (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0)
    u = ((x1 - px) * (y2 - py) - (x2 - px) * (y1 - py)) / area * z0
    v = ((x2 - px) * (y0 - py) - (x0 - px) * (y2 - py)) / area * z1
    t = ((x0 - px) * (y1 - py) - (x1 - px) * (y0 - py)) / area * z2
    total = u + v + t
    weights = u / total, v / total, t / total
    n = _mixed(normals, (i, j, k), weights)
    length = np.sqrt(dot(n, n)) + 1e-9
    if dot(n, ray) > 0:
        length = -length
    return 1 / near[row, column], ray, (n[0] / length, n[1] / length, n[2] / length), weights, True


@kernel()
def _mixed(rows, corners, weights):
    """The weighted mean of the rows of three corners."""
    a = _row(rows, corners[0])
    b = _row(rows, corners[1])
    c = _row(rows, corners[2])
    u, v, t = weights
    return u * a[0] + v * b[0] + t * c[0], u * a[1] + v * b[1] + t * c[1], u * a[2] + v * b[2] + t * c[2]


@kernel()
def shade(image, near, seen, camera, height, sky, key):
    """Compute the linear color of every pixel: solid surfaces, ground and background.

    `camera` is (eye[3], rays[3, 3]); the ray through pixel (x, y) is rays @ (x, y, 1), with z-depth 1. `seen`
    is (ident, screen, faces, normals, colors) of the surfaces, and `height` the height of the ground [m].
    `sky` and `key` are (maps, axes, scale, center) of the lights of the sky and of the main light. Each pixel
    uses a quarter of the lights: in a square of four pixels, which become one pixel of the picture, each uses
    another quarter.
    """
    h, w = near.shape
    eye, rays = camera
    toward = key[1][0, 2]
    ident, _, faces, _, colors = seen
    for row in range(h):
        for column in range(w):
            depth, ray, n, weights, solid = _surface(row, column, near, seen, camera, height)
            norm = np.sqrt(dot(ray, ray))
            up = min(1.0, max(0.0, 0.5 + 1.1 * ray[2] / norm))
            for c in range(3):
                image[row, column, c] = BACKGROUND[0][c] * up + BACKGROUND[1][c] * (1 - up)
            if depth <= 0:
                continue
            x = eye[0] + depth * ray[0], eye[1] + depth * ray[1], eye[2] + depth * ray[2]
            far = min(1.0, np.hypot(x[0], x[1]) / GROUND_RADIUS)
            mix = 1.0 if solid else (1 - far * far) ** 2
            if mix <= 0:
                continue
            part = (row % 2) * 2 + column % 2
            s = _lit(sky, x, n, part)
            q = _lit(key, x, n, part)
            base_color = GROUND
            stripe = 0.0
            gloss = 0.0
            if solid:
                base_color = _mixed(colors, _row(faces, ident[row, column]), weights)
                # highlight of Blinn and Phong, by the half vector, and brighter edges
                middle = toward[0] - ray[0] / norm, toward[1] - ray[1] / norm, toward[2] - ray[2] / norm
                half = max(0.0, dot(n, middle) / np.sqrt(dot(middle, middle)))
                edge = 1 + dot(n, ray) / norm
                gloss = 0.20 * min(1.0, 3 * q) * half**60 + 0.12 * s * edge**4
            else:
                pixel = depth * np.hypot(rays[0, 0], rays[1, 0])
                footprint = pixel * norm / max(0.1 * norm, -ray[2])
                fine_lines = 0.4 * _grid(x[0], x[1], 0.25, 0.003, footprint)
                stripe = max(fine_lines, _grid(x[0], x[1], 1.0, 0.005, footprint))
            for c in range(3):
                flat = base_color[c] + stripe * (GROUND_LINES[c] - base_color[c])
                lit = KEY_COLOR[c] * q + SKY_COLOR[c] * s + BOUNCE_COLOR[c] * (0.5 - 0.5 * n[2])
                image[row, column, c] += mix * (flat * lit + gloss - image[row, column, c])


@kernel()
def blend_ghost(image, solid, near, seen, camera, toward, tint, alpha):
    """Blend one see-through surface over the image. Only its nearest part is drawn, and more opaque where it
    is seen at a flat angle.

    solid, near: nearness of the solid surfaces and of this one. toward: direction of the main light. tint,
    alpha: color and opacity. seen, camera: as in `shade`.
    """
    h, w = near.shape
    ident, _, faces, normals, colors = seen
    for row in range(h):
        for column in range(w):
            # clearly nearer surfaces only: a ghost's link may be where that of the solid arm is
            if near[row, column] <= 1.003 * solid[row, column]:
                continue
            _, ray, n, weights, _ = _surface(row, column, near, seen, camera, -np.inf)
            facing = dot(n, ray) / np.sqrt(dot(ray, ray))
            corners = _row(faces, ident[row, column])
            outward = _mixed(normals, corners, weights)  # n points to the eye
            length = np.sqrt(dot(outward, outward)) + 1e-9
            bright = 0.62 + 0.38 * max(0.0, dot(outward, toward) / length)
            cover = min(1.0, alpha * (0.7 + 1.1 * (1 - abs(facing)) ** 2))
            base_color = _mixed(colors, corners, weights)
            for c in range(3):
                value = bright * tint[c] * (0.45 + 0.55 * base_color[c])
                image[row, column, c] += cover * (value - image[row, column, c])
