"""Training data: cached embeddings, turned copies, splits, and errors for unsuitable data."""

import shutil
from dataclasses import replace

import numpy as np

from helpers.refusals import refuses
from robotdiffuse.datasets.shards import read_manifest, shard_path, split_of, write_manifest
from robotdiffuse.learning.checkpoint import load_encoder
from robotdiffuse.learning.training.batches import load_data

WAYPOINTS = 48


def test_codes_are_cached_beside_the_data(data, arm):
    encoder = load_encoder(data.parent / "encoder")
    messages = []
    first = load_data(str(data), arm, encoder, WAYPOINTS, messages.append)
    cached = sorted((data / "codes").iterdir())
    assert len(cached) == 2 and f"{len(first)} trajectories" in messages[-1]
    cached[0].write_bytes(b"damaged")
    again = load_data(str(data), arm, encoder, WAYPOINTS, messages.append)
    np.testing.assert_array_equal(again.embeddings, first.embeddings)
    assert again.digest == first.digest


def test_turned_copies_are_for_training_alone(data, arm):
    encoder = load_encoder(data.parent / "encoder")
    plain = load_data(str(data), arm, encoder, WAYPOINTS, print)
    turned = load_data(str(data), arm, encoder, WAYPOINTS, print, turned_copies=2)
    assert turned.validation == plain.validation and len(turned) > len(plain)
    for split, more in zip(plain.split(10**6), turned.split(10**6), strict=True):
        apart = np.abs(split.q[:, None, :, 1:] - more.q[None, :, :, 1:]).max((2, 3))
        assert apart.min(axis=1).max() < 1e-5 and apart.min(axis=0).max() < 1e-5
    np.testing.assert_array_equal(plain.split(10**6)[1].q, turned.split(10**6)[1].q)


def test_splits_and_waypoints(data, arm):
    loaded = load_data(str(data), arm, load_encoder(data.parent / "encoder"), WAYPOINTS, print)
    train, validation = loaded.split(1000)
    assert set(split_of(train.scenes)) == {0} and set(split_of(validation.scenes)) == {1}
    assert 120 < len(train) + len(validation) == len(loaded) < 160
    assert len(loaded.split(2)[1]) == 2 and train.q.shape[1:] == (WAYPOINTS, arm.dof)


def test_bad_data_give_one_line(data, arm):
    messages = []
    more = load_encoder(data.parent / "encoder"), WAYPOINTS, messages.append
    refuses("use the robot of the data", load_data, str(data), replace(arm, spheres={}), *more)
    # Regression: shards that are planned and missing were not counted
    write_manifest(data, replace(read_manifest(data), trajectories=900, shard=300))
    load_data(str(data), arm, *more)
    assert "2 of 3 shards" in messages[-1]
    shutil.rmtree(shard_path(data, 1) / "line_free")
    refuses(r"shard_00001\.zarr", load_data, str(data), arm, *more)
    for i in (0, 1):
        shutil.rmtree(shard_path(data, i))
    refuses("holds no shard", load_data, str(data), arm, *more)
