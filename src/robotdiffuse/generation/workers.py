"""Who makes shards: processes of this machine, or a Ray cluster. Either yields them as they are done."""

import logging
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool

from robotdiffuse.errors import InputError
from robotdiffuse.generation.settings import GenerationSettings
from robotdiffuse.generation.shard_maker import Arrays, Counts, make_shard

Made = Iterator[tuple[int, tuple[Arrays, Counts]]]


def on_this_machine(settings: GenerationSettings, indices: list[int], workers: int) -> Made:
    """Shards made by `workers` processes; no more of them wait to be written than there are processes.

    Raises InputError if a process is killed from outside, as when memory runs out.
    """
    # fresh interpreters: forked ones could inherit locks of running threads
    context = multiprocessing.get_context("spawn")
    queue = list(reversed(indices))
    pool = ProcessPoolExecutor(min(workers, len(indices)), context, initializer=_prepare_worker)
    running = {}
    try:
        while queue or running:
            while queue and len(running) < workers + 1:
                index = queue.pop()
                running[pool.submit(make_shard, settings, index)] = index
            for job in wait(running, return_when=FIRST_COMPLETED).done:
                yield running.pop(job), job.result()
    except BrokenProcessPool:
        raise InputError(
            "a worker process was killed; the finished shards are kept, the same command goes on"
        ) from None
    finally:
        _stop(pool)


def _stop(pool: ProcessPoolExecutor) -> None:
    """End the processes now: what they are at is made again by the next call."""
    processes = list((pool._processes or {}).values())
    pool.shutdown(wait=False, cancel_futures=True)
    for process in processes:
        process.terminate()


def _prepare_worker() -> None:
    """Ctrl-C is the parent's to handle; a worker ends with it, even where it is killed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def on_ray(settings: GenerationSettings, indices: list[int]) -> Made:
    """Shards made as tasks of one core each by a Ray cluster; those of a lost node are made again elsewhere.

    Raises InputError if Ray is not installed or its cluster cannot be reached.
    """
    try:
        import ray
        from ray.exceptions import RayTaskError
    except ImportError:
        raise InputError('a Ray cluster needs ray: pip install "robotdiffuse[cluster]"') from None
    ours = not ray.is_initialized()
    if ours:
        try:
            ray.init(log_to_driver=False, logging_level=logging.ERROR)
        except (ConnectionError, RuntimeError, ValueError) as error:
            raise InputError(f"no Ray cluster: {' '.join(str(error).split())}") from None
    # -1: as often as nodes are lost
    task = ray.remote(num_cpus=1, max_retries=-1)(make_shard)
    queue, running = list(reversed(indices)), {}
    try:
        while queue or running:
            most = 2 * int(ray.cluster_resources().get("CPU", 1))
            while queue and len(running) < most:
                index = queue.pop()
                running[task.remote(settings, index)] = index
            done, _ = ray.wait(list(running), num_returns=1)
            for reference in done:
                yield running.pop(reference), ray.get(reference)
    except RayTaskError as error:
        if isinstance(error.cause, InputError):
            raise InputError(str(error.cause)) from None
        raise
    finally:
        if ours:
            ray.shutdown()


CLUSTERS: dict[str, Callable[[GenerationSettings, list[int]], Made]] = {"ray": on_ray}
"""By the name that --cluster takes."""
