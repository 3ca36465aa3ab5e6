"""A process for each planner, so that a crash, an endless loop or a leak affects no other planner.

The process runs `python -m robotdiffuse.evaluation.bench.planner_process SPEC ADDED`, where ADDED is the
import path and the entries that this program has added to the registries. It reads one task per line and
writes its answers, one per line, all JSON. Warming up (compiled code, imports) is not timed.
"""

import json
import os
import queue
import resource
import sys
import threading
import traceback
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path as FilePath
from typing import TextIO

from robotdiffuse.core.line_process import LineProcess
from robotdiffuse.core.registry import AddedEntries, Entry, added_entries, adopt_entries
from robotdiffuse.evaluation.bench.planner_spec import PlannerSpec
from robotdiffuse.evaluation.methods import measure_of, planner_calls
from robotdiffuse.evaluation.records import CRASHED, OVERRAN
from robotdiffuse.evaluation.runs import Fields, Run
from robotdiffuse.planning.planner import Planner
from robotdiffuse.problems.files import problem_from_record, problem_record
from robotdiffuse.problems.problem import Problem
from robotdiffuse.robots.robot import Robot

COMMAND = sys.executable, "-m", "robotdiffuse.evaluation.bench.planner_process"
START_TIMEOUT = 300.0
"""For starting and for warming up [s]; the first time ever, kernels are compiled."""
GRACE = 20.0
"""A process that has not answered this long after the time limit is killed [s]; validating and timing the
motion take part of it."""
RESTARTS_TIMEOUT_FACTOR = 20.0
"""Of the time limit, for restarts: the time for timing each path does not count."""
END = "end"
"""The last answer to a task."""


class PlannerProcess:
    """A planner in another process, which starts with the first run and again after it died."""

    def __init__(self, spec: PlannerSpec, log: FilePath) -> None:
        """`log`: the process's output is appended to this file."""
        added = added_entries()
        tables = {what: {n: asdict(e) for n, e in table.items()} for what, table in added.tables.items()}
        self._process = LineProcess(
            [*COMMAND, spec.text, json.dumps([sys.path, tables, added.modules], default=sorted)], log
        )

    def warm(self, run: Run) -> None:
        """Warm up for a run's robot. If the process dies of that, `plan` will report it."""
        self._tell({"problem": problem_record(run.problem)})

    def plan(self, run: Run, restarts: bool = False) -> list[Fields]:
        """The fields of a run's records. A crash or an overrun is a record too."""
        asked = {"seed": run.seed, "time_limit": run.limit, "restarts": restarts}
        failure = self._tell({"problem": problem_record(run.problem), **asked})
        if failure is not None:
            return [failure]
        answers: list[Fields] = []
        timeout = run.limit + GRACE
        while (line := self._process.answer(timeout)) is not None:
            answer = json.loads(line)
            if answer == END:
                return answers
            answers.append(answer)
            timeout = RESTARTS_TIMEOUT_FACTOR * run.limit + GRACE
        return [*answers, self._ended(timeout)]

    def close(self) -> None:
        """Kill the process, even if another thread waits for it."""
        self._process.close()

    def _tell(self, task: Fields) -> Fields | None:
        """Send a task and wait until the process is warm; None, or the record of a failure."""
        if not self._process.runs:
            self._process.start()
            if self._process.answer(START_TIMEOUT) is None:
                return self._ended(START_TIMEOUT)
        if not self._process.tell(json.dumps(task)):
            return self._ended(0.0)
        # a robot that is new to the process is warmed up first
        return None if self._process.answer(START_TIMEOUT) is not None else self._ended(START_TIMEOUT)

    def _ended(self, timeout: float) -> Fields:
        """The record of a process that gave no answer."""
        how = self._process.ended()
        if how is None:
            reason = f"no answer {timeout:g} s after the call; the process was killed"
            return {"status": OVERRAN, "reason": reason, "time": timeout}
        return {"status": CRASHED, "reason": f"the planner's process ended {how}", "time": 0.0}


def serve(planner: Planner, request: Fields, tasks: TextIO, answers: TextIO) -> None:
    """Answer tasks, one per line: an empty line once the robot is warmed up, then, for tasks with a seed, the
    fields of each record, and END. `request` holds further arguments of the calls.

    An empty line at the start says that the planner is loaded.
    """

    def answer(line: str) -> None:
        answers.write(line + "\n")
        answers.flush()

    lines: queue.Queue[str] = queue.Queue()
    threading.Thread(target=_read, args=(tasks, lines), daemon=True).start()
    warm: set[Robot] = set()
    answer("")
    while True:
        task = json.loads(lines.get())
        problem = problem_from_record(task["problem"])
        if problem.robot not in warm:
            warm.add(problem.robot)
            _warm_up(planner, problem)
        answer("")
        if "seed" in task:
            for fields in _calls(planner, problem, task, request):
                answer(json.dumps(fields))
            answer(json.dumps(END))


def _read(tasks: TextIO, lines: "queue.Queue[str]") -> None:
    """Pass lines on; exit when the bench closes the pipe, even during a call."""
    for line in tasks:
        lines.put(line)
    os._exit(0)


def _warm_up(planner: Planner, problem: Problem) -> None:
    """Compile, load and fill caches, those of the metrics too."""
    try:
        for result in planner.warm_up(problem):
            if result.path is not None and result.trajectory is not None:
                measure_of(problem.robot)(result.path, result.trajectory, result)
    except Exception:  # the timed call will report it
        traceback.print_exc()


def _calls(planner: Planner, problem: Problem, task: Fields, request: Fields) -> Iterator[Fields]:
    """The records of a task, with memory of the process and load of the machine."""
    about = task["seed"], task["time_limit"], task["restarts"]
    for fields in planner_calls(planner, problem, *about, request):
        memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        yield fields | {"memory": round(memory, 1), "load": round(os.getloadavg()[0], 2)}


def main() -> None:
    """Serve a planner. Its output goes to stderr, so that the pipe carries answers alone."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    os.environ["OMP_NUM_THREADS"] = "1"  # of PyTorch, which only planners with a network load
    path, tables, modules = json.loads(sys.argv[2])
    sys.path += [place for place in path if place not in sys.path]
    entries = {
        what: {n: Entry(**(e | {"supports": frozenset(e["supports"])})) for n, e in table.items()}
        for what, table in tables.items()
    }
    adopt_entries(AddedEntries(entries, tuple(modules)))
    spec = PlannerSpec.parse(sys.argv[1])
    serve(spec.load(), spec.request(), sys.stdin, answers)


if __name__ == "__main__":
    main()
