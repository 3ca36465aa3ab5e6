"""Who makes a bench's calls: processes of this machine, or a Ray cluster."""

import threading
from collections import deque
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from pathlib import Path as FilePath
from tempfile import TemporaryDirectory

from robotdiffuse.core import processes
from robotdiffuse.evaluation.bench.entries import Contestant
from robotdiffuse.evaluation.bench.planner_process import PlannerProcess
from robotdiffuse.evaluation.records import RESTARTED, Record
from robotdiffuse.evaluation.runs import Execute, Fields, Made, Trial

CHUNK = 20
"""Calls of one planner that a node of a cluster makes in one go, with one start of the process."""
Contestants = Mapping[str, Contestant]
"""By their labels, which are the methods of trials."""


def on_this_machine(
    contestants: Contestants, workers: int, restarts: bool, run: str, logs: FilePath
) -> Execute:
    """A process for each contestant, so many calls at a time; what they print goes to `logs`.

    All processes are warmed up before the first call is timed, and take turns: all planners are timed while
    as much else goes on.
    """
    about = {"run": run, "workers": workers}

    def execute(trials: Sequence[Trial]) -> Made:
        stop, news, ready = threading.Event(), threading.Condition(), deque[tuple[Trial, list[Record]]]()
        todo: deque[Trial] = deque(trials)
        first = {trial.method: trial for trial in reversed(trials)}
        planners = {
            label: PlannerProcess(contestants[label], logs / f"{label.replace('/', '_')}.log")
            for label in first
        }
        idle = set(planners)

        def next_trial() -> Trial | None:
            """The first one whose planner is idle; None when there is nothing left to do."""
            with news:
                while todo and not stop.is_set():
                    for i, trial in enumerate(todo):
                        if trial.method in idle:
                            del todo[i]
                            idle.remove(trial.method)
                            return trial
                    news.wait()
            return None

        def work() -> None:
            while (trial := next_trial()) is not None:
                answers = planners[trial.method].plan(trial, restarts)
                with news:
                    if not stop.is_set():  # else it is the stop that ended the call
                        ready.append((trial, records_of(trial, answers, about)))
                    idle.add(trial.method)
                    news.notify_all()

        pool = ThreadPoolExecutor(workers)
        try:
            jobs = {pool.submit(planners[label].warm, trial) for label, trial in first.items()}
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


def records_of(trial: Trial, answers: Sequence[Fields], about: Fields) -> list[Record]:
    """Those after the first are of restarts."""
    labels = (trial.method, trial.method + RESTARTED)
    found = zip(labels, answers, strict=False)
    return [trial.record({"planner": label, **about, **answer}) for label, answer in found]


def on_ray(contestants: Contestants, restarts: bool, run: str, logs: FilePath) -> Execute:
    """Calls in portions, each by a process of its own on a node of a Ray cluster; see `processes.on_ray`.

    The nodes need this package, and weights and files at the same places.
    """
    about = {"run": run, "workers": "ray"}

    def execute(trials: Sequence[Trial]) -> Made:
        of = {label: [trial for trial in trials if trial.method == label] for label in contestants}
        portions = [(label, t[i : i + CHUNK]) for label, t in of.items() for i in range(0, len(t), CHUNK)]
        calls = [(contestants[label], portion, restarts) for label, portion in portions]
        for number, (answers, said) in processes.on_ray(_portion, calls):
            label, portion = portions[number]
            if said:
                logs.mkdir(parents=True, exist_ok=True)
                with (logs / f"{label.replace('/', '_')}.log").open("a") as log:
                    log.write(said)
            for trial, answer in zip(portion, answers, strict=True):
                yield trial, records_of(trial, answer, about)

    return execute


def _portion(contestant: Contestant, trials: list[Trial], restarts: bool) -> tuple[list[list[Fields]], str]:
    """The answers to the trials, and what the planner printed."""
    with TemporaryDirectory() as folder:
        log = FilePath(folder) / "log"
        process = PlannerProcess(contestant, log)
        try:
            answers = [process.plan(trial, restarts) for trial in trials]
        finally:
            process.close()
        return answers, log.read_text(errors="replace")
