"""Grazing links: where the convex parts of two links touch, their meshes decide."""

import errno
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

import robotdiffuse as rd
from helpers.boxes import boxes, surface
from helpers.example_robots import planar_arm
from helpers.refusals import refuses
from robotdiffuse.collision.exact_meshes import ExactCollision, explain_collision
from robotdiffuse.robots.fitting.convex_parts import convex_hull
from robotdiffuse.robots.fitting.covering_spheres import cover
from robotdiffuse.robots.robot_folder import SURFACE_FILE, read_robot_folder, write_robot_folder

TURN = 0.6
BESIDE = np.array([TURN, -TURN])
"""The second link is parallel to the wall, with a gap of GAP between the meshes."""
GAP = 0.001
LIP = 0.003
EMPTY = rd.Scene(())


def arm(wall: trimesh.Trimesh, link: trimesh.Trimesh, grazing: bool = True) -> rd.Robot:
    """Two joints about z, 0.5 m apart; the wall is fixed to the base. One convex part per link."""
    robot = planar_arm(0.5, 0.3)
    surfaces = {"l0": surface(wall), "l2": surface(link)}
    meshes = {name: (convex_hull(of.vertices),) for name, of in surfaces.items()}
    limits = {"lower": -2.8, "upper": 2.8, "velocity": 2.0, "acceleration": 8.0, "jerk": 80.0}
    return replace(
        robot,
        joints=tuple(j if j.kind == "fixed" else replace(j, **limits) for j in robot.joints),
        meshes=meshes,
        spheres={name: cover(mesh) for name, (mesh,) in meshes.items()},
        surfaces=surfaces if grazing else {},
        grazing=frozenset({frozenset(surfaces)} if grazing else ()),
    )


@cache
def channel(grazing: bool = True) -> rd.Robot:
    """A plate with a lip of height LIP at each end. Its convex part also fills the hollow between the lips."""
    y = 0.5 * np.sin(TURN) + 0.02 + GAP
    plate = ((-0.6, y, -0.05), (0.9, y + 0.02, 0.05))
    lips = (((x, y - LIP, -0.05), (x + 0.02, y + 0.02, 0.05)) for x in (-0.62, 0.9))
    return arm(boxes(plate, *lips), boxes(((0.0, -0.02, -0.02), (0.3, 0.02, 0.02))), grazing)


def closer(gap: float) -> np.ndarray:
    """A configuration like BESIDE with another gap [m]."""
    turn = np.arcsin(np.sin(TURN) + (GAP - gap) / 0.5)
    return np.array([turn, -turn])


def between_links(robot: rd.Robot, q: np.ndarray) -> float:
    [pair] = ExactCollision(robot, EMPTY).pair_distances(q)
    return pair.distance


@pytest.mark.parametrize("gap", [0.0002, 0.001, 0.0025, 0.0045])
def test_the_distance_of_grazing_links_is_that_of_their_meshes(gap: float) -> None:
    assert between_links(channel(False), closer(gap)) == pytest.approx(gap - LIP, abs=1e-6)
    assert between_links(channel(), closer(gap)) == pytest.approx(gap, abs=1e-6)
    assert ExactCollision(channel(), EMPTY).collides(closer(gap)[None]).tolist() == [False]


def test_meshes_that_touch_collide() -> None:
    q = closer(-0.0005)
    as_deep_as_convex_parts = -0.0005 - LIP
    assert between_links(channel(), q) == pytest.approx(as_deep_as_convex_parts, abs=1e-5)
    assert ExactCollision(channel(), EMPTY).collides(q[None]).tolist() == [True]
    assert explain_collision(channel(), EMPTY, q) is not None
    problem = rd.Problem(channel(), EMPTY, q, rd.JointGoal(np.zeros((1, 2))))
    assert rd.load_planner("rrt_connect").plan(problem, time_limit=5.0).status == rd.Status.INVALID_START
    assert not rd.verify(problem, rd.Path(channel().joint_names, np.stack([np.zeros(2), q]))).valid


def test_a_body_inside_another_and_deep_overlaps_of_convex_parts_collide() -> None:
    y = 0.5 * np.sin(TURN)
    wall = boxes(((-0.6, y - 0.003, -0.05), (0.9, y + 0.003, 0.05)))
    pin = boxes(((0.1, -0.001, -0.001), (0.102, 0.001, 0.001)))
    assert between_links(arm(wall, pin), BESIDE) == pytest.approx(-0.004, abs=1e-5)
    assert explain_collision(arm(wall, pin), EMPTY, BESIDE) == "l0 and l2 overlap by 4.0 mm"
    y = 0.5 * np.sin(TURN) + 0.02 + GAP
    deep = boxes(*(((x, y - 0.01, -0.05), (x + 0.02, y + 0.02, 0.05)) for x in (-0.62, 0.9)))
    assert between_links(arm(deep, boxes(((0.0, -0.02, -0.02), (0.3, 0.02, 0.02)))), BESIDE) < -0.005


@pytest.mark.parametrize("turned", [False, True])
def test_motions_out_of_and_into_grazing_are_planned_and_certified(turned: bool) -> None:
    ends = [BESIDE, np.array([-0.5, 0.3])]
    start, goal = ends[::-1] if turned else ends
    refused = rd.Problem(channel(False), EMPTY, start, rd.JointGoal(goal[None]))
    assert not rd.load_planner("rrt_connect").plan(refused, time_limit=5.0).solved
    problem = rd.Problem(channel(), EMPTY, start, rd.JointGoal(goal[None]))
    result = rd.load_planner("rrt_connect").plan(problem, time_limit=30.0)
    assert result.solved, result.reason
    assert result.path is not None
    report = rd.verify(problem, result.path)
    assert report.valid and report.self_clearance is not None and 0 < report.self_clearance <= GAP


def test_a_motion_within_grazing_is_certified_or_refused_as_the_meshes_are() -> None:
    """Start and goal are free in both motions; the second motion pushes the link into the wall on its way."""
    robot = channel()
    problem = rd.Problem(robot, EMPTY, closer(0.0005), rd.JointGoal(closer(0.004)[None]))
    along = np.stack([closer(0.0005), closer(0.0015), closer(0.004), [0.0, 0.0]])
    assert rd.verify(problem, rd.Path(robot.joint_names, along[:3])).valid
    mirrored = np.array([np.pi - TURN, TURN - np.pi])  # over the middle the arm reaches beyond the wall
    assert rd.verify(problem, rd.Path(robot.joint_names, np.stack([closer(0.0005), mirrored]))).violation is not None


def test_proofs_refuse_grazing_and_name_the_pair() -> None:
    problem = rd.Problem(channel(), EMPTY, BESIDE, rd.JointGoal(np.zeros((1, 2))))
    path = rd.Path(channel().joint_names, np.stack([BESIDE, np.zeros(2)]))
    assert rd.verify(problem, path).valid
    refuses("l2 and l0 are apart only by their exact surfaces", rd.certify, problem, path)


def test_folders_keep_the_surfaces_and_refuse_those_of_other_meshes(tmp_path: Path) -> None:
    write_robot_folder(channel(), tmp_path, {})
    kept = read_robot_folder(tmp_path)
    assert kept.grazing == channel().grazing
    for link, written in channel().surfaces.items():
        np.testing.assert_allclose(kept.surfaces[link].vertices, written.vertices, atol=1e-7)
        np.testing.assert_array_equal(kept.surfaces[link].faces, written.faces)
    packed = (tmp_path / SURFACE_FILE).read_bytes()
    write_robot_folder(channel(False), tmp_path, {})
    assert not (tmp_path / SURFACE_FILE).exists() and not read_robot_folder(tmp_path).grazing
    other = replace(channel(False), meshes={"l0": channel().meshes["l2"], "l2": channel().meshes["l0"]})
    write_robot_folder(other, tmp_path, {})
    (tmp_path / SURFACE_FILE).write_bytes(packed)
    refuses(SURFACE_FILE, read_robot_folder, tmp_path)


def test_a_folder_without_its_surfaces_is_not_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Regression: robot.json was written first, so that after a full disk or a kill the arm was read without surfaces."""
    save = np.savez_compressed

    def until_full(file: Any, **arrays: Any) -> None:
        if "grazing" in arrays:
            raise OSError(errno.ENOSPC, "full")
        save(file, **arrays)

    monkeypatch.setattr(np, "savez_compressed", until_full)
    refuses("cannot be written: full", write_robot_folder, channel(), tmp_path, {})
    refuses("robot.json", read_robot_folder, tmp_path)


def test_baxters_torso_and_arms_graze_as_trimesh_finds_too() -> None:
    """At a sampled configuration in which convex parts of the torso and a link overlap."""
    robot = rd.load_robot("baxter_left")
    q = np.array([-1.5766, -0.088, -0.5168, 1.6863, -2.2078, -0.4002, 1.5902])
    links = ("torso", "left_lower_forearm")
    assert explain_collision(robot, EMPTY, q) is None
    assert explain_collision(replace(robot, surfaces={}, grazing=frozenset()), EMPTY, q) is not None
    [found] = [d for d in ExactCollision(robot, EMPTY).pair_distances(q) if {d.link, d.other} == {*links}]
    meshes = []
    for each in links:
        T = robot.fk(q, each)
        of = robot.surfaces[each]
        meshes.append(trimesh.Trimesh(of.vertices @ T[:3, :3].T + T[:3, 3], of.faces, process=False))
    nearest = []
    for one, other in (meshes, meshes[::-1]):
        points = np.concatenate([one.vertices, trimesh.sample.sample_surface(one, 3000, seed=0)[0]])
        nearest.append(trimesh.proximity.closest_point(other, points)[1].min())
    # of points on a surface: never nearer than the surfaces are, and about as near
    assert found.distance - 1e-7 <= min(nearest) <= found.distance + 0.0005
