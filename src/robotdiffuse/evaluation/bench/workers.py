"""Executors of a bench: processes of this machine, or a Ray cluster."""

import threading
from collections import deque
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from pathlib import Path as FilePath
from tempfile import TemporaryDirectory

from robotdiffuse.core.ray_cluster import CLUSTERS
from robotdiffuse.evaluation.bench.planner_process import PlannerProcess
from robotdiffuse.evaluation.bench.planner_spec import PlannerSpec
from robotdiffuse.evaluation.records import RESTARTED, Record
from robotdiffuse.evaluation.runs import Executor, Fields, Results, Run

RUNS_PER_TASK = 20
"""Runs of one planner that a node of a cluster makes with one start of the process."""
PlannerSpecs = Mapping[str, PlannerSpec]
"""By their labels, which are the methods of runs."""


def on_this_machine(
    specs: PlannerSpecs, workers: int, restarts: bool, session: str, logs: FilePath
) -> Executor:
    """An executor with a process for each planner, of which `workers` run at a time; `logs` gets what they
    print.

    All processes are warmed up before the first call is timed. They take turns, so that other work on the
    machine affects all planners alike.
    """
    about = {"run": session, "workers": workers}

    def execute(runs: Sequence[Run]) -> Results:
        stop, news, ready = threading.Event(), threading.Condition(), deque[tuple[Run, list[Record]]]()
        todo: deque[Run] = deque(runs)
        first = {run.method: run for run in reversed(runs)}
        planners = {
            label: PlannerProcess(specs[label], logs / f"{label.replace('/', '_')}.log") for label in first
        }
        idle = set(planners)

        def next_run() -> Run | None:
            """The first run whose planner is idle; None when none is left."""
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
                    if not stop.is_set():  # otherwise the stop ended the call
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
    """The records of a run; the second is that of restarts."""
    labels = (run.method, run.method + RESTARTED)
    found = zip(labels, answers, strict=False)
    return [run.record({"planner": label, **about, **answer}) for label, answer in found]


def on_cluster(specs: PlannerSpecs, cluster: str, restarts: bool, session: str, logs: FilePath) -> Executor:
    """An executor on a cluster, a name in `ray_cluster.CLUSTERS`, where each task starts a process for some
    runs.

    The nodes need this package, and weights and files at the same paths.
    """
    about = {"run": session, "workers": cluster}

    def execute(runs: Sequence[Run]) -> Results:
        of = {label: [run for run in runs if run.method == label] for label in specs}
        tasks = [
            (label, t[i : i + RUNS_PER_TASK])
            for label, t in of.items()
            for i in range(0, len(t), RUNS_PER_TASK)
        ]
        calls = [(specs[label], task, restarts) for label, task in tasks]
        for number, (answers, said) in CLUSTERS[cluster](_run_task, calls):
            label, task = tasks[number]
            if said:
                logs.mkdir(parents=True, exist_ok=True)
                with (logs / f"{label.replace('/', '_')}.log").open("a") as log:
                    log.write(said)
            for run, answer in zip(task, answers, strict=True):
                yield run, records_of(run, answer, about)

    return execute


def _run_task(spec: PlannerSpec, runs: list[Run], restarts: bool) -> tuple[list[list[Fields]], str]:
    """The answers to the runs, and the planner's output."""
    with TemporaryDirectory() as folder:
        log = FilePath(folder) / "log"
        process = PlannerProcess(spec, log)
        try:
            answers = [process.plan(run, restarts) for run in runs]
        finally:
            process.close()
        return answers, log.read_text(errors="replace")
