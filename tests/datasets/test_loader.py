"""RopDataset: every row once, scaled by the limits, with clouds on its obstacles; turned copies keep their clearances."""

import pickle
from dataclasses import fields, replace
from inspect import unwrap

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader

import robotdiffuse as rd
from helpers.box_arm import box_arm
from helpers.example_robots import example_robot
from helpers.panda import PANDA
from helpers.refusals import refuses
from helpers.stores import manifest_of, random_arrays, write_store
from robotdiffuse.collision import CollisionChecker
from robotdiffuse.datasets import shards
from robotdiffuse.datasets.loader import RopBatch, RopDataset
from robotdiffuse.problems.families.rop import ROP_DENSE
from robotdiffuse.scenes.packed_scenes import BOX, SPHERE, PackedScenes

ARM = box_arm()
WAYPOINTS = 20
SIZES = (150, 0, 130, 40)


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    folder = tmp_path_factory.mktemp("rop")
    write_store(folder, ARM, SIZES, WAYPOINTS)
    return folder


def joined(batches) -> RopBatch:
    parts = list(batches)
    return RopBatch(*(torch.cat([getattr(part, f.name) for part in parts]) for f in fields(RopBatch)))


def stored(store, name):
    return np.concatenate([shards.read_shard(store, i)[name] for i in range(len(SIZES))])


def test_every_row_of_a_split_once(store):
    split = shards.split_of(PackedScenes(stored(store, "obstacle_kinds"), stored(store, "obstacle_params")))
    goals = stored(store, "goals")
    goals = goals[np.arange(len(goals)), stored(store, "goal_index")]
    for i, name in enumerate(shards.SPLITS):
        data = RopDataset(store, name, points=8)
        batch = joined(data.batches(32, shuffle=False))
        assert len(data) == (split == i).sum() == len(batch) > 0
        scaled = (stored(store, "trajectories") - (ARM.upper + ARM.lower) / 2) / ((ARM.upper - ARM.lower) / 2)
        np.testing.assert_allclose(batch.trajectories, scaled[split == i], atol=1e-6)
        np.testing.assert_array_equal(batch.target_pose, stored(store, "target_pose")[split == i])
        torch.testing.assert_close(batch.start, batch.trajectories[:, 0], atol=0, rtol=0)
        np.testing.assert_allclose(batch.goal, data.normalizer.to_unit(goals[split == i]), atol=1e-6)
        shuffled = joined(data.batches(32))
        assert not torch.equal(shuffled.target_pose, batch.target_pose)
        ours, theirs = (np.lexsort(part.target_pose.numpy().T) for part in (shuffled, batch))
        for field in fields(RopBatch)[:-1]:
            pair = getattr(shuffled, field.name)[ours], getattr(batch, field.name)[theirs]
            torch.testing.assert_close(*pair, atol=0, rtol=0)


@pytest.mark.parametrize("sort_points", [False, True])
def test_clouds_lie_on_the_obstacles(store, sort_points):
    batch = joined(RopDataset(store, points=50, sort_points=sort_points).batches(64))
    assert batch.points.shape == (len(batch), 50, 3)
    local = batch.points[:, :, None] - batch.obstacle_params[:, None, :, :3]  # boxes in stores are not turned
    sphere = (local.norm(dim=-1) - batch.obstacle_params[:, None, :, 3]).abs()
    box = (local.abs() - batch.obstacle_params[:, None, :, 3:6] / 2).amax(-1).abs()
    kinds = batch.obstacle_kinds[:, None]
    far = torch.where(kinds == SPHERE, sphere, torch.where(kinds == BOX, box, torch.inf)).amin(-1)
    drawn = batch.points.any(-1)
    assert far[drawn].max() < 1e-5 and drawn.float().mean() > 0.95
    if sort_points:
        assert (batch.points[:, 1:, 0] >= batch.points[:, :-1, 0]).all()


def test_the_same_epoch_from_the_same_generator(store):
    data = RopDataset(store, points=16)
    threads = torch.get_num_threads()
    generators = [torch.Generator().manual_seed(seed) for seed in (0, 0, 1)]
    first = joined(data.batches(50, generator=generators[0]))
    torch.set_num_threads(3)
    try:
        second, other = (joined(data.batches(50, generator=one)) for one in generators[1:])
        assert torch.get_num_threads() == 3, "the threads that make batches have numbers of their own"
    finally:
        torch.set_num_threads(threads)
    for field in fields(RopBatch):
        torch.testing.assert_close(getattr(first, field.name), getattr(second, field.name), atol=0, rtol=0)
    assert not torch.equal(first.target_pose, other.target_pose)
    assert not torch.equal(joined(data.batches(50, generator=generators[0])).points, first.points)
    stopped = data.batches(10)
    next(stopped)
    stopped.close()  # type: ignore[attr-defined]


@pytest.mark.parametrize("workers", [0, 2])
def test_standard_loader_and_pickles(store, workers):
    data = RopDataset(store, "validation", points=12)
    batches = list(DataLoader(data, batch_size=5, num_workers=workers))
    q = torch.cat([batch["trajectories"] for batch in batches])
    torch.testing.assert_close(q, joined(data.batches(5, shuffle=False)).trajectories, atol=0, rtol=0)
    assert batches[0]["points"].shape == (5, 12, 3)
    assert data[-1].keys() == {field.name for field in fields(RopBatch)}
    torch.testing.assert_close(data[-1]["trajectories"], q[-1], atol=0, rtol=0)
    with pytest.raises(IndexError, match=f"there are {len(data)} items"):
        data[len(data)]
    content = pickle.dumps(data)
    assert len(content) < 2000, "without the trajectories"
    again = joined(pickle.loads(content).batches(50))
    torch.testing.assert_close(again.points, joined(data.batches(50)).points, atol=0, rtol=0)


def test_resampling():
    q = np.array([[[0.0, 0.0], [1.0, 0.0], [3.0, 0.0], [3.0, 1.0]], [[1.0, 2.0]] * 4], np.float32)
    even = shards.resample(q, 5)
    np.testing.assert_allclose(even[0], [[0, 0], [1, 0], [2, 0], [3, 0], [3, 1]], atol=1e-6)
    np.testing.assert_array_equal(even[1], q[1, [0] * 5])
    assert shards.resample(q[:0], 5).shape == (0, 5, 2)
    assert (shards.resample(q[1:], 3) == q[1, 0]).all()


def test_bad_input(store, tmp_path):
    refuses("unknown split 'tests'; known: test, train, validation", RopDataset, store, split="tests")
    refuses("points is 0; it must be at least 1", RopDataset, store, points=0)
    refuses("use the robot of the data", RopDataset, store, robot=replace(ARM, spheres={}))
    assert len(RopDataset(store, robot=ARM)) > 0
    refuses("batch_size is 0", RopDataset(store).batches, 0)

    def shard(waypoints):
        shards.write_shard(tmp_path, 0, random_arrays(ARM, 5, np.random.default_rng(0), waypoints), {})

    def damaged():
        shard(WAYPOINTS)
        next(p for p in (shards.shard_path(tmp_path, 0) / "trajectories" / "c").rglob("*") if p.is_file()).write_bytes(b"")

    for change, message in [
        (lambda: None, "no data set"),
        (lambda: shards.write_manifest(tmp_path, manifest_of(ARM, WAYPOINTS)), "holds no shard"),
        (lambda: shard(WAYPOINTS + 1), r"shard_00000\.zarr, array trajectories has rows of shape"),
        (damaged, r"shard_00000\.zarr, array trajectories is damaged"),
    ]:
        change()
        refuses(message, RopDataset, tmp_path)


def test_turned_motions_have_the_same_clearances_and_one_that_uses_the_whole_range_of_the_first_joint_stays():
    rng = np.random.default_rng(3)
    packed = PackedScenes.pack([ROP_DENSE.scene(rng) for _ in range(6)], ROP_DENSE.max_obstacles, floor=True)
    start, goal = rng.uniform(PANDA.lower, PANDA.upper, (2, 6, PANDA.dof))
    q = np.linspace(start, goal, 20, axis=1).astype(np.float32)
    q_turned, packed_turned, clear = shards.turned(PANDA, q, packed, rng)
    np.testing.assert_array_equal(q_turned[..., 1:], q[..., 1:])
    assert (q_turned >= PANDA.lower.astype(np.float32)).all() and (q_turned <= PANDA.upper.astype(np.float32)).all()
    angle = q_turned[:, :, 0] - q[:, :, 0]
    assert np.ptp(angle, axis=1).max() < 1e-5 and np.abs(angle).max() > 0.1
    for i in range(len(packed)):
        after = CollisionChecker(PANDA, packed_turned.scene(i)).link_clearances(q_turned[i])
        np.testing.assert_allclose(after, CollisionChecker(PANDA, packed.scene(i)).link_clearances(q[i]), atol=2e-5)
        assert clear[i] == CollisionChecker(PANDA, rd.Scene([])).free(q_turned[i]).all()
    q = np.linspace(PANDA.lower, PANDA.upper, 5)[None].astype(np.float32)
    same, _, _ = shards.turned(PANDA, q, PackedScenes.pack([rd.Scene([])], 1), np.random.default_rng(0))
    np.testing.assert_allclose(same, q, atol=1e-6)


@pytest.mark.parametrize(("name", "vertical"), [("panda", True), ("ur5", True), ("awkward", False)])
def test_which_robots_turn(name, vertical):
    assert shards.turns_about_vertical(example_robot(name)) is vertical


def test_clouds_are_float32_whatever_the_default_type_of_pytorch_is(store):
    expected = RopDataset(store, "train", points=8)[0]["points"]
    torch.set_default_dtype(torch.float64)
    try:
        torch.testing.assert_close(RopDataset(store, "train", points=8)[0]["points"], expected, atol=0, rtol=0)
    finally:
        torch.set_default_dtype(torch.float32)


@pytest.mark.parametrize("wrong", [{"points": 1.5}, {"waypoints": 3.5}, {"seed": 2**70}, {"device": "foo"}])
def test_arguments_of_the_wrong_type_are_named(store, wrong) -> None:
    refuses(next(iter(wrong)), unwrap(RopDataset.__init__), object.__new__(RopDataset), store, **wrong)
