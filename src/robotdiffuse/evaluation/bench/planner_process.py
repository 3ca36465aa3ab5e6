"""A process of its own for each planner: a crash, an endless loop or a leak there hurts nobody else.

The far side is `python -m robotdiffuse.evaluation.bench.planner_process CONTESTANT ADDED`, with the import
path and the entries that this program has added to the tables. It reads a task per line and writes its
answers, a line each, all JSON. Warming up, for compiled code and imports, is apart from timing.
"""

import json
import os
import queue
import resource
import sys
import threading
import traceback
from collections.abc import Iterator
from dataclasses import astuple
from pathlib import Path as FilePath
from typing import TextIO

from robotdiffuse.core.processes import LineProcess
from robotdiffuse.core.registry import Entry, added_entries, adopt_entries
from robotdiffuse.core.types import CONVERGED
from robotdiffuse.evaluation.bench.entries import Contestant
from robotdiffuse.evaluation.methods import measure_of, planner_calls
from robotdiffuse.evaluation.records import CRASHED, OVERRAN
from robotdiffuse.evaluation.runs import Fields, Trial
from robotdiffuse.planning.planner import Planner
from robotdiffuse.problems.files import problem_from_record, problem_record
from robotdiffuse.problems.problem import Problem
from robotdiffuse.robots.robot import Robot

FAR_SIDE = sys.executable, "-m", "robotdiffuse.evaluation.bench.planner_process"
START_SECONDS = 300.0
"""Most time to start and to warm up; the first time ever, kernels are compiled."""
PATIENCE = 20.0
"""Beyond the time limit [s], for validating and timing, until a process that does not answer is killed."""
PATIENCE_WITH_RESTARTS = 20.0
"""Time limits until then where a planner is restarted, as the timing of each of its paths is not counted."""
END = "end"
"""Of the answers to a task."""


class PlannerProcess:
    """The near side: starts the process when it is first asked, and again after it died."""

    def __init__(self, contestant: Contestant, log: FilePath) -> None:
        """`log`: what the process prints is added to this file."""
        entries = {what: {n: astuple(e) for n, e in table.items()} for what, table in added_entries().items()}
        self._far = LineProcess([*FAR_SIDE, contestant.text, json.dumps([sys.path, entries])], log)

    def warm(self, trial: Trial) -> None:
        """Be ready for a trial's robot. A process that dies of it will say so when it is to plan."""
        self._tell({"problem": problem_record(trial.problem)})

    def plan(self, trial: Trial, restarts: bool = False) -> list[Fields]:
        """The answers to a trial, as fields of records; a death or an overrun is an answer too."""
        asked = {"seed": trial.seed, "time_limit": trial.limit, "restarts": restarts}
        failure = self._tell({"problem": problem_record(trial.problem), **asked})
        if failure is not None:
            return [failure]
        answers: list[Fields] = []
        patience = trial.limit + PATIENCE
        while (line := self._far.answer(patience)) is not None:
            answer = json.loads(line)
            if answer == END:
                return answers
            answers.append(answer)
            patience = PATIENCE_WITH_RESTARTS * trial.limit + PATIENCE
        return [*answers, self._ended(patience)]

    def close(self) -> None:
        """End the process, whatever another thread waits for."""
        self._far.close()

    def _tell(self, task: Fields) -> Fields | None:
        """None when the process is warm and begins with the task, else what became of it."""
        if not self._far.runs:
            self._far.start()
            if self._far.answer(START_SECONDS) is None:
                return self._ended(START_SECONDS)
        if not self._far.tell(json.dumps(task)):
            return self._ended(0.0)
        # a robot that is new to the process is warmed up first
        return None if self._far.answer(START_SECONDS) is not None else self._ended(START_SECONDS)

    def _ended(self, patience: float) -> Fields:
        """What became of a process that gave no answer."""
        how = self._far.ended()
        if how is None:
            reason = f"no answer {patience:g} s after the call; the process was killed"
            return {"status": OVERRAN, "reason": reason, "time": patience}
        return {"status": CRASHED, "reason": f"the planner's process ended {how}", "time": 0.0}


def serve(planner: Planner, request: Fields, tasks: TextIO, answers: TextIO) -> None:
    """Answer tasks, one a line, by calls that ask for `request` too: an empty line when the robot is warmed
    up, then, unless that was all, the fields of each record, and END.

    An empty line comes at the start too, when the planner is ready.
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
    """The process ends with the near side, even in the middle of a call."""
    for line in tasks:
        lines.put(line)
    os._exit(0)


def _warm_up(planner: Planner, problem: Problem) -> None:
    """Calls that compile, load and fill caches, those of the measurements too."""
    try:
        for result in planner.warm_up(problem, CONVERGED):
            if result.path is not None and result.trajectory is not None:
                measure_of(problem.robot)(result.path, result.trajectory, result)
    except Exception:  # the timed call will show it
        traceback.print_exc()


def _calls(planner: Planner, problem: Problem, task: Fields, request: Fields) -> Iterator[Fields]:
    """With what the process and the machine had to bear meanwhile."""
    about = task["seed"], task["time_limit"], task["restarts"]
    for fields in planner_calls(planner, problem, *about, request):
        memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        yield fields | {"memory": round(memory, 1), "load": round(os.getloadavg()[0], 2)}


def main() -> None:
    """The far side. What the planner prints goes to stderr, so that answers alone are on the pipe."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    os.environ["OMP_NUM_THREADS"] = "1"  # of PyTorch, which only planners with a network load
    path, entries = json.loads(sys.argv[2])
    sys.path += [place for place in path if place not in sys.path]
    adopt_entries({what: {n: Entry(*e) for n, e in table.items()} for what, table in entries.items()})
    contestant = Contestant.of(sys.argv[1])
    serve(contestant.load(), contestant.request(), sys.stdin, answers)


if __name__ == "__main__":
    main()
