"""The data set and the encoder of the tests of training."""

import shutil

import numpy as np
import pytest
import torch

from helpers.box_arm import box_arm
from helpers.small_model import SMALL_ENCODER
from helpers.stores import WAYPOINTS as STORED, manifest_of, random_arrays
from robotdiffuse.datasets.shards import write_manifest, write_shard
from robotdiffuse.learning.checkpoint import save_network
from robotdiffuse.learning.encoders.networks import PointAutoencoder
from robotdiffuse.learning.training import tasks as training
from robotdiffuse.scenes.packed_scenes import SPHERE


@pytest.fixture
def arm(monkeypatch):
    robot = box_arm()
    monkeypatch.setattr(training, "load_robot", lambda name: robot)
    return robot


@pytest.fixture(scope="module")
def stored(tmp_path_factory):
    """Motions that bend towards the side of the obstacle, which is too far away to change clearances; and an encoder."""
    home = tmp_path_factory.mktemp("stored")
    arm = box_arm()
    rng = np.random.default_rng(0)
    folder = home / "data"
    write_manifest(folder, manifest_of(arm))
    for i, n in enumerate((100, 60)):
        side = rng.choice([-1.0, 1.0], n)
        ends = rng.uniform(-1.5, 1.5, (2, n, 1, arm.dof))
        s = np.linspace(0, 1, STORED)[:, None]
        q = ends[0] * (1 - s) + ends[1] * s + 0.5 * side[:, None, None] * np.sin(np.pi * s)
        arrays = random_arrays(arm, n, rng)
        kinds, params = (np.zeros_like(arrays[name]) for name in ("obstacle_kinds", "obstacle_params"))
        kinds[:, 0] = SPHERE
        params[:, 0, :4] = np.stack([0.01 * rng.random(n), 0.5 * side, 0 * side + 1, 0 * side + 0.2], -1)
        arrays |= {"trajectories": q, "obstacle_kinds": kinds, "obstacle_params": params}
        write_shard(folder, i, arrays, {})
    torch.manual_seed(0)
    save_network("encoder", PointAutoencoder(SMALL_ENCODER), home / "encoder", {})
    return home


@pytest.fixture
def data(tmp_path, arm, stored):
    shutil.copytree(stored, tmp_path, dirs_exist_ok=True)
    return tmp_path / "data"
