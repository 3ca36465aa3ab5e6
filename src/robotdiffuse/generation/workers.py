"""Who makes shards: processes of this machine, or a Ray cluster. Either yields them as they are done."""

import logging
import multiprocessing
import os
import platform
import signal
import socket
import threading
import time
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import replace
from importlib.metadata import version
from multiprocessing import resource_tracker
from pathlib import Path
from typing import Any

from robotdiffuse import __version__
from robotdiffuse.errors import InputError
from robotdiffuse.generation.settings import GenerationSettings
from robotdiffuse.generation.shard_maker import Arrays, Counts, make_shard
from robotdiffuse.robots import load_robot
from robotdiffuse.robots.fingerprint import robot_fingerprint

Made = Generator[tuple[int, tuple[Arrays, Counts]], None, None]
PACKAGES = ("numpy", "numba", "zarr")
CONNECT_SECONDS = 5.0
"""Until a Ray cluster that does not answer is given up; Ray itself tries for minutes."""
GONE_SECONDS = 5.0
"""Until a process that was told to end is not waited for any more."""
LOST_NODES = 20
"""Times that a shard is begun again on another node of a Ray cluster."""
GO_ON = "what is finished is kept, the same command goes on"


def versions() -> dict[str, str]:
    """What the data may differ by, besides the settings and the robot."""
    return {"robotdiffuse": __version__, "python": platform.python_version()} | {
        name: version(name) for name in PACKAGES
    }


def on_this_machine(settings: GenerationSettings, indices: list[int], workers: int) -> Made:
    """Shards made by `workers` processes; at most one more than that is being made or waits to be written.

    Raises InputError if a process is killed from outside, as when memory runs out.
    """
    # fresh interpreters: forked ones could inherit locks of running threads
    context = multiprocessing.get_context("spawn")
    queue = list(reversed(indices))
    pool = ProcessPoolExecutor(min(workers, len(indices)), context, initializer=prepare_worker)
    running = {}
    try:
        while queue or running:
            while queue and len(running) < workers + 1:
                index = queue.pop()
                with interrupts_not_passed_on():
                    running[pool.submit(make_shard, settings, index)] = index
            for job in wait(running, return_when=FIRST_COMPLETED).done:
                yield running.pop(job), job.result()
    except BrokenProcessPool:
        raise InputError(f"a worker process was killed, or could not be started; {GO_ON}") from None
    finally:
        stop_pool(pool)


@contextmanager
def interrupts_not_passed_on() -> Iterator[None]:
    """Ctrl-C never reaches processes that are started meanwhile: they inherit the signal mask.

    So it is the parent alone that handles it, even while workers are still importing.
    """
    resource_tracker.ensure_running()  # the first process starts it, which would lift the mask again
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def stop_pool(pool: ProcessPoolExecutor, patience: float = 0.0) -> None:
    """Tell the processes to end; kill those that have not after `patience` [s]."""
    processes = list((pool._processes or {}).values())
    pool.shutdown(wait=False, cancel_futures=True)
    for process in processes:
        process.terminate()
    until = time.monotonic() + patience
    for process in processes:
        process.join(max(until - time.monotonic(), 0.0))
        if patience > 0 and process.is_alive():
            process.kill()
    for process in processes:
        process.join(GONE_SECONDS)


def prepare_worker() -> None:
    """A worker ends with its parent, even where that is killed."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def on_ray(settings: GenerationSettings, indices: list[int]) -> Made:
    """Shards made as tasks of one core each by a Ray cluster; those of a lost node are made again elsewhere.

    See `ray_cluster`. The nodes need the same versions of this package and of what it computes with; where
    the robot is a URDF, at the same place. Raises InputError if they do not fit.
    """
    if Path(settings.robot).exists():
        # nodes have other working folders
        settings = replace(settings, robot=str(Path(settings.robot).resolve()))
    here = _bearings(settings)
    queue, running = list(reversed(indices)), {}
    with ray_cluster() as ray:
        task = ray.remote(num_cpus=1, max_retries=LOST_NODES)(_make_on_node)
        while queue or running:
            most = 2 * max(1, int(ray.cluster_resources().get("CPU", 0)))
            while queue and len(running) < most:
                index = queue.pop()
                running[task.remote(settings, index, here)] = index
            done, _ = ray.wait(list(running), num_returns=1)
            for reference in done:
                yield running.pop(reference), ray.get(reference)


@contextmanager
def ray_cluster() -> Iterator[Any]:
    """The module ray, connected to the cluster that RAY_ADDRESS names, or to one started here with all cores.

    Raises InputError if Ray is not installed, its cluster cannot be reached or fails, and for an InputError
    of a task or a node without this package.
    """
    # read when ray is imported: messages on a lost node are pages long, but for the one on the task
    os.environ.setdefault("RAY_DEDUP_LOGS_SKIP_REGEX", "Raylet is terminated")
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    try:
        import ray
        from ray.exceptions import RayError, RayTaskError
    except ImportError:
        raise InputError('a Ray cluster needs ray: pip install "robotdiffuse[cluster]"') from None
    ours = not ray.is_initialized()
    if ours:
        _check_reachable(os.environ.get("RAY_ADDRESS", ""))
    connected = False
    try:
        if ours:
            ray.init(log_to_driver=False, logging_level=logging.CRITICAL)
        connected = True
        yield ray
    except RayTaskError as error:
        if isinstance(error.cause, InputError):
            raise InputError(str(error.cause)) from None
        if "No module named 'robotdiffuse'" in str(error):
            raise InputError(
                f"a node of the Ray cluster cannot import robotdiffuse; install {__version__} on all"
            ) from None
        raise
    except RayError as error:
        raise InputError(f"the Ray cluster failed: {_line(error)}; {GO_ON}") from None
    except (ConnectionError, RuntimeError, ValueError) as error:
        if connected:
            raise
        raise InputError(f"no Ray cluster: {_line(error)}") from None
    finally:
        if ours:
            ray.shutdown()


def _make_on_node(settings: GenerationSettings, index: int, wanted: dict[str, str]) -> tuple[Arrays, Counts]:
    for name, found in _bearings(settings).items():
        if found != wanted[name]:
            raise InputError(
                f"a node of the Ray cluster has {name} {found}, this machine {wanted[name]}; their data may "
                "differ: install the same on all"
            )
    return make_shard(settings, index)


def _bearings(settings: GenerationSettings) -> dict[str, str]:
    """What two machines must have in common to make the same data."""
    return versions() | {f"robot {settings.robot}": robot_fingerprint(load_robot(settings.robot))}


def _check_reachable(address: str) -> None:
    """Raises InputError if nobody listens where the address HOST:PORT or ray://HOST:PORT says."""
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if not host or not port.isdecimal():
        return
    try:
        socket.create_connection((host.strip("[]"), int(port)), CONNECT_SECONDS).close()
    except (OSError, OverflowError) as error:
        raise InputError(f"no Ray cluster at {address}, where RAY_ADDRESS says: {error}") from None


def _line(error: Exception) -> str:
    return " ".join(str(error).split())


CLUSTERS: dict[str, Callable[[GenerationSettings, list[int]], Made]] = {"ray": on_ray}
"""By the name that --cluster takes."""
