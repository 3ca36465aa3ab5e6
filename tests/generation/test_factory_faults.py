"""The data factory killed, stopped, out of room: what is finished stays, the rest is made again."""

import multiprocessing
import os
import random
import re
import resource
import signal
import time
from pathlib import Path

import pytest

from helpers.factory_runs import (
    contents,
    group_ends,
    in_this_process,
    members,
    shards,
    start,
    wait_for_shards,
)
from robotdiffuse.core.errors import InputError, OutputError
from robotdiffuse.generation import GenerationSettings, factory, generate

TRAJECTORIES = 54
SHARD = 3
WAYPOINTS = 16
SHARDS = TRAJECTORIES // SHARD
SETTINGS = GenerationSettings(trajectories=TRAJECTORIES, shard=SHARD, waypoints=WAYPOINTS)


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    out = tmp_path_factory.mktemp("undisturbed")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(factory, "on_this_machine", in_this_process)
        generate(SETTINGS, out)
    assert shards(out) == SHARDS
    return contents(out)


@pytest.mark.slow
def test_killed_at_a_random_moment_it_ends_in_the_same_data(
    undisturbed: dict[str, bytes], tmp_path: Path
) -> None:
    run = start(tmp_path, TRAJECTORIES, SHARD, WAYPOINTS, 2)
    wait_for_shards(run, tmp_path, 1)
    time.sleep(random.uniform(0, 0.1))
    assert len(members(run.pid)) >= 2, "the command and a worker; the other may be at its start or end"
    run.kill()
    run.communicate(timeout=500)
    assert run.returncode == -signal.SIGKILL and shards(tmp_path) < SHARDS
    assert group_ends(run.pid), "workers outlive the command"
    run = start(tmp_path, TRAJECTORIES, SHARD, WAYPOINTS, 2)
    said, complaints = run.communicate(timeout=400)
    assert run.returncode == 0 and re.fullmatch(rf"trajectories: \d+ of {TRAJECTORIES}\n", complaints)
    assert said == f"{TRAJECTORIES} trajectories of {WAYPOINTS} waypoints in {tmp_path}\n"
    assert contents(tmp_path) == undisturbed
    assert group_ends(run.pid)


@pytest.mark.slow
@pytest.mark.parametrize("count", [0, 1])
def test_ctrl_c_stops_all_in_one_line(count: int, tmp_path: Path) -> None:
    """As a terminal does it, to all processes: while the workers start, and while they work."""
    run = start(tmp_path, TRAJECTORIES, SHARD, WAYPOINTS, 2)
    while len(members(run.pid)) < 3:
        assert run.poll() is None
        time.sleep(0.02)
    wait_for_shards(run, tmp_path, count)
    os.killpg(run.pid, signal.SIGINT)
    said, complaints = run.communicate(timeout=500)
    assert (run.returncode, said) == (130, "")
    assert re.fullmatch(rf"(trajectories: 0 of {TRAJECTORIES}\n)?robotdiffuse: stopped\n", complaints)
    assert group_ends(run.pid)
    assert shards(tmp_path) < SHARDS
    assert not [name for name in contents(tmp_path) if name.startswith(".")]


@pytest.mark.slow
def test_a_full_disk_is_one_line_and_leaves_nothing_half_written(
    undisturbed: dict[str, bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Files may not grow beyond a kilobyte: the system's error, as that of a full disk, at any file."""
    monkeypatch.setattr(factory, "on_this_machine", in_this_process)
    most = resource.getrlimit(resource.RLIMIT_FSIZE)

    def fill_up(done: int, _total: int) -> None:
        if done == 2 * SHARD:
            resource.setrlimit(resource.RLIMIT_FSIZE, (1000, most[1]))

    try:
        with pytest.raises(OutputError, match=r"shard_00002\.zarr cannot be written: File too large$"):
            generate(SETTINGS, tmp_path, progress=fill_up)
        assert shards(tmp_path) == 2 and len(list(tmp_path.iterdir())) == 3
        with pytest.raises(OutputError, match=r"manifest\.json.*: File too large$"):
            generate(SETTINGS, tmp_path / "other")
        assert not list((tmp_path / "other").iterdir())
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, most)
    (tmp_path / "other").rmdir()
    generate(SETTINGS, tmp_path)
    assert contents(tmp_path) == undisturbed


@pytest.mark.slow
def test_a_worker_killed_from_outside_is_one_line_and_the_next_call_goes_on(
    undisturbed: dict[str, bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def kill(done: int, _total: int) -> None:
        if done == SHARD:
            worker = multiprocessing.active_children()[0]
            os.kill(worker.pid or 0, signal.SIGKILL)

    with pytest.raises(InputError, match=r"worker process was killed.*run the same command again$"):
        generate(SETTINGS, tmp_path, workers=2, progress=kill)
    assert 0 < shards(tmp_path) < SHARDS
    monkeypatch.setattr(factory, "on_this_machine", in_this_process)
    generate(SETTINGS, tmp_path)
    assert contents(tmp_path) == undisturbed
