"""Who makes a bench's calls: processes of this machine, or a Ray cluster. Either yields records."""

import threading
from collections.abc import Generator
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass
from pathlib import Path as FilePath
from tempfile import TemporaryDirectory
from typing import Any

from robotdiffuse.evaluation.bench.planner_process import Contestant, PlannerProcess
from robotdiffuse.evaluation.bench.records import Record, record_from_json
from robotdiffuse.generation.workers import ray_cluster
from robotdiffuse.problems.files import problem_record
from robotdiffuse.problems.held_out import Case

Made = Generator[Record, None, None]
CHUNK = 20
"""Calls of one planner that a node of a cluster makes in one go, with one start of the process."""


@dataclass(frozen=True)
class Task:
    """A call that is still to be made."""

    case: Case
    seed: int
    time_limit: float


def record_of(planner: Contestant, task: Task, answer: dict[str, Any]) -> Record:
    """The record of a task and of the answer of a planner's process."""
    case = task.case
    about = {
        "planner": planner.label,
        "problem_set": case.problem_set,
        "name": case.name,
        "family": case.family,
        "trivial": case.trivial,
        "seed": task.seed,
        "time_limit": task.time_limit,
    }
    return record_from_json(about | answer)


def on_this_machine(tasks: dict[Contestant, list[Task]], workers: int, logs: FilePath) -> Made:
    """Calls by a process for each planner, `workers` of them at a time; what they print goes to `logs`."""
    stop, news, ready = threading.Event(), threading.Condition(), list[Record]()
    processes: list[PlannerProcess] = []

    def work(planner: Contestant) -> None:
        process = PlannerProcess(planner, logs / f"{planner.label}.log")
        processes.append(process)
        for task in tasks[planner]:
            if stop.is_set():
                return
            answer = process.plan(problem_record(task.case.problem), task.seed, task.time_limit)
            with news:
                if not stop.is_set():  # else it is the stop that ended the call
                    ready.append(record_of(planner, task, answer))
                news.notify()
        process.close()

    pool = ThreadPoolExecutor(workers)
    jobs = {pool.submit(work, planner) for planner in tasks}
    try:
        while jobs or ready:
            with news:
                news.wait_for(lambda: bool(ready), timeout=0.2)
                records, ready[:] = list(ready), []
            yield from records
            finished, jobs = wait(jobs, timeout=0)
            for job in finished:
                job.result()
    finally:
        stop.set()
        for process in processes:
            process.close()
        pool.shutdown(cancel_futures=True)


def on_ray(tasks: dict[Contestant, list[Task]], logs: FilePath) -> Made:
    """Calls in portions, each by a process of its own on a node of a Ray cluster; see `ray_cluster`.

    The nodes need this package, and weights and files at the same places.
    """
    portions = [(name, of[i : i + CHUNK]) for name, of in tasks.items() for i in range(0, len(of), CHUNK)]
    with ray_cluster() as ray:
        remote = ray.remote(num_cpus=1)(_portion)
        running = [remote.remote(planner, portion) for planner, portion in portions]
        while running:
            done, running = ray.wait(running, num_returns=1)
            for reference in done:
                records, said = ray.get(reference)
                if said:
                    logs.mkdir(parents=True, exist_ok=True)
                    with (logs / f"{records[0].planner}.log").open("a") as log:
                        log.write(said)
                yield from records


def _portion(planner: Contestant, tasks: list[Task]) -> tuple[list[Record], str]:
    """Records of the tasks, and what the planner printed."""
    with TemporaryDirectory() as folder:
        log = FilePath(folder) / "log"
        process = PlannerProcess(planner, log)
        try:
            answers = [
                process.plan(problem_record(task.case.problem), task.seed, task.time_limit) for task in tasks
            ]
        finally:
            process.close()
        records = [record_of(planner, *pair) for pair in zip(tasks, answers, strict=True)]
        return records, log.read_text(errors="replace")
