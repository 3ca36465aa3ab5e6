"""A server under load: lost or mixed-up answers, memory, and throughput compared with the planner alone.

    python benchmarks/server.py [--seconds 600] [--clients 8] [--workers 1] [--kills 5]

Prints benchmarks/results/serve.txt. First, the planner plans held-out problems of four families in this
process, each with two seeds; in a quarter of the problems, the hand holds a box of random size. Then clients
request these plans from the server in random order, and compare every answer with the planner's path, bit for
bit. Finally, workers are killed while clients send requests. With one core more than workers, each worker has
a core of its own; CPU times do not depend on other work on the machine.
"""

import argparse
import json
import os
import random
import re
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx
import numpy as np

import robotdiffuse as rd
from common import header, parse, print_table
from robotdiffuse.problems.files import SEED, held_out_problem, problem_from_record, problem_record

FAMILIES = ("rop", "shelf", "crate", "table")
SEEDS = (0, 1)
TIME_LIMIT = 10.0
"""Time limit of requests, long enough that no answer depends on the clock [s]."""


@dataclass
class PlanRequest:
    """A request, and the answer of the planner alone."""

    body: bytes
    problem: rd.Problem
    seed: int
    expected: list[list[float]] | None = None


@dataclass
class ClientCounts:
    """What the clients saw."""

    answers: Counter = field(default_factory=Counter)
    """Number of answers by HTTP status code."""
    wrong: int = 0
    """Number of answers with code 200 that are not the planner's path."""
    lost: int = 0
    """Number of requests without an answer."""
    seconds: list[float] = field(default_factory=list)
    """Time until each answer [s]."""


def requests(planner: str, count: int) -> list[PlanRequest]:
    """Requests for `count` problems of each family."""
    plan_requests = []
    rng = np.random.default_rng(SEED)
    for number in range(count):
        for family in FAMILIES:
            record: dict[str, Any] = problem_record(held_out_problem(family, number))
            if number % 4 == 0:
                box = {"center": [0.0, 0.0, 0.13], "size": rng.uniform(0.02, 0.05, 3).tolist(), "name": "box"}
                record["attached"] = [{"link": "panda_hand", "box": box}]
            for seed in SEEDS:
                body = {"problem": record, "planner": planner, "seed": seed, "time_limit": TIME_LIMIT}
                plan_requests.append(
                    PlanRequest(json.dumps(body).encode(), problem_from_record(record), seed)
                )
    return plan_requests


def plan_alone(plan_requests: list[PlanRequest], planner: str, rounds: int) -> tuple[float, float]:
    """Wall and CPU time of the planner alone for all requests [s]; sets the expected answer of each
    request."""
    loaded = rd.load_planner(planner)
    loaded.warm_up(plan_requests[0].problem)
    for request in plan_requests:
        result = loaded.plan(request.problem, TIME_LIMIT, request.seed)
        waypoints = None if result.path is None else result.path.positions.tolist()
        assert request.expected is None or request.expected == waypoints, "the planner contradicts itself"
        request.expected = waypoints
    wall = time.perf_counter()
    spent = time.process_time()
    for _ in range(rounds):
        for request in plan_requests:
            loaded.plan(request.problem, TIME_LIMIT, request.seed)
    return (time.perf_counter() - wall) / rounds, (time.process_time() - spent) / rounds


def run_client(
    url: str,
    plan_requests: list[PlanRequest],
    seed: int,
    until: float,
    counts: ClientCounts,
    lock: threading.Lock,
) -> None:
    import orjson

    rng = random.Random(seed)
    kind = {"Content-Type": "application/json"}
    with httpx.Client(base_url=url, timeout=60.0) as http:
        while time.monotonic() < until:
            request = rng.choice(plan_requests)
            begun = time.monotonic()
            try:
                answer = http.post("/plan", content=request.body, headers=kind)
            except httpx.HTTPError:
                with lock:
                    counts.lost += 1
                continue
            record = orjson.loads(answer.content)
            right = record.get("waypoints") == request.expected and record.get("seed") == request.seed
            with lock:
                counts.answers[answer.status_code] += 1
                counts.wrong += answer.status_code == 200 and not right
                counts.seconds.append(time.monotonic() - begun)


def load(
    url: str, plan_requests: list[PlanRequest], clients: int, seconds: float, meanwhile: Any
) -> ClientCounts:
    """Run clients for some seconds; returns what they saw. `meanwhile` is called every second with the
    seconds since the start."""
    counts = ClientCounts()
    lock = threading.Lock()
    begun = time.monotonic()
    threads = [
        threading.Thread(target=run_client, args=(url, plan_requests, i, begun + seconds, counts, lock))
        for i in range(clients)
    ]
    for thread in threads:
        thread.start()
    while any(thread.is_alive() for thread in threads):
        meanwhile(time.monotonic() - begun)
        time.sleep(1.0)
    return counts


def private_memory(process: int) -> float:
    """Private memory of a process [MB]."""
    try:
        rows = Path(f"/proc/{process}/smaps_rollup").read_text()
    except (OSError, ValueError):
        return 0.0
    return sum(int(row.split()[1]) for row in rows.splitlines() if row.startswith("Private")) / 1024


def cpu_time(process: int) -> float:
    """CPU time of a process [s]."""
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def workers_of(process: int) -> list[int]:
    """The process ids of the server's workers."""
    listing = subprocess.run(
        ["pgrep", "-P", str(process), "-f", "spawn_main"], capture_output=True, text=True
    )
    return [int(line) for line in listing.stdout.split()]


def main() -> None:
    parser = argparse.ArgumentParser(description="A server under load.")
    parser.add_argument("--seconds", type=float, default=600.0, help="duration of the load (600)")
    parser.add_argument("--clients", type=int, default=8, help="number of clients (8)")
    parser.add_argument(
        "--workers", type=int, default=max(1, (os.cpu_count() or 2) - 1), help="number of workers (cores - 1)"
    )
    parser.add_argument("--kills", type=int, default=5, help="number of workers that are killed (5)")
    parser.add_argument("--problems", type=int, default=10, help="number of problems of each family (10)")
    parser.add_argument("--planner", default="robotdiffuse", help="planner to use (robotdiffuse)")
    parser.add_argument(
        "--rounds", type=int, default=3, help="plans of the planner alone, before and after (3)"
    )
    parser.add_argument("--pause", type=float, default=4.0, help="time between kills [s] (4)")
    small = {"seconds": 2.0, "clients": 2, "workers": 1, "kills": 1, "problems": 1, "planner": "aorrtc"}
    small |= {"rounds": 1, "pause": 1.0}
    arguments = parse(parser, **small)
    print(header("numpy", "numba", "fastapi", "uvicorn"), "\n")
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    plan_requests = requests(arguments.planner, arguments.problems)
    before = plan_alone(plan_requests, arguments.planner, arguments.rounds)
    command = ["serve", "--port", "0", "--workers", str(arguments.workers), "--queue", str(arguments.clients)]
    with subprocess.Popen(
        [sys.executable, "-m", "robotdiffuse", *command], stdout=subprocess.PIPE, text=True
    ) as server:
        assert server.stdout is not None
        match = re.search(r"http://[^;]+", server.stdout.readline())
        assert match is not None
        url = match.group()
        while httpx.get(f"{url}/health").json()["workers_ready"] < arguments.workers:
            time.sleep(0.2)
        load(url, plan_requests, arguments.clients, min(20.0, arguments.seconds / 4), lambda _: None)
        workers = workers_of(server.pid)
        rows: list[tuple[float, float, float]] = []
        at_first = {process: cpu_time(process) for process in (server.pid, *workers)}

        def watch(since: float) -> None:
            rows.append((since, private_memory(server.pid), max(map(private_memory, workers))))

        counts = load(url, plan_requests, arguments.clients, arguments.seconds, watch)
        used = {process: cpu_time(process) - at_first[process] for process in at_first}
        kills: list[float] = []

        def kill(since: float) -> None:
            if len(kills) < arguments.kills and since > arguments.pause * (len(kills) + 1):
                ready = httpx.get(f"{url}/health").json()["workers_ready"]
                if ready == arguments.workers:
                    os.kill(random.choice(workers_of(server.pid)), signal.SIGKILL)
                    kills.append(since)

        killed = load(
            url, plan_requests, arguments.clients, arguments.pause * (1.5 * arguments.kills + 2.5), kill
        )
        server.send_signal(signal.SIGTERM)
        status = server.wait(30)
    after = plan_alone(plan_requests, arguments.planner, arguments.rounds)
    alone = len(plan_requests) / min(before[0], after[0]), len(plan_requests) / min(before[1], after[1])
    count = sum(counts.answers.values())
    worked = sum(used[process] for process in workers)
    rates = {
        "planner alone": alone,
        "served, a worker": (count / arguments.seconds / arguments.workers, count / worked),
        "served, with the process that listens": (None, count / (worked + used[server.pid])),
    }
    print_table(
        f"Plans a second, {arguments.planner}, {arguments.workers} workers, {arguments.clients} clients",
        ("", "of wall time", "of alone, %", "of CPU time", "of alone, %"),
        [
            (
                name,
                *(
                    part
                    for rate, base in zip(rate_of, alone, strict=True)
                    for part in ((f"{rate:.1f}", f"{100 * rate / base:.0f}") if rate else ("", ""))
                ),
            )
            for name, rate_of in rates.items()
        ],
    )
    times = 1e3 * np.array(counts.seconds)
    print_table(
        f"What {arguments.clients} clients saw in {arguments.seconds:.0f} s",
        ("", "undisturbed", f"{len(kills)} workers killed"),
        [
            ("answers", *(str(sum(seen.answers.values())) for seen in (counts, killed))),
            ("by code", *(_codes(seen) for seen in (counts, killed))),
            ("lost, without an answer", str(counts.lost), str(killed.lost)),
            ("not the planner's path", str(counts.wrong), str(killed.wrong)),
            (
                "seconds to an answer, median / 99 % / most",
                " / ".join(f"{x / 1e3:.3f}" for x in (*np.percentile(times, (50, 99)), times.max())),
                "",
            ),
        ],
    )
    marks = [rows[int(share * (len(rows) - 1))] for share in (0.0, 0.25, 0.5, 0.75, 1.0)]
    print_table(
        "Private memory, MB",
        ("after, s", "process that listens", "largest worker"),
        [tuple(f"{value:.0f}" for value in row) for row in marks],
    )
    print(f"\nExit status after SIGTERM: {status}.")
    failed = counts.lost or counts.wrong or killed.lost or killed.wrong or set(counts.answers) != {200}
    if failed or killed.answers[500] > len(kills) or status:
        sys.exit(1)


def _codes(counts: ClientCounts) -> str:
    return ", ".join(f"{code}: {count}" for code, count in sorted(counts.answers.items()))


if __name__ == "__main__":
    main()
