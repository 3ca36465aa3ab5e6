"""The data set on disk: same bytes for the same arrays, no partial files, one-line errors for damage."""

import json
import os
import shutil
import signal
import sys
from dataclasses import replace

import numpy as np
import pytest
import zarr

from helpers.box_arm import box_arm
from helpers.changes import later
from helpers.commands import python
from helpers.factory_runs import contents
from helpers.full_disk import full_disk
from helpers.refusals import refuses
from helpers.stores import manifest_of, random_arrays, write_store
from robotdiffuse.core.errors import OutputError
from robotdiffuse.datasets import shards
from robotdiffuse.datasets.external import import_npz
from robotdiffuse.robots import load_robot
from robotdiffuse.robots.robot import robot_fingerprint
from robotdiffuse.scenes.packed_scenes import PackedScenes

ARM = box_arm()
WAYPOINTS = 12


def random(count):
    return random_arrays(ARM, count, np.random.default_rng(0), WAYPOINTS)


@pytest.fixture
def arrays():
    return random(7)


@pytest.fixture
def store(tmp_path):
    write_store(tmp_path, ARM, (7, 3), WAYPOINTS)
    return tmp_path


def test_what_is_written_is_read(tmp_path, arrays):
    shards.write_shard(tmp_path, 3, arrays, {"tried": 9, "solved": 7})
    shard = shards.read_shard(tmp_path, 3)
    assert len(shard) == 7 and shard.counts == {"tried": 9, "solved": 7}
    assert set(shard.arrays) == shards.ARRAYS.keys() - {"times"}
    for name, array in arrays.items():
        assert shard[name].dtype == np.dtype(shards.ARRAYS[name][0])
        np.testing.assert_array_equal(shard[name], array)
    assert isinstance(shard["trajectories"], np.memmap)
    assert not shard["trajectories"].flags.writeable
    assert set(shards.read_shard(tmp_path, 3, ("cost", "seed")).arrays) == {"cost", "seed"}
    assert shards.shard_indices(tmp_path) == [3]
    shards.check_shard(tmp_path, 3, manifest_of(ARM, WAYPOINTS))
    group = zarr.open_group(shards.shard_path(tmp_path, 3), mode="r")
    assert group.metadata.zarr_format == 3 and group.attrs["format"] == 1, "plain zarr"
    for name, array in group.arrays():
        assert array.nchunks == 1 and (array.compressors == ()) == (name == "trajectories"), name


def test_times_and_no_rows(tmp_path, arrays):
    timed = {name: array[:0] for name, array in arrays.items()} | {"times": np.zeros((0, WAYPOINTS))}
    shards.write_shard(tmp_path, 0, timed, {})
    shard = shards.check_shard(tmp_path, 0, manifest_of(ARM, WAYPOINTS, timing="time"))
    assert len(shard) == 0 and shard["trajectories"].shape == (0, WAYPOINTS, ARM.dof)
    untimed = manifest_of(ARM, WAYPOINTS)
    refuses("array times: it must exist if timing is time, and only then", shards.check_shard, tmp_path, 0, untimed)


def test_same_arrays_same_bytes_or_none_where_arrays_do_not_fit(tmp_path, arrays):
    counts = {"tried": 2, "solved": 1}
    shards.write_shard(tmp_path / "a", 0, arrays, counts)
    shards.write_shard(tmp_path / "b", 0, dict(reversed(arrays.items())), dict(reversed(counts.items())))
    shards.write_shard(tmp_path / "b", 0, arrays, counts)  # once more in its place
    for wrong, message in (({"costs": arrays["cost"]}, "'costs'"), ({"cost": arrays["cost"][:3]}, "unequal rows")):
        refuses(message, shards.write_shard, tmp_path / "b", 1, arrays | wrong, {})
    assert contents(tmp_path / "a") == contents(tmp_path / "b")
    assert [p.name for p in (tmp_path / "b").iterdir()] == ["shard_00000.zarr"]


def test_a_full_disk(tmp_path, arrays):
    """Regression: threads of zarr that wrote on after the error made the hidden folder again."""
    shards.write_shard(tmp_path, 0, arrays, {})
    before = contents(tmp_path)
    for index in (0, 1):
        with full_disk(300), pytest.raises(OutputError, match=rf"shard_0000{index}\.zarr cannot be written: File too large"):
            shards.write_shard(tmp_path, index, arrays, {})
    assert contents(tmp_path) == before
    assert [p.name for p in tmp_path.iterdir()] == ["shard_00000.zarr"]


def test_ctrl_c_waits_for_a_shard(tmp_path, arrays, monkeypatch):
    """Regression: within a call of zarr it left coroutines behind, which warned at the exit."""
    path = shards.shard_path
    monkeypatch.setattr(shards, "shard_path", lambda *of: signal.raise_signal(signal.SIGINT) or path(*of))
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # background jobs ignore it
    with pytest.raises(KeyboardInterrupt):
        shards.write_shard(tmp_path, 0, arrays, {})
    signal.signal(signal.SIGINT, before)
    assert shards.shard_indices(tmp_path) == [0]


@later
def rewrite(store, name, change):
    group = zarr.open_group(shards.shard_path(store, 0), mode="a")
    data = change(zarr.open_array(shards.shard_path(store, 0) / name)[...])
    group.create_array(name, data=data, chunks=data.shape, attributes=dict(group[name].attrs), overwrite=True)


def chunk(store, name):
    return next(p for p in (shards.shard_path(store, 0) / name / "c").rglob("*") if p.is_file())


@later
def change_bytes(store, name, change):
    file = chunk(store, name)
    file.write_bytes(change(file.read_bytes()))


@later
def relabel(store, **attributes):
    zarr.open_group(shards.shard_path(store, 0), mode="a").attrs.update(attributes)


def about(store, array="seed"):
    return shards.shard_path(store, 0) / array / "zarr.json"


@later
def describe(store, **values):
    about(store).write_text(json.dumps(json.loads(about(store).read_text()) | values))


ENDLESS = {"name": "regular", "configuration": {"chunk_shape": [10**15]}}
DAMAGE = [
    (
        "array trajectories holds numbers that are not finite",
        lambda store: shards.write_shard(store, 0, random(7) | {"trajectories": np.full((7, 12, 3), np.nan)}, {}),
    ),
    ("array goals: missing", lambda store: shutil.rmtree(shards.shard_path(store, 0) / "goals")),
    ("array trajectories is damaged: its chunk has 1,004 bytes", change_bytes("trajectories", lambda data: data[:-4])),
    ("array start is damaged", change_bytes("start", lambda data: data[:-4])),
    ("array cost is damaged: a chunk is missing", lambda store: chunk(store, "cost").unlink()),
    ("array seed is damaged", lambda store: about(store).write_text("{")),
    ("array seed is damaged", lambda store: about(store).unlink()),
    (r"shard .*shard_00000\.zarr is damaged", lambda store: about(store, "").write_text("{")),
    ("is damaged: its arrays have unequal numbers of rows", rewrite("detour", lambda a: a[:-1])),
    ("array detour is <f8 with 1 axes; it must be <f4 with 1", rewrite("detour", lambda a: a.astype(np.float64))),
    (
        r"array obstacle_params has rows of shape \(4, 9\); the manifest says \(4, 10\)",
        rewrite("obstacle_params", lambda a: a[..., :9]),
    ),
    (
        "is damaged: its fingerprint is not that of its arrays",
        change_bytes("trajectories", lambda a: a[:50] + bytes([a[50] ^ 1]) + a[51:]),
    ),
    ("format is 2; this version reads 1", relabel(format=2)),
    ("is damaged: its attributes are not those of shard 0", relabel(index=4)),
    ("array seed is damaged", describe(shape=[10**30])),
    ("array seed is damaged: a chunk is missing", describe(shape=[10**15])),
    ("array seed is damaged", describe(shape=[10**15], chunk_grid=ENDLESS)),
]


@pytest.mark.parametrize(("message", "damage"), DAMAGE)
def test_damage_gives_one_line(store, message, damage):
    damage(store)
    assert "shard_00000.zarr" in refuses(message, shards.check_shard, store, 0, shards.read_manifest(store))
    shards.check_shard(store, 1, shards.read_manifest(store))


def test_manifest(tmp_path):
    refuses(r"there is no .*manifest\.json; make one with: robotdiffuse data", shards.read_manifest, tmp_path / "nothing")
    manifest = manifest_of(ARM)
    shards.write_manifest(tmp_path, manifest)
    assert shards.read_manifest(tmp_path) == manifest
    data = json.loads((tmp_path / "manifest.json").read_text())
    assert (data["format"], data["dof"], data["waypoints"]) == (1, 3, 254)
    for change, message in [
        ({"format": 2}, r"manifest\.json: format is 2; this version reads 1"),
        ({"wings": 2}, r"manifest\.json is damaged: .*wings"),
        ({"lower": [0.0]}, r"manifest\.json is damaged: joint_names, lower and upper"),
        ({"floors": {}}, r"manifest\.json is damaged: floors names \[\], but families \['rop'\]"),
        ({"floors": {"rop": {"size": [2.0, 2.0, 0.1]}}}, r"manifest\.json is damaged: .*center"),
    ]:
        (tmp_path / "manifest.json").write_text(json.dumps(data | change))
        refuses(message, shards.read_manifest, tmp_path)


@pytest.mark.parametrize("value", [None, [], {}, [[]], {"a": 1}, "", -1, 10**30])
def test_values_of_the_wrong_type_in_a_manifest_are_damage(tmp_path, value):
    """Regression: a list as the name of the robot, or a list of families, ended `data check` with a traceback."""
    shards.write_manifest(tmp_path, manifest_of(ARM))
    file = tmp_path / "manifest.json"
    data = json.loads(file.read_text())
    fits = {"dof"}  # which is told from the names of the joints
    fits |= {name for name in data if type(value) is type(data[name]) and value in (10**30, "", {"a": 1}, {})}
    for name in data.keys() - fits:
        file.write_text(json.dumps(data | {name: value}))
        refuses(r"manifest\.json( is damaged)?: ", shards.read_manifest, tmp_path)


def test_the_robot_must_be_that_of_the_data_by_its_fingerprint():
    code = "import robotdiffuse.robots as r\nprint(r.robot.robot_fingerprint(r.load_robot('panda')))"
    panda = load_robot("panda")
    mine = robot_fingerprint(panda)
    assert python(code).stdout.strip() == mine and len(mine) == 16
    slower = tuple(replace(joint, velocity=1.0) for joint in panda.joints)
    others = [replace(panda, joints=slower), replace(panda, meshes={}), load_robot("panda").with_locked({})]
    assert [robot_fingerprint(other) == mine for other in others] == [False, False, True]
    manifest = manifest_of(panda)
    manifest.check_robot(replace(panda, name="renamed"))
    refuses(r"the data are of the robot .* use the robot of the data", manifest.check_robot, others[0])


def test_splits_keep_scenes_together():
    rng = np.random.default_rng(0)
    arrays = random_arrays(ARM, 4000, rng, 2)
    scenes = PackedScenes(arrays["obstacle_kinds"], arrays["obstacle_params"])
    split = shards.split_of(scenes)
    shares = np.bincount(split, minlength=len(shards.SPLITS)) / len(split)
    # three standard errors of 5 % of 4000
    np.testing.assert_allclose(shares, [0.9, 0.05, 0.05], atol=3 * np.sqrt(0.05 * 0.95 / 4000))
    order = rng.permutation(4000)
    np.testing.assert_array_equal(shards.split_of(scenes[order]), split[order])


def test_without_zarr(tmp_path, arrays, monkeypatch):
    monkeypatch.setitem(sys.modules, "zarr", None)
    for call in (lambda: shards.write_shard(tmp_path, 0, arrays, {}), lambda: shards.read_shard(tmp_path, 0)):
        refuses(r'pip install "robotdiffuse\[data\]"', call)


@pytest.mark.parametrize("name", ["manifest.json", "shard_00000.zarr/seed/zarr.json", "robot.npz"])
def test_a_pipe_in_a_data_set_is_not_waited_for(tmp_path, arrays, name):
    """Regression: reading never ended."""
    shards.write_shard(tmp_path, 0, arrays, {})
    (tmp_path / name).unlink(missing_ok=True)
    os.mkfifo(tmp_path / name)
    out = tmp_path / "set"
    read = {"manifest.json": lambda: shards.read_manifest(tmp_path), "robot.npz": lambda: import_npz(tmp_path / name, out)}
    refuses(f"{name} cannot be read: it is a device or a pipe", read.get(name, lambda: shards.read_shard(tmp_path, 0)))
