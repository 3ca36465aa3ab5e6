"""A process of its own for each planner: a crash, an endless loop or a leak there hurts nobody else.

The far side is `python -m robotdiffuse.evaluation.bench.planner_process NAME [WEIGHTS]`: it reads a task per
line and writes an answer per line, both JSON. Warming up, for compiled code and imports, is apart from
timing.
"""

import json
import os
import queue
import resource
import select
import signal
import subprocess
import sys
import threading
import time
import traceback
from pathlib import Path as FilePath
from typing import Any, NamedTuple, TextIO

import numpy as np

from robotdiffuse.evaluation.bench.records import CRASHED, OVERRAN, RAISED
from robotdiffuse.evaluation.metrics import Measure
from robotdiffuse.planners import PLANNERS, load_planner
from robotdiffuse.planners.base import Planner
from robotdiffuse.problems.files import problem_from_record
from robotdiffuse.problems.problem import JointGoal, Problem
from robotdiffuse.results import PlanResult
from robotdiffuse.robots.kinematics import link_pose
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import Sphere

FAR_SIDE = sys.executable, "-m", "robotdiffuse.evaluation.bench.planner_process"
WARM_UP_SECONDS = 1.0
WARM_UP_RADIUS = 0.08
"""Of balls in the way [m]."""
START_SECONDS = 300.0
"""Most time to start and to warm up; the first time ever, kernels are compiled."""
PATIENCE = 20.0
"""Beyond the time limit [s], for judging and timing, until a process that does not answer is killed."""


class Contestant(NamedTuple):
    """A planner of a bench, maybe with weights that do not come with the package."""

    name: str
    """In `planners.PLANNERS`."""
    weights: str | None

    @classmethod
    def of(cls, text: str) -> "Contestant":
        """From NAME or NAME@FOLDER. Raises InputError for an unknown name."""
        name, at, folder = text.partition("@")
        PLANNERS.entry(name)
        return cls(name, str(FilePath(folder).resolve()) if at else None)

    @property
    def label(self) -> str:
        """What it is called in results."""
        return self.name if self.weights is None else f"{self.name}@{FilePath(self.weights).name}"

    def load(self) -> Planner:
        """Raises InputError as `load_planner`."""
        return load_planner(self.name, weights=self.weights)


class PlannerProcess:
    """The near side: starts the process when it is first asked, and again after it died."""

    def __init__(self, planner: Contestant, log: FilePath) -> None:
        """`log`: what the process prints is added to this file."""
        self._planner, self._log = planner, log
        self._process: subprocess.Popen[bytes] | None = None
        self._unread = b""
        self._closed = False

    def plan(self, problem: dict[str, Any], seed: int, time_limit: float) -> dict[str, Any]:
        """The answer to a task, as fields of a record; a death or an overrun is an answer too."""
        task = {"problem": problem, "seed": seed, "time_limit": time_limit}
        process = self._process
        if process is None or process.poll() is not None:
            process = self._process = self._start()
            if self._closed:  # by another thread, which did not see this process
                process.kill()
            if self._answer(process, START_SECONDS) is None:
                return self._ended(process, START_SECONDS)
        assert process.stdin is not None
        try:
            process.stdin.write(json.dumps(task).encode() + b"\n")
            process.stdin.flush()
        except BrokenPipeError:
            return self._ended(process, 0.0)
        # a robot that is new to the process is warmed up first
        if self._answer(process, START_SECONDS) is None:
            return self._ended(process, START_SECONDS)
        patience = time_limit + PATIENCE
        answer = self._answer(process, patience)
        return self._ended(process, patience) if answer is None else json.loads(answer)

    def close(self) -> None:
        """End the process, whatever another thread waits for."""
        self._closed = True
        if self._process is not None:
            self._process.kill()
            self._process.wait()

    def _start(self) -> "subprocess.Popen[bytes]":
        self._unread = b""
        environment = os.environ | {"OMP_NUM_THREADS": "1"}
        self._log.parent.mkdir(parents=True, exist_ok=True)
        with self._log.open("ab") as log:
            return subprocess.Popen(
                [*FAR_SIDE, *filter(None, self._planner)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=log,
                env=environment,
                start_new_session=True,  # Ctrl-C is for the near side to act on
            )

    def _answer(self, process: "subprocess.Popen[bytes]", patience: float) -> bytes | None:
        """The next line; None if the process ends or does not answer in this time [s]."""
        assert process.stdout is not None
        until = time.monotonic() + patience
        while b"\n" not in self._unread:
            ready, _, _ = select.select([process.stdout], [], [], max(until - time.monotonic(), 0.0))
            part = os.read(process.stdout.fileno(), 1 << 20) if ready else b""
            if not part:
                return None
            self._unread += part
        line, _, self._unread = self._unread.partition(b"\n")  # more than one line may be there
        return line

    def _ended(self, process: "subprocess.Popen[bytes]", patience: float) -> dict[str, Any]:
        """What became of a process that gave no answer."""
        try:
            code = process.wait(timeout=1.0)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
            reason = f"no answer {patience:g} s after the call; the process was killed"
            return {"status": OVERRAN, "reason": reason, "time": patience}
        how = f"by {signal.Signals(-code).name}" if code < 0 else f"with exit status {code}"
        lines = self._log.read_text(errors="replace").strip().splitlines()
        said = f": {lines[-1][:300]}" if lines else ""
        return {"status": CRASHED, "reason": f"the planner's process ended {how}{said}", "time": 0.0}


def serve(planner: Planner, tasks: TextIO, answers: TextIO) -> None:
    """Answer tasks, one a line: first an empty line when the robot is warmed up, then the fields of a record.

    An empty line comes at the start too, when the planner is ready.
    """

    def answer(line: str) -> None:
        answers.write(line + "\n")
        answers.flush()

    lines: queue.Queue[str] = queue.Queue()
    threading.Thread(target=_read, args=(tasks, lines), daemon=True).start()
    measures: dict[Robot, Measure] = {}
    answer("")
    while True:
        task = json.loads(lines.get())
        problem = problem_from_record(task["problem"])
        if problem.robot not in measures:
            measures[problem.robot] = Measure(problem.robot)
            _warm_up(planner, problem, measures[problem.robot])
        answer("")
        answer(json.dumps(_call(planner, problem, task, measures[problem.robot])))


def _read(tasks: TextIO, lines: "queue.Queue[str]") -> None:
    """The process ends with the near side, even in the middle of a call."""
    for line in tasks:
        lines.put(line)
    os._exit(0)


def _warm_up(planner: Planner, problem: Problem, measure: Measure) -> None:
    """Calls that compile, load and fill caches: nothing in the way, and balls where the straight line is."""
    robot, ways = problem.robot, []
    if isinstance(problem.goal, JointGoal):
        ways = [problem.start + share * (problem.goal.positions[0] - problem.start) for share in (0.5, 0.35)]
    balls = [Sphere(link_pose(robot, q, robot.tip)[:3, 3], WARM_UP_RADIUS) for q in ways]
    for shapes in ([], *([ball] for ball in balls)):
        try:
            warm = Problem(robot, Scene(shapes), problem.start, problem.goal)
            result = planner.plan(warm, time_limit=WARM_UP_SECONDS)
            if result.path is not None and result.trajectory is not None:
                measure(result.path, result.trajectory)
        except Exception:  # the timed call will show it
            traceback.print_exc()


def _call(planner: Planner, problem: Problem, task: dict[str, Any], measure: Measure) -> dict[str, Any]:
    began = time.perf_counter()
    try:
        result = planner.plan(problem, time_limit=task["time_limit"], seed=task["seed"])
    except Exception as error:
        traceback.print_exc()
        reason = f"{type(error).__name__}: {' '.join(str(error).split())[:300]}"
        return {"status": RAISED, "reason": reason, "time": time.perf_counter() - began}
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return fields_of(result, measure) | {"memory": round(memory, 1)}


def fields_of(result: PlanResult, measure: Measure) -> dict[str, Any]:
    """What a record keeps of a result."""
    found: dict[str, Any] = {
        "status": result.status.value,
        "reason": result.reason,
        "time": round(result.planning_time, 6),
        "refused": result.refused,
        "stage": result.stage,
        "progress": [[round(at, 6), round(length, 6)] for at, length in result.progress],
    }
    if result.path is not None and result.trajectory is not None:
        found |= measure(result.path, result.trajectory, result)
        found["positions"] = np.round(result.path.positions, 9).tolist()
    return found


def main() -> None:
    """The far side. What the planner prints goes to stderr, so that answers alone are on the pipe."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    import torch

    torch.set_num_threads(1)
    name, *weights = sys.argv[1:]
    serve(Contestant(name, weights[0] if weights else None).load(), sys.stdin, answers)


if __name__ == "__main__":
    main()
