"""The data factory, the bench and plan_many on Ray: the data stay the same while nodes join and leave."""

import os
import socket
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from helpers.factory_runs import contents, in_this_process
from helpers.refusals import refuses
from robotdiffuse.evaluation.bench import BenchSettings, run_bench
from robotdiffuse.evaluation.runs import read_records
from robotdiffuse.generation import GenerationSettings, factory, generate
from robotdiffuse.planning import load_planner, plan_many
from robotdiffuse.problems.files import held_out_problem

# read when ray is imported: no telemetry, and no pages of logs when a node is lost
os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
os.environ["RAY_DEDUP_LOGS_SKIP_REGEX"] = "Raylet is terminated"
ray: Any = pytest.importorskip("ray", reason="the extra `cluster` (ray) is not installed")
cluster_utils: Any = pytest.importorskip("ray.cluster_utils")
pytestmark = pytest.mark.cluster
SETTINGS = GenerationSettings(trajectories=24, shard=2, waypoints=16)
STORE = 80 * 2**20
"""Smallest object store of a node, about [bytes]."""
SYSTEM = {"health_check_period_ms": 500, "health_check_timeout_ms": 3000, "worker_niceness": 0}
"""A node that is gone is missed at once, not after some times 3 seconds; Ray's workers, at niceness 15 by
default, get their share of a machine that others use, too."""


@pytest.fixture(scope="module")
def head() -> Iterator[Any]:
    of_head = {"num_cpus": 1, "include_dashboard": False, "_system_config": SYSTEM}
    made = cluster_utils.Cluster(initialize_head=True, head_node_args=of_head | {"object_store_memory": STORE})
    yield made
    made.shutdown()


@pytest.fixture
def cluster(head: Any, monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.setenv("RAY_ADDRESS", head.address)
    return head


@pytest.mark.slow
def test_a_node_killed_midway_changes_nothing(cluster, tmp_path, monkeypatch):
    node = cluster.add_node(num_cpus=1, object_store_memory=STORE)
    cluster.wait_for_nodes()
    begun = threading.Event()
    seen = []

    def kill() -> None:
        begun.wait()
        cluster.remove_node(node, allow_graceful=False)

    def progress(done: int, _total: int) -> None:
        seen.append(done)
        if done:
            begun.set()

    killer = threading.Thread(target=kill)
    killer.start()
    try:
        assert generate(SETTINGS, tmp_path / "ray", cluster="ray", progress=progress) == 24
    finally:
        begun.set()
        killer.join()
    assert seen == list(range(0, 25, 2)) and not ray.is_initialized()
    assert len(cluster.list_all_nodes()) == 1
    # nodes that make other data are refused, by what differs
    older = factory.versions() | {"numba": "0.1"}
    monkeypatch.setattr(factory, "versions", lambda: older)
    refuses(r"node of the Ray cluster has numba .*, this machine 0\.1", generate, SETTINGS, tmp_path / "other", cluster="ray")
    monkeypatch.undo()
    monkeypatch.setattr(factory, "on_this_machine", in_this_process)
    generate(SETTINGS, tmp_path / "here")
    assert contents(tmp_path / "ray") == contents(tmp_path / "here")


def test_clusters_that_nobody_listens_at_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        for address in (f"127.0.0.1:{taken.getsockname()[1]}", "nonsense", "127.0.0.1:70000"):
            monkeypatch.setenv("RAY_ADDRESS", address)
            refuses(f"no Ray cluster.*{address}", generate, SETTINGS, tmp_path, cluster="ray")


@pytest.mark.slow
def test_bench_on_a_cluster_is_as_on_this_machine(cluster: Any, tmp_path: Path) -> None:
    asked = BenchSettings(("rrt_connect",), ("rop",), tmp_path, time_limit=60.0, count=2, cluster="ray")
    assert run_bench(asked, print, print) == 2
    assert run_bench(replace(asked, cluster=None), print, print) == 0
    there = read_records(tmp_path)["rrt_connect"]
    assert run_bench(replace(asked, cluster=None, out=tmp_path / "here"), print, print) == 2
    here = read_records(tmp_path / "here")["rrt_connect"]
    assert [record.positions for record in sorted(there, key=lambda r: r.name)] == [r.positions for r in here]


@pytest.mark.slow
def test_many_problems_with_a_node_killed_are_as_on_this_machine(cluster, monkeypatch):
    monkeypatch.setattr(plan_many, "PROBLEMS_PER_TASK", 1)
    node = cluster.add_node(num_cpus=1, object_store_memory=STORE)
    cluster.wait_for_nodes()
    problems = [held_out_problem("rop", i) for i in range(6)]
    found = plan_many.plan_many(problems, "straight_line", cluster="ray", time_limit=60.0)
    results = [next(found)]
    cluster.remove_node(node, allow_graceful=False)
    results += found
    planner = load_planner("straight_line")
    for problem, result in zip(problems, results, strict=True):
        assert result.problem is problem
        alone = planner.plan(problem, 60.0)
        assert (result.status, result.path_length) == (alone.status, alone.path_length)
