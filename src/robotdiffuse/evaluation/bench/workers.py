"""Who makes a bench's calls: processes of this machine, or a Ray cluster."""

import threading
from collections import deque
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from pathlib import Path as FilePath
from tempfile import TemporaryDirectory

from robotdiffuse.core import processes
from robotdiffuse.evaluation.bench.planner_process import PlannerProcess
from robotdiffuse.evaluation.bench.planner_spec import PlannerSpec
from robotdiffuse.evaluation.records import RESTARTED, Record
from robotdiffuse.evaluation.runs import Executor, Fields, Made, Run

CHUNK = 20
"""Calls of one planner that a node of a cluster makes in one go, with one start of the process."""
PlannerSpecs = Mapping[str, PlannerSpec]
"""By their labels, which are the methods of runs."""


def on_this_machine(
    specs: PlannerSpecs, workers: int, restarts: bool, session: str, logs: FilePath
) -> Executor:
    """A process for each spec, so many calls at a time; what they print goes to `logs`.

    All processes are warmed up before the first call is timed, and take turns: all planners are timed while
    as much else goes on.
    """
    about = {"run": session, "workers": workers}

    def execute(runs: Sequence[Run]) -> Made:
        stop, news, ready = threading.Event(), threading.Condition(), deque[tuple[Run, list[Record]]]()
        todo: deque[Run] = deque(runs)
        first = {run.method: run for run in reversed(runs)}
        planners = {
            label: PlannerProcess(specs[label], logs / f"{label.replace('/', '_')}.log") for label in first
        }
        idle = set(planners)

        def next_run() -> Run | None:
            """The first one whose planner is idle; None when there is nothing left to do."""
            with news:
                while todo and not stop.is_set():
                    for i, run in enumerate(todo):
                        if run.method in idle:
                            del todo[i]
                            idle.remove(run.method)
                            return run
                    news.wait()
            return None

        def work() -> None:
            while (run := next_run()) is not None:
                answers = planners[run.method].plan(run, restarts)
                with news:
                    if not stop.is_set():  # else it is the stop that ended the call
                        ready.append((run, records_of(run, answers, about)))
                    idle.add(run.method)
                    news.notify_all()

        pool = ThreadPoolExecutor(workers)
        try:
            jobs = {pool.submit(planners[label].warm, run) for label, run in first.items()}
            while jobs:
                jobs = wait(jobs, timeout=0.2).not_done
            jobs = {pool.submit(work) for _ in range(workers)}
            while jobs or ready:
                with news:
                    news.wait_for(lambda: bool(ready), timeout=0.2)
                    made = list(ready)
                    ready.clear()
                yield from made
                finished, jobs = wait(jobs, timeout=0)
                for job in finished:
                    job.result()
        finally:
            stop.set()
            with news:
                news.notify_all()
            for process in planners.values():
                process.close()
            pool.shutdown(cancel_futures=True)

    return execute


def records_of(run: Run, answers: Sequence[Fields], about: Fields) -> list[Record]:
    """Those after the first are of restarts."""
    labels = (run.method, run.method + RESTARTED)
    found = zip(labels, answers, strict=False)
    return [run.record({"planner": label, **about, **answer}) for label, answer in found]


def on_ray(specs: PlannerSpecs, restarts: bool, session: str, logs: FilePath) -> Executor:
    """Calls in portions, each by a process of its own on a node of a Ray cluster; see `processes.on_ray`.

    The nodes need this package, and weights and files at the same places.
    """
    about = {"run": session, "workers": "ray"}

    def execute(runs: Sequence[Run]) -> Made:
        of = {label: [run for run in runs if run.method == label] for label in specs}
        portions = [(label, t[i : i + CHUNK]) for label, t in of.items() for i in range(0, len(t), CHUNK)]
        calls = [(specs[label], portion, restarts) for label, portion in portions]
        for number, (answers, said) in processes.on_ray(_portion, calls):
            label, portion = portions[number]
            if said:
                logs.mkdir(parents=True, exist_ok=True)
                with (logs / f"{label.replace('/', '_')}.log").open("a") as log:
                    log.write(said)
            for run, answer in zip(portion, answers, strict=True):
                yield run, records_of(run, answer, about)

    return execute


def _portion(spec: PlannerSpec, runs: list[Run], restarts: bool) -> tuple[list[list[Fields]], str]:
    """The answers to the runs, and what the planner printed."""
    with TemporaryDirectory() as folder:
        log = FilePath(folder) / "log"
        process = PlannerProcess(spec, log)
        try:
            answers = [process.plan(run, restarts) for run in runs]
        finally:
            process.close()
        return answers, log.read_text(errors="replace")
