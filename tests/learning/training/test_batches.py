"""Training data: random scenes, cached codes, turned copies, splits, and data that do not fit."""

import shutil
from dataclasses import replace

import numpy as np
import pytest

from robotdiffuse.core.errors import InputError
from robotdiffuse.datasets.shards import shard_path, split_of
from robotdiffuse.learning.checkpoint import load_encoder
from robotdiffuse.learning.training.batches import (
    load_data,
    random_scenes,
)
from robotdiffuse.scenes.scene_arrays import BOX, SPHERE

WAYPOINTS = 48


def test_random_scenes():
    scenes = random_scenes(300, 12, np.random.default_rng(0))
    kinds = scenes.kinds
    params = scenes.params
    assert set(np.unique(kinds)) == {0, SPHERE, BOX}
    assert (params[kinds == 0] == 0).all()
    assert (params[kinds == SPHERE, 3] > 0).all()
    np.testing.assert_allclose(np.linalg.norm(params[kinds != 0, 6:], axis=1), 1, atol=1e-5)
    assert (kinds != 0).sum(1).max() == 12


def test_codes_are_cached_beside_the_data(data, arm):
    encoder = load_encoder(data.parent / "encoder")
    messages = []
    first = load_data(str(data), arm, encoder, WAYPOINTS, messages.append)
    cached = sorted((data / "codes").iterdir())
    assert len(cached) == 2
    assert f"{len(first)} trajectories" in messages[-1]
    cached[0].write_bytes(b"damaged")
    again = load_data(str(data), arm, encoder, WAYPOINTS, messages.append)
    np.testing.assert_array_equal(again.codes, first.codes)
    assert again.digest == first.digest


def test_turned_copies_are_for_training_alone(data, arm):
    encoder = load_encoder(data.parent / "encoder")
    messages = []
    plain = load_data(str(data), arm, encoder, WAYPOINTS, messages.append)
    turned = load_data(str(data), arm, encoder, WAYPOINTS, messages.append, turned_copies=2)
    assert turned.validation == plain.validation and len(turned) > len(plain)
    for split, more in zip(plain.split(10**6), turned.split(10**6), strict=True):
        apart = np.abs(split.q[:, None, :, 1:] - more.q[None, :, :, 1:]).max((2, 3))
        assert apart.min(axis=1).max() < 1e-5 and apart.min(axis=0).max() < 1e-5
    np.testing.assert_array_equal(plain.split(10**6)[1].q, turned.split(10**6)[1].q)


def test_splits_and_waypoints(data, arm):
    """Training and validation share no scene, the test split is left out, and waypoints are resampled."""
    loaded = load_data(str(data), arm, load_encoder(data.parent / "encoder"), WAYPOINTS, print)
    train, validation = loaded.split(1000)
    assert set(split_of(train.scenes)) == {0}
    assert set(split_of(validation.scenes)) == {1}
    assert 120 < len(train) + len(validation) == len(loaded) < 160
    assert len(loaded.split(2)[1]) == 2
    assert train.q.shape[1:] == (WAYPOINTS, arm.dof)


@pytest.mark.parametrize("case", ["none", "damaged", "robot"])
def test_bad_data_give_one_line(case, data, arm):
    message = {
        "none": "holds no shard",
        "damaged": r"shard_00001\.zarr",
        "robot": "use the robot of the data",
    }
    if case == "none":
        for i in (0, 1):
            shutil.rmtree(shard_path(data, i))
    elif case == "damaged":
        shutil.rmtree(shard_path(data, 1) / "line_free")
    robot = replace(arm, spheres={}) if case == "robot" else arm
    with pytest.raises(InputError, match=message[case]) as caught:
        load_data(str(data), robot, load_encoder(data.parent / "encoder"), WAYPOINTS, print)
    assert "\n" not in str(caught.value)
