"""A real server on a port of its own: answers, errors, cancellation, and recovery from dead workers."""

import json
import os
import re
import shutil
import signal
import subprocess
import time
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

import robotdiffuse as rd
from helpers import waiting
from helpers.commands import run
from helpers.faulty_planner import DIES, EXITS, HANGS, RAISES, SEARCHES
from helpers.serving import serving
from robotdiffuse.cli.serve import served_robots
from robotdiffuse.core.types import UNTIL
from robotdiffuse.problems.files import problem_from_record
from robotdiffuse.robots import DATA, ROBOTS

pytest.importorskip("fastapi")

from robotdiffuse.server import worker

LEFT = [0.9, 0.3, 0.0, -1.9, 0.0, 2.2, 0.785]
RIGHT = [-0.9, 0.3, 0.0, -1.9, 0.0, 2.2, 0.785]
JOINTS = [f"panda_joint{i}" for i in range(1, 8)]
JSON, LINES = {"Content-Type": "application/json"}, {"Content-Type": "application/x-ndjson"}
TRAJECTORY = ("joint_names", "times", "positions", "velocities", "accelerations")


def problem(height: float = 0.4, **changed: Any) -> dict[str, Any]:
    wall = {"box": {"center": [0.45, 0.0, height], "size": [0.3, 0.05, 0.4], "name": "wall"}}
    return {"robot": "panda", "scene": [wall], "start": LEFT, "goal": {"joints": RIGHT}} | changed


def asked(seed: int = 0, planner: str = "rrt_connect", height: float = 0.4, **more: Any) -> dict[str, Any]:
    return {"problem": problem(height), "planner": planner, "seed": seed, "time_limit": 2.0} | more


def gauge(server: httpx.Client, name: str) -> float:
    found = re.search(rf"^robotdiffuse_{name} (\S+)$", server.get("/metrics").text, re.MULTILINE)
    assert found is not None
    return float(found.group(1))


until = partial(waiting.until, patience=30.0)


def error(answer: httpx.Response) -> str:
    line = answer.json()["error"]
    assert line and "\n" not in line and "Traceback" not in line
    return line


def test_a_plan_is_that_of_the_bare_planner_and_the_validator_agrees(server: httpx.Client) -> None:
    answer = server.post("/plan", json=asked(3))
    assert answer.status_code == 200
    record = answer.json()
    bare = rd.load_planner("rrt_connect").plan(problem_from_record(problem()), 20.0, seed=3)
    assert bare.path is not None and np.array_equal(record["waypoints"], bare.path.positions)
    motion = {
        "problem": problem(),
        "path": {"joint_names": record["joint_names"], "positions": record["waypoints"]},
        "trajectory": {name: record[name] for name in TRAJECTORY},
    }
    verdict = server.post("/verify", json=motion).json()
    assert verdict["valid"] and verdict["trajectory"]["valid"] and verdict["path"]["min_clearance"] > 0


def test_a_motion_through_the_wall_is_not_valid(server: httpx.Client) -> None:
    motion = {"problem": problem(), "path": {"joint_names": JOINTS, "positions": [LEFT, RIGHT]}}
    verdict = server.post("/verify", json=motion).json()
    assert not verdict["valid"]
    assert verdict["path"]["violation"]["kind"] == "scene_collision"
    assert verdict["path"]["violation"]["other"] == "wall"


def test_no_plan_is_an_answer(server: httpx.Client) -> None:
    buried = problem(scene=[{"sphere": {"center": [0, 0, 0.3], "radius": 0.5}}])
    answer = server.post("/plan", json={"problem": buried})
    assert answer.status_code == 200 and answer.json()["status"] == "invalid_start"


def test_every_field_of_the_schema_may_be_sent_with_its_default(server: httpx.Client) -> None:
    """`objective`, and null for `clearance` and `jerk`, were refused."""
    buried = problem(scene=[{"sphere": {"center": [0, 0, 0.3], "radius": 0.5}}])
    fields = server.get("/openapi.json").json()["components"]["schemas"]["PlanRequest"]["properties"]
    defaults = {name: field["default"] for name, field in fields.items() if name != "problem"}
    assert {"objective", "jerk", "clearance"} <= set(defaults)
    answer = server.post("/plan", json={"problem": buried} | defaults)
    assert answer.status_code == 200 and answer.json()["status"] == "invalid_start"


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
        ("/plan", asked(time_limit=6.0), 400, "at most 5 s here"),
        ("/plan", asked(time_limit="1"), 400, "time_limit is '1'; it takes float above 0"),
        ("/plan", asked(until=[1]), 400, r"until is \[1\]; it takes first, converged, time_limit"),
        ("/plan", asked(seed=2**40), 400, "it must be at most 4294967295"),
        ("/plan", asked(seed=True), 400, "seed is True; it takes int"),
        ("/plan", asked(objective="cost"), 400, "unknown objective 'cost'; known: length, time"),
        ("/plan", asked(clearance=-1.0), 400, "clearance is -1.0"),
        ("/plan", asked(velocity_scaling=1e-300), 400, "velocity_scaling is 1e-300; it must be between"),
        ("/plan", asked(acceleration_scaling=1e-6), 400, "acceleration_scaling is 1e-06; it must be between"),
        ("/plan", asked(jerk=1e-300), 400, "jerk is 1e-300; it must be at least 0.01"),
        ("/plan", {"problem": problem(robot="/etc/passwd")}, 400, "unknown robot '/etc/passwd'; known: "),
        ("/plan", {"problem": problem(robot="../panda")}, 400, "unknown robot"),
        ("/plan", {"problem": problem(scene="scene.yaml")}, 400, "is a file, and files are not read here"),
        (
            "/plan",
            {"problem": problem(scene=[{"mesh": {"file": "/etc/passwd.stl"}}])},
            400,
            "files are not read here",
        ),
        ("/plan", {"problem": problem(scene=[{"mesh": {"file": "no.stl"}}])}, 400, "files are not read here"),
        ("/verify", {"problem": problem()}, 400, "neither path nor trajectory"),
        ("/verify", {"problem": problem(), "path": {"joint_names": JOINTS}}, 400, "path has no positions"),
        (
            "/verify",
            {"problem": problem(), "path": {"joint_names": JOINTS, "positions": [[1e9] * 7]}},
            400,
            "its numbers must be finite and within",
        ),
        ("/plan", b" " * (2**20 + 1), 413, "it may have 1048576 bytes"),
    ],
)
def test_wrong_requests_are_one_line(
    server: httpx.Client, path: str, body: Any, code: int, message: str
) -> None:
    content = body if isinstance(body, bytes) else json.dumps(body)
    answer = server.post(path, content=content, headers=JSON)
    assert answer.status_code == code
    assert re.search(message, error(answer))


def test_other_hosts_content_types_and_methods_are_refused(server: httpx.Client) -> None:
    rebound = server.post("/plan", json=asked(), headers={"Host": "evil.example"})
    form = server.post("/plan", content=json.dumps(asked()), headers={"Content-Type": "text/plain"})
    assert (rebound.status_code, form.status_code) == (421, 415)
    assert server.get("/plan").status_code == 405 and server.get("/../../etc/passwd").status_code == 404
    for answer in (rebound, form, server.get("/plan"), server.get("/etc"), server.delete("/requests/x")):
        error(answer)


def test_lists_health_metrics_and_a_page_without_scripts(server: httpx.Client) -> None:
    robots = {robot["name"]: robot for robot in server.get("/robots").json()}
    assert [joint["name"] for joint in robots["panda"]["joints"]] == JOINTS
    assert "robotdiffuse" in {planner["name"] for planner in server.get("/planners").json()}
    assert server.get("/health").json()["status"] == "ok"
    assert gauge(server, "workers_ready") == 1
    page = server.get("/docs").text
    assert "/requests/{name}" in page and "http://" not in page and "https://" not in page
    description = server.get("/openapi.json").json()
    assert set(description["paths"]) >= {"/plan", "/verify", "/batch", "/robots"}
    schemas = description["components"]["schemas"]
    for name in re.findall(r'"#/components/schemas/(\w+)"', json.dumps(description)):
        assert name in schemas
    assert tuple(schemas["PlanRequest"]["properties"]["until"]["enum"]) == UNTIL
    assert set(schemas["PlanRequest"]["properties"]) == {"problem", *worker.ARGUMENTS}
    assert schemas["Error"]["required"] == ["error"] and "HTTPValidationError" not in schemas


def test_an_exception_is_one_line(server: httpx.Client) -> None:
    answer = server.post("/plan", json=asked(RAISES, "faulty"))
    assert answer.status_code == 500 and error(answer) == "ValueError: no such thing"


def test_a_planner_that_exits_stops_neither_server_nor_worker(server: httpx.Client) -> None:
    """Its SystemExit reached the server's event loop and stopped it."""
    lost = gauge(server, "workers_lost_total")
    answer = server.post("/plan", json=asked(EXITS, "faulty"))
    assert answer.status_code == 500 and error(answer) == "SystemExit: no licence"
    assert server.post("/plan", json=asked(3)).json()["status"] == "solved"
    assert gauge(server, "workers_lost_total") == lost


def test_a_worker_that_dies_costs_one_request(server: httpx.Client) -> None:
    lost = gauge(server, "workers_lost_total")
    with ThreadPoolExecutor(2) as threads:
        deadly = threads.submit(server.post, "/plan", json=asked(DIES, "faulty"))
        until(lambda: gauge(server, "workers_busy") == 1 or deadly.done())
        after = threads.submit(server.post, "/plan", json=asked(3))
    assert deadly.result().status_code == 500 and "died" in error(deadly.result())
    assert after.result().json()["status"] == "solved"
    assert gauge(server, "workers_lost_total") == lost + 1


def test_cancelling_a_request_by_name_keeps_its_worker(server: httpx.Client) -> None:
    lost = gauge(server, "workers_lost_total")
    with ThreadPoolExecutor(1) as threads:
        named = {"X-Request-ID": "mine/1"}
        hangs = threads.submit(server.post, "/plan", json=asked(SEARCHES, "faulty"), headers=named)
        until(lambda: gauge(server, "workers_busy") == 1)
        time.sleep(0.2)
        assert server.post("/plan", json=asked(), headers=named).status_code == 409
        assert server.delete("/requests/mine%2F1").status_code == 200
    assert hangs.result().status_code == 409 and error(hangs.result()) == "the request was cancelled"
    assert server.post("/plan", json=asked(3)).json()["status"] == "solved"
    assert gauge(server, "workers_lost_total") == lost


def test_a_client_that_disconnects_frees_its_worker(server: httpx.Client) -> None:
    lost = gauge(server, "workers_lost_total")
    lines = "\n".join([json.dumps(asked(SEARCHES, "faulty"))] * 3)
    with pytest.raises(httpx.ReadTimeout):
        server.post("/plan", json=asked(SEARCHES, "faulty"), timeout=0.5)
    with pytest.raises(httpx.ReadTimeout):
        server.post("/batch", content=lines, headers=LINES, timeout=0.5)
    until(lambda: gauge(server, "workers_busy") == 0 and gauge(server, "requests_waiting") == 0)
    assert server.post("/plan", json=asked(3)).json()["status"] == "solved"
    assert gauge(server, "workers_lost_total") == lost


def test_a_planner_that_ignores_its_time_limit_costs_its_worker(server: httpx.Client) -> None:
    lost = gauge(server, "workers_lost_total")
    with pytest.raises(httpx.ReadTimeout):
        server.post("/plan", json=asked(HANGS, "faulty"), timeout=0.5)
    assert server.post("/plan", json=asked(3)).json()["status"] == "solved"
    assert gauge(server, "workers_lost_total") == lost + 1


def test_a_full_queue_says_when_to_try_again(server: httpx.Client) -> None:
    with ThreadPoolExecutor(3) as threads:
        jobs = []
        for i in range(3):
            named = {"X-Request-ID": f"{i}"}
            jobs.append(threads.submit(server.post, "/plan", json=asked(SEARCHES, "faulty"), headers=named))
        until(lambda: gauge(server, "workers_busy") + gauge(server, "requests_waiting") == 3)
        full = server.post("/plan", json=asked())
        batch = server.post("/batch", content=json.dumps(asked()), headers=LINES)
        for i in range(3):
            server.delete(f"/requests/{i}")
    assert (full.status_code, batch.status_code) == (429, 429)
    assert int(full.headers["Retry-After"]) >= 1 and "full" in error(full)
    assert [job.result().status_code for job in jobs] == [409] * 3
    assert server.post("/plan", json=asked(3)).status_code == 200


@pytest.mark.slow
def test_a_worker_that_holds_too_much_memory_is_replaced_between_requests() -> None:
    with serving("--workers", "1", "--max-worker-memory", "1") as (client, _):
        for _ in range(2):
            assert client.post("/plan", json=asked(3)).json()["status"] == "solved"
        assert gauge(client, "workers_renewed_total") == 2 and gauge(client, "workers_lost_total") == 0


@pytest.mark.slow
def test_it_stops_gracefully_and_leaves_no_worker() -> None:
    with serving("--workers", "1") as (client, process), ThreadPoolExecutor(2) as threads:
        workers = subprocess.run(["pgrep", "-P", str(process.pid)], capture_output=True, text=True).stdout
        slow = asked(planner="aorrtc", time_limit=2.0, until="time_limit")
        first = threads.submit(client.post, "/plan", json=slow)
        until(lambda: gauge(client, "workers_busy") == 1)
        second = threads.submit(client.post, "/plan", json=asked())
        until(lambda: gauge(client, "requests_waiting") == 1)
        process.send_signal(signal.SIGTERM)
        for worker in workers.split():  # as a service manager does
            os.kill(int(worker), signal.SIGTERM)
        assert first.result().json()["status"] == "solved"
        assert second.result().status_code == 503 and "stopping" in error(second.result())
        assert process.wait(30) == 0
        until(lambda: not any(os.path.exists(f"/proc/{worker}") for worker in workers.split()))


def test_a_server_for_other_machines_needs_a_token(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("serve", "--host", "0.0.0.0", "--port", "0") == 2
    assert "ROBOTDIFFUSE_TOKEN" in capsys.readouterr().err
    with serving("--workers", "1", "--host", "0.0.0.0", ROBOTDIFFUSE_TOKEN="open sesame") as (client, _):
        assert client.get("/robots").status_code == 401
        told = {"Authorization": "Bearer open sesame"}
        assert client.get("/robots", headers=told).status_code == 200
        assert client.get("/robots", headers={"Authorization": "Bearer open"}).status_code == 401


def test_an_address_in_use_is_one_line(server: httpx.Client, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("serve", "--port", server.base_url.port) == 2
    assert "cannot listen on 127.0.0.1" in capsys.readouterr().err


def test_robots_named_at_the_start(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROBOTDIFFUSE_ROBOTS", str(tmp_path))
    shutil.copytree(DATA / "panda", tmp_path / "mine")
    assert set(served_robots(["mine"])) == {*ROBOTS, "mine"}
    for name in ("panda", str(tmp_path / "mine")):  # the robot in the folder is also called panda
        with pytest.raises(rd.InputError, match="has the name panda of another robot"):
            served_robots([name])
    with pytest.raises(rd.InputError, match="unknown robot 'yours'"):
        served_robots(["yours"])
