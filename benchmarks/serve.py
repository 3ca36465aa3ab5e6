"""A server under load: nothing lost, nothing mixed up, memory flat, throughput beside the bare planner.

    python benchmarks/serve.py [--seconds 600] [--clients 8] [--workers 1] [--kills 5]

Prints the report that is kept in benchmarks/results/serve.txt. Held-out problems of four families, a quarter
of them with a box of their own in the hand, each with two seeds, are planned first by the bare planner in
this process. Clients then ask the server for them at random, and hold every answer against the bare planner's
path, bit for bit. At last workers are killed while clients ask. With one core more than workers, the workers
have their cores for themselves; processor times need no quiet machine.
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
from report import header, print_table

import robotdiffuse as rd
from robotdiffuse.problems.files import problem_from_record, problem_record
from robotdiffuse.problems.held_out import SEED, held_out_problem

FAMILIES = ("rop", "shelf", "crate", "table")
PER_FAMILY, SEEDS = 10, (0, 1)
TIME_LIMIT = 10.0
"""Ample, so that no answer depends on the clock [s]."""
ROUNDS = 3
"""Of the bare planner, before and after the load."""


@dataclass
class Asked:
    """A request, and what the bare planner answers to it."""

    body: bytes
    problem: rd.Problem
    seed: int
    expected: list[list[float]] | None = None


@dataclass
class Seen:
    """By the clients."""

    answers: Counter = field(default_factory=Counter)
    wrong: int = 0
    lost: int = 0
    seconds: list[float] = field(default_factory=list)


def requests(planner: str) -> list[Asked]:
    asked, rng = [], np.random.default_rng(SEED)
    for number in range(PER_FAMILY):
        for family in FAMILIES:
            record: dict[str, Any] = problem_record(held_out_problem(family, number))
            if number % 4 == 0:
                box = {"center": [0.0, 0.0, 0.13], "size": rng.uniform(0.02, 0.05, 3).tolist(), "name": "box"}
                record["attached"] = [{"link": "panda_hand", "box": box}]
            for seed in SEEDS:
                body = {"problem": record, "planner": planner, "seed": seed, "time_limit": TIME_LIMIT}
                asked.append(Asked(json.dumps(body).encode(), problem_from_record(record), seed))
    return asked


def bare(asked: list[Asked], planner: str) -> tuple[float, float]:
    """Wall and processor time of the bare planner for all requests [s]; notes what it answers."""
    loaded = rd.load_planner(planner)
    loaded.warm_up(asked[0].problem, "converged")
    for one in asked:
        result = loaded.plan(one.problem, TIME_LIMIT, one.seed)
        waypoints = None if result.path is None else result.path.positions.tolist()
        assert one.expected is None or one.expected == waypoints, "the bare planner contradicts itself"
        one.expected = waypoints
    wall, spent = time.perf_counter(), time.process_time()
    for _ in range(ROUNDS):
        for one in asked:
            loaded.plan(one.problem, TIME_LIMIT, one.seed)
    return (time.perf_counter() - wall) / ROUNDS, (time.process_time() - spent) / ROUNDS


def client(url: str, asked: list[Asked], seed: int, until: float, seen: Seen, lock: threading.Lock) -> None:
    import orjson

    rng, kind = random.Random(seed), {"Content-Type": "application/json"}
    with httpx.Client(base_url=url, timeout=60.0) as http:
        while time.monotonic() < until:
            one, begun = rng.choice(asked), time.monotonic()
            try:
                answer = http.post("/plan", content=one.body, headers=kind)
            except httpx.HTTPError:
                with lock:
                    seen.lost += 1
                continue
            record = orjson.loads(answer.content)
            right = record.get("waypoints") == one.expected and record.get("seed") == one.seed
            with lock:
                seen.answers[answer.status_code] += 1
                seen.wrong += answer.status_code == 200 and not right
                seen.seconds.append(time.monotonic() - begun)


def load(url: str, asked: list[Asked], clients: int, seconds: float, meanwhile: Any) -> Seen:
    """What clients see in this time; `meanwhile` is called once a second with the seconds since."""
    seen, lock, begun = Seen(), threading.Lock(), time.monotonic()
    threads = [
        threading.Thread(target=client, args=(url, asked, i, begun + seconds, seen, lock))
        for i in range(clients)
    ]
    for thread in threads:
        thread.start()
    while any(thread.is_alive() for thread in threads):
        meanwhile(time.monotonic() - begun)
        time.sleep(1.0)
    return seen


def memory(process: int) -> float:
    """That it alone holds [MB]."""
    try:
        rows = Path(f"/proc/{process}/smaps_rollup").read_text()
    except (OSError, ValueError):
        return 0.0
    return sum(int(row.split()[1]) for row in rows.splitlines() if row.startswith("Private")) / 1024


def spent(process: int) -> float:
    """Processor time of a process [s]."""
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def workers_of(process: int) -> list[int]:
    """Those of its children that plan."""
    found = subprocess.run(["pgrep", "-P", str(process), "-f", "spawn_main"], capture_output=True, text=True)
    return [int(line) for line in found.stdout.split()]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--seconds", type=float, default=600.0)
    parser.add_argument("--clients", type=int, default=8)
    parser.add_argument("--workers", type=int, default=max(1, (os.cpu_count() or 2) - 1))
    parser.add_argument("--kills", type=int, default=5)
    parser.add_argument("--planner", default="robotdiffuse")
    arguments = parser.parse_args()
    print(header("numpy", "numba", "fastapi", "uvicorn"), "\n")
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    asked = requests(arguments.planner)
    before = bare(asked, arguments.planner)
    command = ["serve", "--port", "0", "--workers", str(arguments.workers), "--queue", str(arguments.clients)]
    with subprocess.Popen(
        [sys.executable, "-m", "robotdiffuse", *command], stdout=subprocess.PIPE, text=True
    ) as server:
        assert server.stdout is not None
        found = re.search(r"http://[^;]+", server.stdout.readline())
        assert found is not None
        url = found.group()
        while httpx.get(f"{url}/health").json()["workers_ready"] < arguments.workers:
            time.sleep(0.2)
        load(url, asked, arguments.clients, min(20.0, arguments.seconds / 4), lambda _: None)
        workers = workers_of(server.pid)
        rows: list[tuple[float, float, float]] = []
        at_first = {process: spent(process) for process in (server.pid, *workers)}

        def watch(since: float) -> None:
            rows.append((since, memory(server.pid), max(map(memory, workers))))

        seen = load(url, asked, arguments.clients, arguments.seconds, watch)
        used = {process: spent(process) - at_first[process] for process in at_first}
        kills: list[float] = []

        def kill(since: float) -> None:
            if len(kills) < arguments.kills and since > 4.0 * (len(kills) + 1):
                ready = httpx.get(f"{url}/health").json()["workers_ready"]
                if ready == arguments.workers:
                    os.kill(random.choice(workers_of(server.pid)), signal.SIGKILL)
                    kills.append(since)

        killed = load(url, asked, arguments.clients, 6.0 * arguments.kills + 10.0, kill)
        server.send_signal(signal.SIGTERM)
        status = server.wait(30)
    after = bare(asked, arguments.planner)
    alone = len(asked) / min(before[0], after[0]), len(asked) / min(before[1], after[1])
    count = sum(seen.answers.values())
    worked = sum(used[process] for process in workers)
    rates = {
        "bare planner": alone,
        "served, a worker": (count / arguments.seconds / arguments.workers, count / worked),
        "served, with the process that listens": (None, count / (worked + used[server.pid])),
    }
    print_table(
        f"Plans a second, {arguments.planner}, {arguments.workers} workers, {arguments.clients} clients",
        ("", "by the clock", "of bare, %", "of processor time", "of bare, %"),
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
    times = 1e3 * np.array(seen.seconds)
    print_table(
        f"What {arguments.clients} clients saw in {arguments.seconds:.0f} s",
        ("", "undisturbed", f"{len(kills)} workers killed"),
        [
            ("answers", *(str(sum(of.answers.values())) for of in (seen, killed))),
            ("by code", *(_codes(of) for of in (seen, killed))),
            ("lost, without an answer", str(seen.lost), str(killed.lost)),
            ("not the bare planner's path", str(seen.wrong), str(killed.wrong)),
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
    failed = seen.lost or seen.wrong or killed.lost or killed.wrong or set(seen.answers) != {200}
    if failed or killed.answers[500] > len(kills) or status:
        sys.exit(1)


def _codes(seen: Seen) -> str:
    return ", ".join(f"{code}: {count}" for code, count in sorted(seen.answers.items()))


if __name__ == "__main__":
    main()
