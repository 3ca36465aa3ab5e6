"""A real server on a port of its own: answers, errors, cancellation, and recovery from dead workers."""

import asyncio
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import urllib.error
import urllib.request
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import AsyncMock

import httpx
import numpy as np
import pytest

import robotdiffuse as rd
from helpers.commands import Said
from helpers.planners import DIES, EATS, EXITS, HANGS, KEEPS, RAISES, SEARCHES
from helpers.refusals import refuses
from helpers.serving import serving
from helpers.waiting import until
from robotdiffuse.cli.serve import served_robots
from robotdiffuse.core.types import UNTIL
from robotdiffuse.problems.files import problem_from_record
from robotdiffuse.robots import DATA, ROBOTS
from robotdiffuse.server.app import Access
from robotdiffuse.server.settings import ServeSettings

pytest.importorskip("fastapi")

from robotdiffuse.server import worker
from robotdiffuse.trajectories.speed_limits import MIN_SCALING

LEFT = [0.9, 0.3, 0.0, -1.9, 0.0, 2.2, 0.785]
RIGHT = [-0.9, 0.3, 0.0, -1.9, 0.0, 2.2, 0.785]
JOINTS = [f"panda_joint{i}" for i in range(1, 8)]
FAR = {"joint_names": JOINTS, "positions": [[1e9] * 7]}
LONG = {"joint_names": ["a"], "positions": [[0]] * 100_001}
GOAL = {"joints": LEFT}
CONE = {"axis_cone": {"frame": "panda_hand", "axis": [0, 0, 1], "direction": [0, 0, 1], "angle": 3.0}}
JSON = {"Content-Type": "application/json"}
LINES = {"Content-Type": "application/x-ndjson"}
PROMPT = 60.0
"""For an answer that must not wait for other requests [s]."""
BRIEF = httpx.Timeout(60.0, read=0.5)
"""Time limit of a client that does not wait for its answer."""
TRAJECTORY = ("joint_names", "times", "positions", "velocities", "accelerations")


def problem(height: float = 0.4, **changed: Any) -> dict[str, Any]:
    wall = {"box": {"center": [0.45, 0.0, height], "size": [0.3, 0.05, 0.4], "name": "wall"}}
    return {"robot": "panda", "scene": [wall], "start": LEFT, "goal": {"joints": RIGHT}} | changed


def asked(seed: int = 0, planner: str = "rrt_connect", height: float = 0.4, **more: Any) -> dict[str, Any]:
    return {"problem": problem(height), "planner": planner, "seed": seed, "time_limit": 60.0} | more


def gauge(server: httpx.Client, name: str) -> float:
    found = re.search(rf"^robotdiffuse_{name} (\S+)$", server.get("/metrics").text, re.MULTILINE)
    assert found is not None
    return float(found.group(1))


def error(answer: httpx.Response) -> str:
    line = answer.json()["error"]
    assert line and "\n" not in line and "Traceback" not in line
    return line


@contextmanager
def recovers(server: httpx.Client, lost: int = 0, renewed: int = 0) -> Iterator[None]:
    """The server solves a problem after the block, in which so many workers are lost and renewed."""
    expected = {f"workers_{what}_total": count for what, count in (("lost", lost), ("renewed", renewed))}
    before = {name: gauge(server, name) for name in expected}
    yield
    assert server.post("/plan", json=asked(3)).json()["status"] == "solved"
    assert {name: gauge(server, name) - before[name] for name in expected} == expected


def test_a_plan_is_that_of_the_bare_planner_and_the_validator_agrees(server: httpx.Client) -> None:
    answer = server.post("/plan", json=asked(3))
    assert answer.status_code == 200
    record = answer.json()
    bare = rd.load_planner("rrt_connect").plan(problem_from_record(problem()), 20.0, seed=3)
    assert bare.path is not None and np.array_equal(record["waypoints"], bare.path.positions)
    path = {"joint_names": record["joint_names"], "positions": record["waypoints"]}
    motion = {name: record[name] for name in TRAJECTORY}
    verdict = server.post("/verify", json={"problem": problem(), "path": path, "trajectory": motion}).json()
    assert verdict["valid"] and verdict["trajectory"]["valid"] and verdict["path"]["min_clearance"] > 0
    straight = {"problem": problem(), "path": {"joint_names": JOINTS, "positions": [LEFT, RIGHT]}}
    verdict = server.post("/verify", json=straight | {"trajectory": None}).json()
    assert not verdict["valid"] and verdict["path"]["violation"]["other"] == "wall"
    cut = json.dumps(straight).replace('"wall"', '"\\ud800"')  # Regression: code 500
    verdict = server.post("/verify", content=cut, headers={"Content-Type": "application/json"}).json()
    assert verdict["path"]["violation"]["other"] == "\ud800"


def test_a_batch_is_answered_line_by_line_in_order(server: httpx.Client) -> None:
    heights = (0.2, 0.3, 0.4, 0.5)
    lines = [json.dumps(asked(height=height, until="first")) for height in heights]
    lines[2] = "{"
    answer = server.post("/batch", content="\n".join(lines), headers=LINES)
    assert answer.status_code == 200
    records = [json.loads(line) for line in answer.text.splitlines()]
    assert "not valid JSON" in records[2]["error"]
    for i in (0, 1, 3):
        alone = server.post("/plan", json=asked(height=heights[i], until="first")).json()
        assert records[i]["waypoints"] == alone["waypoints"]


@pytest.mark.parametrize(
    ("path", "body", "code", "message"),
    [
        ("/plan", b"[" * 100_000, 400, "nested more than 64"),
        ("/plan", b"\xff{}", 400, "not UTF-8"),
        ("/plan", b'{"problem": ' + b"9" * 5000 + b"}", 400, "no field takes such a large number"),
        ("/plan", b"{}", 400, "no problem"),
        ("/plan", {"problem": problem(), "time": 1}, 400, "unknown field of the request: 'time'"),
        ("/plan", asked(planner="rrt"), 400, "unknown planner 'rrt'; known: "),
        ("/plan", asked(time_limit=61.0), 400, "at most 60 s here"),
        ("/plan", asked(time_limit="1"), 400, "time_limit is '1'; it takes a number above 0"),
        ("/plan", asked(until=[1]), 400, r"until is \[1\]; it takes first, converged, time_limit"),
        ("/plan", asked(seed=2**40), 400, "it must be at most 4294967295"),
        ("/plan", asked(seed=True), 400, "seed is True; it takes an integer"),
        ("/plan", asked(objective="cost"), 400, "unknown objective 'cost'; known: length, time"),
        ("/plan", asked(rate=0), 400, "rate is 0.0; it must be above 0 and at most 100000"),
        ("/plan", asked(rate=True), 400, "rate is True; it takes a number above 0"),
        ("/plan", {"problem": problem(robot="/etc/passwd")}, 400, "unknown robot '/etc/passwd'; known: "),
        ("/plan", {"problem": problem(robot="../panda")}, 400, "unknown robot"),
        ("/plan", {"problem": problem(scene="scene.yaml")}, 400, "is a file, and files are not read here"),
        ("/plan", {"problem": problem(scene=[{"mesh": {"file": "/etc/p.stl"}}])}, 400, "files are not read"),
        ("/verify", {"problem": problem()}, 400, "neither path nor trajectory"),
        ("/verify", {"problem": problem(), "path": {"joint_names": JOINTS}}, 400, "path has no positions"),
        ("/verify", {"problem": problem(), "path": FAR}, 400, "its numbers must be finite and within"),
        ("/plan", b" " * (2**21 + 1), 413, "it may have at most 2097152 bytes"),
        ("/plan", {"problem": problem(constraints=[CONE] * 5000)}, 400, "constraints has 5000 entries; .* 50$"),
        ("/plan", {"problem": problem(waypoints=[GOAL] * 1000)}, 400, "waypoints has 1000 entries; .* 200$"),
        ("/plan", {"problem": problem(goal={"any": [GOAL] * 2000})}, 400, "goal has 2000 entries; .* 1000$"),
        ("/verify", {"problem": problem(), "path": LONG}, 400, "positions has 100001 rows; .* 100000$"),
        ("/plan", asked(3, rate=1e5), 400, "an answer may have 20000 rows"),
    ],
)
def test_wrong_requests_are_one_line(server: httpx.Client, path: str, body: Any, code: int, message: str) -> None:
    """Regression: 5,000 constraints kept a worker busy for 29 s."""
    answer = server.post(path, content=body if isinstance(body, bytes) else json.dumps(body), headers=JSON)
    assert answer.status_code == code and re.search(message, error(answer))


def test_other_hosts_content_types_and_methods_are_refused(server: httpx.Client) -> None:
    rebound = server.post("/plan", json=asked(), headers={"Host": "evil.example"})
    form = server.post("/plan", content=json.dumps(asked()), headers={"Content-Type": "text/plain"})
    assert (rebound.status_code, form.status_code) == (421, 415)
    assert server.get("/plan").status_code == 405 and server.get("/../../etc/passwd").status_code == 404
    assert error(server.get("/plan")) == "'/plan' does not take GET; it takes POST"
    for answer in (rebound, form, server.get("/plan"), server.get("/etc"), server.delete("/requests/x")):
        error(answer)


def test_a_client_that_closes_after_sending_gets_its_error(server: httpx.Client) -> None:
    """urllib sends all of its request before it reads, and asks to close the connection."""
    for path, size, code in (("plan", 2**24, 413), ("nothing", 2**22, 404)):
        with pytest.raises(urllib.error.HTTPError) as refused:
            urllib.request.urlopen(urllib.request.Request(f"{server.base_url}/{path}", bytes(size), JSON))
        assert refused.value.code == code and b'{"error": "' in refused.value.read()


def test_lists_health_metrics_and_a_page_without_scripts(server: httpx.Client) -> None:
    robots = {robot["name"]: robot for robot in server.get("/robots").json()}
    assert [joint["name"] for joint in robots["panda"]["joints"]] == JOINTS
    assert "robotdiffuse" in {planner["name"] for planner in server.get("/planners").json()}
    assert server.get("/health").json()["status"] == "ok" and gauge(server, "workers_ready") == 1
    page = server.get("/").text
    assert "/requests/{name}" in page and "http://" not in page and "https://" not in page
    description = server.get("/openapi.json").json()
    assert set(description["paths"]) >= {"/plan", "/verify", "/batch", "/robots"}
    schemas = description["components"]["schemas"]
    for name in re.findall(r'"#/components/schemas/(\w+)"', json.dumps(description)):
        assert name in schemas
    arguments = schemas["PlanRequest"]["properties"]
    assert set(arguments) == {"problem", *worker.ARGUMENTS} and all("description" in field for field in arguments.values())
    assert tuple(arguments["until"]["enum"]) == UNTIL
    assert arguments["velocity_scaling"]["minimum"] == MIN_SCALING, "it was said to be anything above 0"
    assert "robot" in schemas["Problem"]["required"]
    assert schemas["Error"]["required"] == ["error"] and "HTTPValidationError" not in schemas


def test_every_field_of_the_schema_may_be_sent_with_its_default_as_the_interactive_page_does(server: httpx.Client) -> None:
    """Regression: `objective`, and null for `clearance` and `jerk`, were refused."""
    assert "SwaggerUIBundle(" in server.get("/docs").text
    schemas = server.get("/openapi.json").json()["components"]["schemas"]
    fields = schemas["PlanRequest"]["properties"]
    example = {name: field["default"] for name, field in fields.items() if name != "problem"}
    assert {"objective", "jerk", "clearance"} <= set(example)
    example["problem"] = fields["problem"]["examples"][0]
    assert server.post("/plan", json=example).json()["status"] == "solved"
    assert "valid" in server.post("/verify", json=schemas["VerifyRequest"]["example"]).json()


@pytest.mark.parametrize("rate", [8, 100])
def test_rows_of_a_motion_at_a_rate(server: httpx.Client, rate: int) -> None:
    """Regression: the clearance was that of the motion before its rows were averaged, here half as much again."""
    plain = server.post("/plan", json=asked(1)).json()
    record = server.post("/plan", json=asked(1, rate=rate)).json()
    assert record["waypoints"] == plain["waypoints"]
    times = np.array(record["times"])
    assert np.allclose(times[:-1], np.arange(len(times) - 1) / rate) and record["duration"] == times[-1]
    motion = {name: record[name] for name in TRAJECTORY}
    verified = server.post("/verify", json={"problem": problem(), "trajectory": motion}).json()
    assert verified["valid"] and record["scene_clearance"] <= verified["trajectory"]["scene_clearance"] + 1e-9


def test_a_request_that_needs_too_much_memory_costs_its_worker(server: httpx.Client) -> None:
    """Regression: a request of 4.5 MB took 6.2 GB."""
    with recovers(server, renewed=1), ThreadPoolExecutor(2) as threads:
        hungry = threads.submit(server.post, "/plan", json=asked(EATS, "faulty"))
        after = threads.submit(server.post, "/plan", json=asked(3))
        assert server.get("/health", timeout=PROMPT).status_code in (200, 503)
    assert hungry.result().status_code == 413
    assert error(hungry.result()) == "the request needs more memory than a worker may use, 1400 MB"
    assert after.result().json()["status"] == "solved"


def test_a_request_beyond_its_time_limit_is_stopped(server: httpx.Client) -> None:
    with recovers(server, lost=1), ThreadPoolExecutor(1) as threads:
        late = threads.submit(server.post, "/plan", json=asked(HANGS, "faulty", time_limit=0.1))
        until(lambda: gauge(server, "workers_busy") == 1 or late.done())
        assert server.get("/health", timeout=PROMPT).status_code == 200
    assert late.result().status_code == 503 and "took too long: it was stopped, and its worker replaced" in error(late.result())


def test_large_requests_take_little_time(server: httpx.Client) -> None:
    keys = ", ".join(f'"k{i}": 0' for i in range(60_000))
    for body in (f'{{{keys}, "k0": 1}}', '"' + "[{" * 500_000, '{"problem": {"goal": "' + "\\u00e9" * 150_000):
        assert server.post("/plan", content=body, headers=JSON, timeout=PROMPT).status_code == 400


def test_slow_bodies_take_no_place_in_the_queue(server: httpx.Client) -> None:
    """Regression: twenty clients that sent a byte a second filled the queue."""
    head = b"POST /plan HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\nContent-Length: 99\r\n"
    address = server.base_url.host, server.base_url.port or 0
    with ExitStack() as stack:
        slow = [stack.enter_context(socket.create_connection(address, 60.0)) for _ in range(20)]
        for client in slow:
            client.sendall(head + b"\r\n{")
        for client in slow:
            client.sendall(b" ")
        assert server.post("/plan", json=asked(3), timeout=PROMPT).json()["status"] == "solved"
        assert slow[0].makefile("rb").readline().startswith(b"HTTP/1.1 408")
    assert server.get("/health").json()["requests_waiting"] == 0


@pytest.mark.parametrize(("seed", "line"), [(RAISES, "ValueError: no such thing"), (EXITS, "SystemExit: no license")])
def test_a_planner_that_fails_stops_neither_server_nor_worker(server: httpx.Client, seed: int, line: str) -> None:
    """Regression: the planner's SystemExit reached the server's event loop and stopped the server."""
    with recovers(server):
        answer = server.post("/plan", json=asked(seed, "faulty"))
        assert answer.status_code == 500 and error(answer) == line


def test_a_worker_that_dies_costs_one_request(server: httpx.Client) -> None:
    with recovers(server, lost=1), ThreadPoolExecutor(2) as threads:
        deadly = threads.submit(server.post, "/plan", json=asked(DIES, "faulty"))
        until(lambda: gauge(server, "workers_busy") == 1 or deadly.done())
        after = threads.submit(server.post, "/plan", json=asked(3))
    assert deadly.result().status_code == 500 and "died" in error(deadly.result())
    assert after.result().json()["status"] == "solved"


def test_cancelling_a_request_by_name_keeps_its_worker(server: httpx.Client) -> None:
    with recovers(server), ThreadPoolExecutor(1) as threads:
        named = {"X-Request-ID": "mine/1"}
        hangs = threads.submit(server.post, "/plan", json=asked(SEARCHES, "faulty"), headers=named)
        until(lambda: gauge(server, "workers_busy") == 1)
        assert server.post("/plan", json=asked(), headers=named).status_code == 409
        assert server.delete("/requests/mine%2F1").status_code == 200
    assert hangs.result().status_code == 409 and error(hangs.result()) == "the request was canceled"


def test_a_client_that_disconnects_frees_its_worker(server: httpx.Client) -> None:
    lines = "\n".join([json.dumps(asked(SEARCHES, "faulty"))] * 3)
    with recovers(server):
        with pytest.raises(httpx.ReadTimeout):
            server.post("/plan", json=asked(SEARCHES, "faulty"), timeout=BRIEF)
        with pytest.raises(httpx.ReadTimeout):
            server.post("/batch", content=lines, headers=LINES, timeout=BRIEF)
        until(lambda: gauge(server, "workers_busy") == 0 and gauge(server, "requests_waiting") == 0)


def test_a_full_queue_says_when_to_try_again(server: httpx.Client) -> None:
    with ThreadPoolExecutor(3) as threads:
        names = [{"X-Request-ID": f"{i}"} for i in range(3)]
        jobs = [threads.submit(server.post, "/plan", json=asked(SEARCHES, "faulty"), headers=name) for name in names]
        until(lambda: gauge(server, "workers_busy") + gauge(server, "requests_waiting") == 3)
        full = server.post("/plan", json=asked())
        batch = server.post("/batch", content=json.dumps(asked()), headers=LINES)
        for i in range(3):
            server.delete(f"/requests/{i}")
    assert (full.status_code, batch.status_code) == (429, 429)
    assert int(full.headers["Retry-After"]) >= 1 and "full" in error(full)
    assert [job.result().status_code for job in jobs] == [409] * 3
    assert server.post("/plan", json=asked(3)).status_code == 200


def test_a_worker_that_holds_too_much_memory_is_replaced_between_requests(server: httpx.Client) -> None:
    with recovers(server, renewed=1):
        assert server.post("/plan", json=asked(KEEPS, "faulty")).json()["status"] == "solved"


@pytest.mark.slow
def test_it_stops_gracefully_and_leaves_no_worker() -> None:
    with serving("--workers", "1", "--max-time-limit", "60") as (client, process), ThreadPoolExecutor(2) as threads:
        workers = subprocess.run(["pgrep", "-P", str(process.pid)], capture_output=True, text=True).stdout
        first = threads.submit(client.post, "/plan", json=asked(planner="aorrtc", time_limit=2.0, until="time_limit"))
        until(lambda: gauge(client, "workers_busy") == 1)
        second = threads.submit(client.post, "/plan", json=asked())
        until(lambda: gauge(client, "requests_waiting") == 1)
        process.send_signal(signal.SIGTERM)
        for worker in workers.split():  # as a service manager does
            os.kill(int(worker), signal.SIGTERM)
        assert first.result().json()["status"] == "solved"
        assert second.result().status_code == 503 and "stopping" in error(second.result())
        assert process.wait(300) == 0
        until(lambda: not any(os.path.exists(f"/proc/{worker}") for worker in workers.split()))


def test_a_request_that_the_second_signal_ends_gets_an_error() -> None:
    sent: list[Any] = []

    async def ended(*_: object) -> Any:
        raise asyncio.CancelledError

    async def send(message: Any) -> None:
        sent.append(message)

    scope = {"type": "http", "method": "GET", "path": "/", "raw_path": b"/", "client": None}
    asyncio.run(Access(ended, ServeSettings())(scope | {"headers": [(b"host", b"localhost")]}, ended, send))
    assert sent[0]["status"] == 503 and json.loads(sent[1]["body"]) == {"error": "the server is stopping"}


def test_a_server_for_other_machines_needs_a_token_and_logs_each_request(said: Said) -> None:
    assert "ROBOTDIFFUSE_TOKEN" in said(2, "serve", "--host", "0.0.0.0", "--port", "0")
    elsewhere = ("--workers", "1", "--host", "0.0.0.0")
    with serving(*elsewhere, stderr=subprocess.PIPE, ROBOTDIFFUSE_TOKEN="open sesame") as (client, process):
        told = {"Authorization": "Bearer open sesame"}
        assert client.get("/robots").status_code == 401
        assert client.get("/robots", headers=told).status_code == 200
        assert client.get("/robots", headers={"Authorization": "Bearer open"}).status_code == 401
        client.post("/plan", content=b"{}", headers=JSON | told | {"X-Request-ID": "mine\t1"})
        client.get("/nothing%0Ahere?token=secret", headers=told)
        process.send_signal(signal.SIGTERM)
        assert process.stderr is not None
        lines = process.stderr.read().splitlines()
    *_, mine, nothing = [line for line in lines if " 127.0.0.1:" in line]
    assert re.search(r" 127\.0\.0\.1:\d+ POST /plan 400 \d+\.\d{3} s 'mine\\t1'$", mine)
    assert re.search(r" 127\.0\.0\.1:\d+ GET /nothing%0Ahere 404 \d+\.\d{3} s -$", nothing)


def test_an_address_in_use_is_one_line(server: httpx.Client, said: Said) -> None:
    assert "cannot listen on 127.0.0.1" in said(2, "serve", "--port", server.base_url.port)


def test_robots_named_at_the_start(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROBOTDIFFUSE_ROBOTS", str(tmp_path))
    shutil.copytree(DATA / "panda", tmp_path / "mine")
    assert set(served_robots(["mine"])) == {*ROBOTS, "mine"}
    for name in ("panda", str(tmp_path / "mine")):  # the robot in the folder is also called panda
        refuses("the server has a robot named panda already", served_robots, [name])
    refuses("unknown robot 'yours'", served_robots, ["yours"])


def test_a_token_with_letters_beyond_ascii_is_known_as_utf_8_too() -> None:
    application = AsyncMock()
    access = Access(application, ServeSettings(token="pässwort"))
    for raw in ("Bearer pässwort".encode(), "Bearer pässwort".encode("latin-1")):
        scope = {"type": "http", "method": "GET", "path": "/robots", "raw_path": b"/robots", "client": None}
        headers = [(b"host", b"localhost"), (b"authorization", raw)]
        asyncio.run(access(scope | {"headers": headers}, AsyncMock(), AsyncMock()))
    assert application.await_count == 2
