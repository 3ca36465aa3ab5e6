"""Samples point clouds of many packed scenes at once, on any device, during training.

As in `sample_surface`, points are uniform by area over the spheres and boxes of a scene. This PyTorch version
is written for speed. A point is center + M d: on a sphere, d is a direction and M the radius; on a box, the
columns of M are half of a face's normal and edges, and d is (+-1, u, v). The data of a point's face are
gathered from a table of faces, so that no array of points times shapes is needed, and scenes are processed in
batches that fit the processor's cache. For whole surfaces on the CPU, the most frequent case in training, the
Numba code in `surface_clouds_kernel` is three times faster still.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float32, Int8
from torch import Generator, Tensor

from robotdiffuse.datasets.surface_clouds_kernel import fill_clouds
from robotdiffuse.scenes.scene_arrays import BOX, NONE, SPHERE, PackedScenes
from robotdiffuse.scenes.surface_points import VisibleRegion

CPU_BATCH_POINTS = 1 << 15
"""Points that are processed at once on the CPU: their arrays fit the second-level cache."""
DEVICE_BATCH_POINTS = 1 << 22
"""Points that are processed at once on other devices."""
OVERSAMPLING = 1.5
"""Points sampled for each requested one, if some may be occluded or outside the region."""
COORDINATE_BITS = 21
"""Bits of each coordinate in the 63-bit integers by which clouds are sorted."""
OCCLUSION_MARGIN = 1e-4
"""Relative depth inside a shape beyond which it occludes a point, so that rounding errors do not count."""
EPSILON = 1e-12
"""Lower bound of divisors."""
COMPILED_DEVICES = ("cpu",)
"""Devices on which Numba code samples whole surfaces."""


def surface_clouds(
    scenes: PackedScenes,
    count: int,
    generator: Generator,
    *,
    region: VisibleRegion | None = None,
    camera: Float32[Tensor, "n 3"] | None = None,
    ordered: bool = False,
) -> Float32[Tensor, "n count 3"]:
    """`count` points on the obstacles of each scene [m], independent and uniform by area.

    The result is on the generator's device. Points repeat if few of the samples qualify; a scene without any
    is all zeros.

    region: only points inside it.
    camera: a position for each scene [m]; only points that are visible from it, on faces turned towards it
        and neither behind nor inside another shape.
    ordered: sorted by x, then y, then z, and rounded to a millionth of the scene's largest coordinate, for
        encoders that depend on the order.
    """
    kinds, params = np.ascontiguousarray(scenes.kinds), np.ascontiguousarray(scenes.params)
    n, k = kinds.shape
    clouds = torch.empty(n, count, 3, device=generator.device)
    if not n or not k or not count:
        return clouds.zero_()
    if region is None and camera is None and clouds.device.type in COMPILED_DEVICES:
        seeds = torch.randint(2**62, (n,), generator=generator).numpy().view(np.uint64)
        fill_clouds(kinds, params, seeds, clouds.numpy())
        if ordered:
            for part in clouds.split(max(1, CPU_BATCH_POINTS // count)):
                sort_points(list(part.unbind(-1)))
        return clouds
    kinds, params = (torch.from_numpy(array).to(clouds.device) for array in (kinds, params))
    return _by_tensors(kinds, params, clouds, generator, region, camera, ordered)


def _by_tensors(
    kinds: Int8[Tensor, "n k"],
    params: Float32[Tensor, "n k 10"],
    clouds: Float32[Tensor, "n count 3"],
    generator: Generator,
    region: VisibleRegion | None,
    camera: Float32[Tensor, "n 3"] | None,
    ordered: bool,
) -> Float32[Tensor, "n count 3"]:
    """`surface_clouds` in PyTorch: with a region or a camera, and on other devices."""
    n, count = clouds.shape[:2]
    # empty rows last, and scenes sorted by number of shapes: a batch takes as long as its largest scene
    slots = (kinds == NONE).byte().argsort(stable=True, dim=1)
    number, order = (kinds != NONE).sum(1).sort(stable=True)
    shapes = _Shapes.of(kinds.gather(1, slots)[order], params[order[:, None], slots[order]])
    eyes = None if camera is None else camera[order]
    table, area = _faces(shapes, region, eyes)
    part = max(1, (CPU_BATCH_POINTS if params.device.type == "cpu" else DEVICE_BATCH_POINTS) // count)
    most = number.tolist()
    for i in range(0, n, part):
        rows = slice(i, i + part)
        used = slice(0, max(1, max(most[rows])))
        faces = table[:, rows, used].reshape(len(table), -1), area[rows, used].flatten(1)
        if region is None and eyes is None:
            cloud = _draw(*faces, count, generator, False)[0]
        else:
            cloud, shape = _draw(*faces, math.ceil(OVERSAMPLING * count), generator, eyes is not None)
            counts = torch.ones_like(shape, dtype=torch.bool) if region is None else _inside(region, cloud)
            if eyes is not None:
                counts &= ~_occluded(shapes.some(rows, used), cloud, shape, eyes[rows])
            cloud = _first_selected(cloud, counts, count)
        if ordered:
            sort_points(cloud)
        clouds[order[rows]] = torch.stack(cloud, -1)
    return clouds


Points = list[Tensor]
"""The coordinates x, y and z, each of shape [b, m]."""


@dataclass(frozen=True, eq=False)
class _Shapes:
    """The spheres and boxes of b scenes."""

    sphere: Bool[Tensor, "b k"]
    center: Float32[Tensor, "b k 3"]
    half: Float32[Tensor, "b k 3"]
    """Half edge lengths of boxes, or three times the radius of spheres [m]; zero for empty rows."""
    rotation: Float32[Tensor, "b k 3 3"]

    @staticmethod
    def of(kinds: Int8[Tensor, "b k"], params: Float32[Tensor, "b k 10"]) -> "_Shapes":
        sphere, box = kinds == SPHERE, (kinds == BOX)[..., None]
        half = torch.where(box, params[..., 3:6] / 2, torch.where(sphere, params[..., 3], 0.0)[..., None])
        unit = params.new_tensor([1.0, 0.0, 0.0, 0.0])
        return _Shapes(sphere, params[..., :3], half, _rotation(torch.where(box, params[..., 6:], unit)))

    def some(self, rows: slice, slots: slice) -> "_Shapes":
        return _Shapes(
            self.sphere[rows, slots],
            self.center[rows, slots],
            self.half[rows, slots],
            self.rotation[rows, slots],
        )

    def local(self, points: Points) -> Points:
        """Points in the frames of the shapes, in units of their half sizes.

        The coordinates have shape [b, 1] or, with one shape per scene, [b, m].
        """
        p = [points[s] - self.center[..., s] for s in range(3)]
        scaled = self.rotation / self.half.clamp(min=EPSILON)[..., None, :]
        return [_dot(p, list(scaled[..., r].unbind(-1))) for r in range(3)]


def _dot(a: Points, b: Points) -> Tensor:
    return (a[0] * b[0]).addcmul_(a[1], b[1]).addcmul_(a[2], b[2])


def _rotation(wxyz: Float32[Tensor, "b k 4"]) -> Float32[Tensor, "b k 3 3"]:
    w, x, y, z = (wxyz / wxyz.norm(dim=-1, keepdim=True)).unbind(-1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def _faces(
    shapes: _Shapes, region: VisibleRegion | None, eye: Tensor | None
) -> tuple[Float32[Tensor, "13 b k 3"], Float32[Tensor, "b k 3"]]:
    """Three faces per shape, and their areas up to a common factor.

    A face is a center, the rows of M, and for a sphere the height of its cap in radii. A sphere uses only its
    first face. Two opposite faces of a box are one; with an eye, only the side turned towards it counts.
    """
    sphere = shapes.sphere[..., None]
    axes = shapes.rotation * shapes.half[..., None, :]
    a, b, c = shapes.half.unbind(-1)
    area = torch.stack([b * c, c * a, a * b], -1)
    cap = torch.zeros_like(area)
    cap[..., 0] = torch.where(shapes.sphere, 2.0, 0.0)
    if eye is not None:
        at = torch.stack(shapes.local([eye[:, s, None] for s in range(3)]), -1)
        area = torch.where(at.abs() > 1, area / 2, 0.0)
        axes = axes * torch.where(sphere, 1.0, at.sign())[..., None, :]
        far = at.norm(dim=-1)
        towards = _basis(eye[:, None] - shapes.center) * a[..., None, None]
        axes = torch.where(sphere[..., None], towards, axes)
        cap[..., 0] = torch.where(shapes.sphere & (far > 1), 1 - 1 / far, 0.0)
    area = torch.where(sphere, math.pi / 4 * cap * (a * a)[..., None], area)
    if region is not None:
        area = area * _may_intersect(region, shapes.center, axes.abs().sum(-1))[..., None]
    turns = torch.tensor([[0, 1, 2], [1, 2, 0], [2, 0, 1]], device=area.device)
    matrix = axes[..., turns].movedim((2, 4), (0, 1))
    center = shapes.center.movedim(-1, 0)[..., None].expand(3, *area.shape)
    # faces without area are sampled only in scenes without any area, whose points must be zero
    return torch.cat([center, matrix.flatten(0, 1), cap[None]]) * (area > 0), area


def _basis(direction: Float32[Tensor, "b k 3"]) -> Float32[Tensor, "b k 3 3"]:
    """Rotations whose first column is the direction (Duff et al., "Building an orthonormal basis,
    revisited")."""
    z = direction / direction.norm(dim=-1, keepdim=True).clamp(min=EPSILON)
    x, y, z = z.unbind(-1)
    sign = torch.where(z < 0, -1.0, 1.0)
    a = -1 / (sign + z)
    b = x * y * a
    second = torch.stack([1 + sign * x * x * a, sign * b, -sign * x], -1)
    third = torch.stack([b, sign + y * y * a, -y], -1)
    return torch.stack([torch.stack([x, y, z], -1), second, third], -1)


def _may_intersect(
    region: VisibleRegion, center: Float32[Tensor, "b k 3"], half: Float32[Tensor, "b k 3"]
) -> Bool[Tensor, "b k"]:
    gap = ((center - center.new_tensor(region.center)).abs() - half).clamp(min=0)
    return (center[..., 2] + half[..., 2] > region.floor) & (gap.square().sum(-1) < region.reach**2)


def _draw(
    table: Float32[Tensor, "13 bk3"],
    area: Float32[Tensor, "b k3"],
    count: int,
    generator: Generator,
    one_sided: bool,
) -> tuple[Points, Tensor]:
    """Points on the faces of `_faces`, and the shape of each [b, count]; one_sided: there is an eye."""
    n, faces = area.shape
    ends = area.cumsum(1)
    pick, u, v = torch.rand(3, n, count, generator=generator, device=area.device)
    pick *= ends[:, -1:]  # less than the end: 1 - 2^-24, the largest random number, is not rounded up to it
    shape = torch.zeros(n, count, dtype=torch.int64, device=area.device)
    for j in range(2, faces - 1, 3):
        shape += pick >= ends[:, j, None]
    face = 3 * shape + torch.arange(0, faces * n, faces, device=area.device)[:, None]
    flat = ends.view(-1)
    first, second = (flat[i:].index_select(0, face.view(-1)).view(n, count) for i in (0, 1))
    rows = face.add_(pick >= first).add_(pick >= second).view(-1)
    of = [part.index_select(0, rows).view(n, count) for part in table]

    cap = of[12]
    if not one_sided:  # one random number gives both the side of the box and the coordinate on it
        height = u.mul_(2).sub_(1)
        side = torch.ones_like(u).copysign_(u)
        across = u.abs().mul_(2).sub_(1)
    else:
        height = torch.addcmul(torch.ones_like(u), cap, u, value=-1)
        side = torch.ones_like(u)
        across = u.mul_(2).sub_(1)
    ring, angle = (height * height).neg_().add_(1).clamp_(min=0).sqrt_(), v * (2 * math.pi)
    along = v.mul_(2).sub_(1)
    on_sphere = (cap > 0).float()  # interpolating with it is several times faster than torch.where
    d = (
        torch.lerp(side, height, on_sphere),
        torch.lerp(across, ring * angle.cos(), on_sphere),
        torch.lerp(along, ring * angle.sin(), on_sphere),
    )
    points = of[:3]
    for r in range(3):
        for c in range(3):
            points[r].addcmul_(of[3 + 3 * r + c], d[c])
    return points, shape


def _inside(region: VisibleRegion, points: Points) -> Bool[Tensor, "b m"]:
    x, y, z = (points[i] - region.center[i] for i in range(3))
    return (points[2] > region.floor) & (x * x + y * y + z * z < region.reach**2)


def _occluded(
    shapes: _Shapes, points: Points, shape: Tensor, eye: Float32[Tensor, "b 3"]
) -> Bool[Tensor, "b m"]:
    """Which points are occluded from the eye by another shape than their own, or lie inside one."""
    hidden = torch.zeros_like(shape, dtype=torch.bool)
    for j in range(shapes.sphere.shape[1]):
        other = shapes.some(slice(None), slice(j, j + 1))
        at = other.local(points)
        way = [e - p for e, p in zip(other.local([eye[:, s, None] for s in range(3)]), at, strict=True)]
        # sphere: the minimum distance of the segment from the centre
        along, long = _dot(at, way), _dot(way, way)
        t = (-along / long).clamp_(0, 1)
        near = _dot(at, at) + t * (2 * along + t * long)
        # box: where the segment enters and leaves the three slabs
        enter, leave = torch.zeros_like(t), torch.ones_like(t)
        for a, w in zip(at, way, strict=True):
            inverse = w.reciprocal()
            middle, width = a * inverse, inverse.abs_()
            enter = torch.maximum(enter, -middle - width)
            leave = torch.minimum(leave, width - middle)
        behind = ((near < 1 - OCCLUSION_MARGIN) & other.sphere) | (
            (enter < leave - OCCLUSION_MARGIN) & ~other.sphere
        )
        hidden |= behind & (shape != j) & (other.half[..., 0] > 0)
    return hidden


def _first_selected(points: Points, counts: Bool[Tensor, "b m"], count: int) -> Points:
    """The first `count` selected points, repeated if there are fewer; zeros if there are none."""
    rank = counts.long().cumsum(1)
    total = rank[:, -1:].clone()
    place = rank.sub_(1).masked_fill_(~counts, count).clamp_(max=count)
    at = torch.arange(counts.shape[1], device=counts.device).expand_as(place)
    source = torch.zeros(len(counts), count + 1, dtype=torch.int64, device=counts.device)
    source.scatter_(1, place, at)
    turn = torch.arange(count, device=counts.device) % total.clamp(1, count)
    source = source.gather(1, turn)
    return [p.gather(1, source).mul_(total > 0) for p in points]


def sort_points(points: Points) -> None:
    """Sorts each scene's points in place by x, then y, then z, using integers that contain all three.

    Coordinates are rounded to a millionth of the scene's largest one.
    """
    middle = 1 << (COORDINATE_BITS - 1)
    largest = torch.stack([p.abs().amax(1) for p in points]).amax(0)
    scale = ((middle - 1) / largest.clamp(min=EPSILON))[:, None]
    key = torch.zeros_like(points[0], dtype=torch.int64)
    for p in points:
        key = (key << COORDINATE_BITS) | ((p * scale).round_().long() + middle)
    if key.device.type == "cpu":
        key.numpy().sort(axis=1)  # several times faster than PyTorch's sort, which also computes indices
    else:
        key = key.sort(1).values
    for i, p in enumerate(points):
        torch.div(((key >> (2 - i) * COORDINATE_BITS) & ((1 << COORDINATE_BITS) - 1)) - middle, scale, out=p)
