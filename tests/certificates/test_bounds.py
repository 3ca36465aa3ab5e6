"""The bounds of proofs, against formulas by hand, Coal and the validator's kinematics."""

# Coal's Python module has no type information.
# pyright: reportAttributeAccessIssue=false

import coal
import numpy as np
import pytest
import trimesh
from hypothesis import given, strategies as st

import robotdiffuse as rd
from helpers.box_arm import box_arm
from helpers.example_robots import example_robot
from helpers.panda import PANDA
from helpers.refusals import refuses
from robotdiffuse.certificates import bounds as proofs
from robotdiffuse.certificates.kinematics import Linkage
from robotdiffuse.certificates.requirements import configurations, deviations
from robotdiffuse.scenes.shapes import Shape

TURN = [0.9, 0.1, -0.3, 0.3]


def shapes() -> list[Shape]:
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.2)
    return [
        rd.Sphere([0.3, 0.1, 0.2], 0.2),
        rd.Box([-0.2, 0.1, 0.0], [0.3, 0.1, 0.5], TURN),
        rd.Cylinder([0.1, -0.4, 0.1], 0.15, 0.4, TURN),
        rd.Capsule([0.1, 0.4, -0.3], 0.1, 0.3, TURN),
        rd.Mesh(ball.vertices, ball.faces, [0.0, 0.0, -0.5], TURN),
        rd.Mesh([[-5, -5, 0], [5, -5, 0], [0, 9, 0]], [[0, 1, 2]], [0, 0, 0.8]),
        rd.PointCloud(np.random.default_rng(3).uniform(-0.5, 0.5, (40, 3)), 0.02),
    ]


ROBOTS = {"panda": lambda: rd.load_robot("panda"), "box arm": box_arm, "two arms": lambda: example_robot("two_arms")}


@pytest.mark.parametrize("name", ROBOTS)
def test_links_are_where_the_validator_has_them(name: str) -> None:
    robot = ROBOTS[name]()
    q = np.random.default_rng(0).uniform(robot.lower, robot.upper, (5, robot.dof))
    linkage = Linkage(robot)
    T = linkage.place(q).T
    for k, link in enumerate(linkage.links):
        assert (linkage.moved[k] == robot.moved_by[robot.link_frame(link)]).all()
        for row in range(len(q)):
            np.testing.assert_allclose(T[row, k], robot.fk(q[row], link), atol=1e-12)


def _triangle(corners: np.ndarray) -> coal.Convex:
    points = coal.StdVec_Vec3s()
    faces = coal.StdVec_Triangle()
    for corner in corners:
        points.append(corner)
    faces.append(coal.Triangle(0, 1, 2))
    faces.append(coal.Triangle(0, 2, 1))
    return coal.Convex(points, faces)


def test_distances_are_those_of_coal() -> None:
    points = np.random.default_rng(1).uniform(-1, 1, (60, 3))
    obstacles = proofs.Obstacles(rd.Scene(shapes()))
    found = obstacles.distances(points)
    for k, body in enumerate(obstacles.bodies):
        if isinstance(body, proofs.Surface):
            count = body.corners.shape[1]
            pieces = [_triangle(c) if count == 3 else coal.Sphere(1e-9) for c in body.corners]
            at = [np.zeros(3) if count == 3 else c[0] for c in body.corners]
        else:
            x, y, z = 2 * body.half
            geometry = coal.Box(x, y, z)
            if body.disc:
                geometry = coal.Cylinder(body.disc, z)
            elif body.rounding:
                geometry = coal.Capsule(body.rounding, z) if z else coal.Sphere(body.rounding)
            pieces, at = [geometry], [body.center]
        R, less = (body.R, 0.0) if isinstance(body, proofs.Rounded) else (np.eye(3), body.radius)
        for point, distance in zip(points, found[:, k], strict=True):
            ball = coal.Sphere(1e-9)
            place = coal.Transform3s(np.eye(3), point)
            right = min(
                coal.distance(ball, place, piece, coal.Transform3s(R, t), coal.DistanceRequest(), coal.DistanceResult())
                for piece, t in zip(pieces, at, strict=True)
            )
            if isinstance(body, proofs.Surface) and count == 3 and right > 0.1:  # of triangles far away, their balls
                assert 0.6 * min(right, proofs.CLEARANCE_CAP) <= distance <= right + 1e-5
            elif right - less > 1e-3:
                assert distance == pytest.approx(min(right - less, proofs.CLEARANCE_CAP), abs=2e-5)
            else:
                assert distance < 2e-3


def test_reach_is_the_greatest_of_points_on_the_surface() -> None:
    n = np.random.default_rng(2).normal(size=(20, 3))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    for shape, body in zip(shapes(), proofs.Obstacles(rd.Scene(shapes())).bodies, strict=True):
        T, meshes = shape.solid() if isinstance(body, proofs.Rounded) else (np.eye(4), ())
        reach = body.reach(n) if isinstance(body, proofs.Rounded) else body.reach(n).max(axis=0)
        if isinstance(shape, rd.Mesh):
            np.testing.assert_allclose(reach, (shape.world_vertices @ n.T).max(axis=0))
        for mesh in meshes:  # polyhedra around round shapes, at most 2 % of the radius larger
            outer = ((mesh.vertices @ T[:3, :3].T + T[:3, 3]) @ n.T).max(axis=0)
            assert (reach <= outer + 1e-9).all() and (outer <= reach + 0.005).all()


@given(st.integers(0, 10_000))
def test_nothing_moves_further_than_its_displacement(seed: int) -> None:
    """Every sphere, and every pair of links in the frame of the link nearer to the base."""
    rng = np.random.default_rng(seed)
    ends = rng.uniform(PANDA.lower, PANDA.upper, (2, PANDA.dof))
    ends[1] = ends[0] + (ends[1] - ends[0]) * rng.uniform(0, 0.5)
    prover = proofs.Prover(PANDA, rd.Scene(), ends, np.zeros_like(ends[1:]))
    ones = np.ones(len(prover.claims))
    bounds = prover.bounds(proofs.Stretches(np.arange(len(prover.claims)), 0 * ones, ones), ones < 0, [])
    middle = prover.at(np.array([0.5]))
    linkage = prover.linkage
    places = linkage.place(np.concatenate([middle, prover.at(rng.uniform(0, 1, 8))])).T
    for claim, displacement in zip(prover.claims, bounds.displacement, strict=True):
        link = linkage.links.index(claim.link)
        base = 0 if claim.against == proofs.SCENE else linkage.links.index(claim.against)
        seen = np.linalg.inv(places[:, base]) @ places[:, link]
        centers = PANDA.spheres[claim.link][:, :3] @ np.swapaxes(seen[:, :3, :3], 1, 2) + seen[:, None, :3, 3]
        # a point of a ball goes at least as far as its center, at most by the turning of its radius more
        assert np.linalg.norm(centers[1:] - centers[0], axis=-1).max() <= displacement + 1e-12


@given(st.integers(0, 10_000))
def test_no_point_goes_further_against_a_normal_than_its_approach(seed: int) -> None:
    """Vertices of the hand along a bent path, in the frames of the base and of a link between base and hand."""
    rng = np.random.default_rng(seed)
    linkage = Linkage(PANDA)
    link = "panda_hand"
    middle = rng.uniform(PANDA.lower, PANDA.upper)
    steps = rng.normal(0, 0.1, (4, PANDA.dof)) * rng.integers(0, 2, PANDA.dof)
    normals = rng.normal(size=(2, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    share = rng.uniform(0, 1, (40, 1))
    at = middle + np.concatenate([share * steps[0], steps[0] + share * (steps[1] - steps[0]), steps])
    places = linkage.place(np.concatenate([middle[None], at]))
    k = linkage.links.index(link)
    [mesh, *_] = PANDA.meshes[link]
    for base in (0, linkage.links.index("panda_link4")):
        # where the hand comes to stand, as seen from where the base stands in the middle
        T = places.T[0, base] @ np.linalg.inv(places.T[:, base]) @ places.T[:, k]
        points = mesh.vertices @ np.swapaxes(T[:, :3, :3], 1, 2) + T[:, None, :3, 3]
        moved_by = np.flatnonzero(linkage.moved[k] & ~linkage.moved[base])
        bound = linkage.approach(places.origins[0], places.axes[0], points[0], moved_by, steps, normals, np.zeros(PANDA.dof))
        assert (bound + 1e-12 >= ((points[0] - points) @ normals.T).max(axis=0).T).all()


def test_unknown_shapes_are_refused_by_name() -> None:
    class Strange(Shape):
        kind = "strange"
        name = "odd"
        area, bounds = 0.0, np.zeros((2, 3))  # type: ignore[assignment]

    refuses("odd: a Strange cannot be certified", proofs.Obstacles, rd.Scene([Strange()]))


def test_a_link_that_is_called_like_the_scene_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """Regression: claims about a link with this name were taken for claims about the scene, so the pair was not proved."""
    monkeypatch.setattr(proofs, "SCENE", "l2")
    refuses("a link called 'l2'", proofs.Prover, box_arm(), rd.Scene(), np.zeros((2, 3)), np.zeros((1, 3)))


def test_bounds_hold_for_cubics_that_leave_the_straight_lines() -> None:
    """Along the cubics, the clearance is at least the clearance in the middle of the straight line minus the displacement."""
    rng = np.random.default_rng(0)
    robot = box_arm()
    for _ in range(12):
        rows, v = rng.uniform(-0.5, 0.5, (2, 4, 3))
        motion = rd.Trajectory(robot.joint_names, 0.3 * np.arange(4.0), rows, v, 0 * v)
        scene = rd.Scene([rd.Sphere([*rng.uniform(-1, 1, 2), 0.0], 0.05)])
        between = np.sort(rng.uniform(0.0, 0.9, 5))
        prover = proofs.Prover(robot, scene, configurations(motion, between), deviations(motion, between))
        times = np.sort(np.concatenate([motion.times, between]))
        count = len(prover.claims)
        start, stop = np.sort(rng.uniform(0, len(times) - 1, 2))
        whole = proofs.Stretches(np.arange(count), np.full(count, start), np.full(count, stop))
        found = prover.bounds(whole, np.zeros(count, bool), [])
        low, high = np.interp([start, stop], np.arange(len(times)), times)
        dense = motion.at(np.linspace(low, high, 40)).positions
        exact = proofs.Prover(robot, scene, dense, np.zeros_like(dense[1:]))
        for place in range(40):
            here = proofs.Stretches(np.arange(count), np.full(count, float(place)), np.full(count, float(place)))
            there = exact.bounds(here, np.zeros(count, bool), [])
            assert (there.clearance >= found.clearance - found.displacement - 1e-9).all()
