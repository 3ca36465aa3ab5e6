"""OctoMap's binary files, written here from the description of their format, and height maps."""

from pathlib import Path

import numpy as np
import pytest

import robotdiffuse as rd
from helpers.refusals import refuses
from robotdiffuse.collision import CollisionChecker
from robotdiffuse.problems.files import problem_from_record, problem_record
from robotdiffuse.scenes.point_cloud import TREE_DEPTH, occupied_voxels, read_octomap

HALF = 2 ** (TREE_DEPTH - 1)
Key = tuple[int, int, int]
HEAD = b"# Octomap OcTree binary file\n"


def tree(keys: set[Key], level: int = TREE_DEPTH, low: Key = (-HALF, -HALF, -HALF)) -> bytes:
    """The bytes of an octree in which the voxels with these lower corners, in units of voxels, are occupied."""
    bits = 0
    below = b""
    edge = 2 ** (level - 1)
    for child in range(8):
        corner = tuple(low[a] + edge * (child >> a & 1) for a in range(3))
        inside = {key for key in keys if all(0 <= key[a] - corner[a] < edge for a in range(3))}
        if len(inside) == edge**3:
            bits |= 2 << 2 * child
        elif inside:
            bits |= 3 << 2 * child
            below += tree(inside, level - 1, corner)  # type: ignore[arg-type]
    return bits.to_bytes(2, "little") + below


def written(file: Path, keys: set[Key], edge: float = 0.05) -> Path:
    header = f"# Octomap OcTree binary file\n# (a comment)\nid OcTree\nsize {len(keys)}\nres {edge}\ndata\n"
    file.write_bytes(header.encode() + tree(keys))
    return file


def test_occupied_voxels_are_read(tmp_path: Path) -> None:
    keys = {(3, -4, 7), (-1, 0, 2), (100, 100, -100)}
    points, edge = read_octomap(written(tmp_path / "map.bt", keys))
    np.testing.assert_allclose(points[np.lexsort(points.T[::-1])], (np.array(sorted(keys)) + 0.5) * 0.05, atol=1e-12)
    assert edge == 0.05


def test_an_octomap_is_a_cloud_of_a_problem_file(tmp_path: Path) -> None:
    file = written(tmp_path / "map.bt", {(12, 6, 12)})
    scene = [{"point_cloud": {"file": str(file)}}]
    problem = problem_from_record({"robot": "panda", "scene": scene, "start": "ready", "goal": "ready"})
    [cloud] = problem.scene.shapes
    assert isinstance(cloud, rd.PointCloud) and cloud.point_radius == pytest.approx(0.05 * 3**0.5 / 2)
    assert problem_record(problem)["scene"][0]["point_cloud"]["file"] == str(file)  # type: ignore[index]
    assert rd.PointCloud.from_file(file, scale=2.0).point_radius == pytest.approx(0.05 * 3**0.5)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"# something else\ndata\n", "no binary OctoMap file"),
        (HEAD + b"id ColorOcTree\nres 0.1\ndata\n", "'ColorOcTree'; it must be an OcTree"),
        (HEAD + b"id OcTree\nres 0\ndata\n\x01\x00", "resolution is 0.0"),
        (HEAD + b"id OcTree\nres 0.1\ndata\n\x03\x00", "the tree ends too soon"),
        (HEAD + b"id OcTree\nres 0.1\ndata\n\x02\x00", "more than 5,000,000"),
        (HEAD + b"id \nres 0.1\ndata\n", "octomap .*map.bt is damaged: its header has no value of id"),
        (HEAD + b"res 0.1\ndata\n", "its header has no value of id"),
        (HEAD + b"id OcTree\nres\ndata\n", "its header has no value of res"),
        (HEAD + b"id OcTree\nsize 9\nres 0.1\ndata\n", "the tree ends too soon"),
    ],
)
def test_damaged_octomaps(content: bytes, message: str, tmp_path: Path) -> None:
    (tmp_path / "map.bt").write_bytes(content)
    refuses(message, read_octomap, tmp_path / "map.bt")


def test_a_height_map_is_an_obstacle_with_holes(tmp_path: Path) -> None:
    heights = np.zeros((21, 21))
    heights[10, 16:] = 0.3
    heights[0, 0] = np.nan
    np.save(tmp_path / "terrain.npy", heights)
    entry = {"height_map": {"file": str(tmp_path / "terrain.npy"), "cell": 0.1, "xyz": [-1, -1, -0.1]}}
    problem = problem_from_record({"robot": "panda", "scene": [entry], "start": "ready", "goal": "ready"})
    [terrain] = problem.scene.shapes
    assert isinstance(terrain, rd.HeightMap) and len(terrain.mesh.faces) == 2 * (20 * 20 - 1)
    np.testing.assert_allclose(terrain.bounds, [[-1, -1, -0.1], [1, 1, 0.2]])
    assert problem_record(problem)["scene"][0]["height_map"]["cell"] == 0.1  # type: ignore[index]
    free = CollisionChecker(problem.robot, problem.scene).link_clearances(problem.start[None])
    raised = rd.Scene([rd.HeightMap(heights, 0.1, [-1, -1, 0.4])])
    assert free.min() > 0 > CollisionChecker(problem.robot, raised).link_clearances(problem.start[None]).min()


def test_wrong_height_maps() -> None:
    refuses(r"height_map\.heights is an array of 2; it must be rows x columns", rd.HeightMap, [0.0, 1.0], 0.1)
    refuses("size 1e.09; all must be within", rd.HeightMap, [[0.0, 1e9], [0, 0]], 0.1)
    refuses("no cell with heights at all four corners", rd.HeightMap, [[np.nan, 1], [0, 0]], 0.1)
    refuses("'height_map' is a height_map; it must be one of sphere", rd.HeightMap(np.zeros((2, 2)), 0.1).solid)


@pytest.mark.parametrize("edge", [1, 2, 4, 8])
def test_the_shell_of_a_large_leaf_has_each_voxel_once(edge: int) -> None:
    """Regression: 74 bytes took 26 s, spent on a search for repeated voxels."""
    places = range(edge)
    voxels = occupied_voxels(tree({(x, y, z) for x in places for y in places for z in places}), 1.0)
    assert len({tuple(voxel) for voxel in voxels}) == len(voxels) == edge**3 - max(edge - 2, 0) ** 3
    np.testing.assert_allclose([voxels.min(axis=0), voxels.max(axis=0)], [[0.5] * 3, [edge - 0.5] * 3])
