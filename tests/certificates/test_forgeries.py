"""Forged certificates: a valid certificate that was altered, hashes included, is refused with the reason."""

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path as FilePath
from typing import Any

import numpy as np
import pytest

import robotdiffuse as rd
from helpers.box_arm import box_arm
from helpers.changes import later
from helpers.panda import PANDA
from robotdiffuse.certificates.proof import hash_of, request_parts, scene_parts
from robotdiffuse.certificates.requirements import not_checked
from robotdiffuse.cli.verify import described
from robotdiffuse.problems.files import problem_from_record
from robotdiffuse.trajectories.timing import time_parameterize

pytest.importorskip("pinocchio", reason="the extra `dynamics` (pin) is not installed")
HAND = "panda_hand"
START, MIDDLE, GOAL = ([turn, 0.2, 0.0, -2.0, 0.0, 2.2, 0.785] for turn in (-0.5, 0.0, 0.5))
Record = dict[str, Any]
"""The content of a certificate file."""


@pytest.fixture(scope="module")
def true(tmp_path_factory: pytest.TempPathFactory) -> tuple[FilePath, rd.Problem]:
    """A valid motion with a stop, near a table, beside a moving ball, with a payload, an axis cone and a speed limit."""
    table = rd.Box([0.5, 0.0, 0.194], [0.6, 1.6, 0.1], name="table")
    ball = rd.MovingObstacle(rd.Sphere([0.5, 1.4, 0.5], 0.1, "ball"), velocity=[0.0, -0.05, 0.0])
    cone = rd.AxisCone(HAND, [0, 0, 1], [0, 0, -1], 0.5)
    asked = {"waypoints": [MIDDLE], "moving": [ball], "constraints": [cone], "payload": rd.Payload(1.0, [0.0, 0.0, 0.05], HAND)}
    problem = rd.Problem(PANDA, rd.Scene([table]), START, GOAL, **asked)  # type: ignore[arg-type]
    ends = rd.Path(PANDA.joint_names, np.array([START, MIDDLE]))
    half = time_parameterize(PANDA, ends, lambda _: True, lambda _: True).trajectory
    positions = np.concatenate([half.positions, half.positions[1:] + np.subtract(GOAL, MIDDLE)])
    rates = [np.concatenate([of, of[1:]]) for of in (half.velocities, half.accelerations)]
    times = np.append(half.times, half.duration + half.times[1:])
    certificate = rd.certify(problem, rd.Trajectory(PANDA.joint_names, times, positions, *rates))
    assert certificate.check(problem).differences == () and certificate.proof.planes
    file = tmp_path_factory.mktemp("certificates") / "true.json"
    certificate.save(file)
    return file, problem


def sealed(record: Record) -> None:
    """Recomputes all hashes of the motion and the problem, as a forger would."""
    motion = record["motion"]
    rows = {name: np.array(motion[name], float) for name in motion if name != "joint_names"}
    made = rd.Trajectory if "times" in rows else rd.Path
    record["motion_hash"] = hash_of(made(tuple(motion["joint_names"]), **rows))
    problem = problem_from_record(record["problem"])
    record["scene_parts"], record["request_parts"] = scene_parts(problem.scene), request_parts(problem)


def entry(record: Record, planes: bool = True) -> Record:
    """The claim with the most planes, or with the most stretches."""
    return max(record["proof"], key=lambda one: len(one["planes"] if planes else one["start"]))


@later
def set_to(record: Any, *path: str | int, to: Any) -> None:
    """Sets one value."""
    for key in path[:-1]:
        record = record[key]
    record[path[-1]] = to


@later
def scaled_rows(record: Record, name: str, factor: float) -> None:
    record["motion"][name] = (factor * np.array(record["motion"][name])).tolist()


@later
def scaled_time(record: Record, factor: float) -> None:
    """Scales times, velocities and accelerations so that they agree with each other."""
    for name, power in (("times", 1), ("velocities", -1), ("accelerations", -2)):
        scaled_rows(name, factor**power)(record)
    for name in ("between", "looks"):
        record[name] = (factor * np.array(record[name])).tolist()


@later
def shifted_time(record: Record, by: float) -> None:
    for part, name in ((record["motion"], "times"), (record, "between"), (record, "looks")):
        part[name] = (np.array(part[name]) + by).tolist()


@later
def of_widest(record: Record, name: str, change: Callable[[Any], Any], planes: bool = False) -> None:
    claim = entry(record, planes)
    claim[name] = change(claim[name])


def without_rows(record: Record, rows: int | slice) -> None:
    """Leaves out rows of the motion."""
    for name in ("positions", "velocities", "accelerations", "times"):
        del record["motion"][name][rows]


def sparse(record: Record) -> None:
    """Keeps only two rows at rest, far apart, and nothing between them."""
    without_rows(record, slice(1, -1))
    record.update(between=[], looks=[], jerks=[])


def without_rates(record: Record) -> None:
    """Makes the motion a path, whose velocities and moving obstacles would not be checked."""
    for name in ("times", "velocities", "accelerations"):
        del record["motion"][name]
    record.update(between=[], looks=[], jerks=[])


def without_stop(record: Record) -> None:
    """Leaves out the row in the middle, at which the motion stops."""
    without_rows(record, record["motion"]["positions"].index(MIDDLE))


def bulge(record: Record) -> None:
    """Adds velocities, opposite at two neighboring rows, to a joint at rest. The positions do not have these velocities."""
    for row, speed in ((40, 0.5), (41, -0.5)):
        record["motion"]["velocities"][row][6] = speed


def reversed_proof(record: Record) -> None:
    for name in ("start", "stop", "clearance", "displacement"):
        entry(record, planes=False)[name].reverse()


@later
def of_claims(record: Record, **changes: Callable[[Record], Any]) -> None:
    """Sets fields of every claim, each computed by a function from the claim."""
    for claim in record["proof"]:
        claim.update({name: change(claim) for name, change in changes.items()})


@later
def normals(record: Record, factor: float) -> None:
    of_claims(planes=lambda one: [[*p[:3], *(factor * x for x in p[3:])] for p in one["planes"]])(record)


FIELDS = ("start", "stop", "clearance", "displacement", "by_planes", "planes")


@later
def without(record: Record, name: str, **rest: Any) -> None:
    """Removes a field of the problem; `rest` are fields of the certificate that it sets."""
    del record["problem"][name]
    record.update(rest)


IN_THE_WAY = {"sphere": {"center": [0, 0, 0.6], "radius": 0.3}}
CLOSED = {"panda_finger_joint1": 0.0, "panda_finger_joint2": 0.0}
FORGED: dict[str, tuple[Callable[[Record], object], str]] = {
    # planes
    "normals of denormal length": (normals(1e-310), "has a normal of length"),
    "normals of small length": (normals(1e-160), "has a normal of length"),
    "normals of huge length": (normals(1e200), "has a normal of length|is not the normal"),
    "normals a millionth too long": (normals(1 + 1e-6), "has a normal of length"),
    "normals of length 0": (normals(0.0), "is not the normal of a plane"),
    "normals turned round": (normals(-1.0), "proof: (clearance|displacement) of "),
    "normals not finite": (normals(float("nan")), "not the normal|NaN|JSON|finite"),
    "planes left out": (of_widest("planes", lambda _: [], True), "proof: (clearance|displacement) of "),
    "planes of another stretch": (of_widest("planes", lambda x: [[p[0] + 10**6, *p[1:]] for p in x], True), "has no stretch"),
    "planes without their mark": (of_widest("by_planes", lambda _: [], True), "planes are given"),
    # stretches
    "stretches without length": (of_claims(stop=lambda one: one["start"]), "has a gap or an overlap between rows"),
    "stretches that end early": (of_widest("stop", lambda x: [*x[:-1], x[-1] - 0.5]), "has a gap or an overlap between rows"),
    "stretches that begin late": (of_widest("start", lambda x: [0.5, *x[1:]]), "has a gap or an overlap between rows"),
    "stretches beyond the motion": (of_widest("stop", lambda x: [*x[:-1], x[-1] + 9]), "has a gap or an overlap between rows"),
    "stretches backwards": (reversed_proof, "has a gap or an overlap between rows"),
    "no stretches": (of_claims(**dict.fromkeys(FIELDS, lambda _: [])), "has a gap or an overlap between rows"),
    "a claim twice": (lambda record: record["proof"].append(record["proof"][0]), "contains a claim twice"),
    "a claim against nothing": (set_to("proof", 0, "against", to="nothing"), "needs no proof"),
    "a claim of another link": (set_to("proof", 0, "link", to="panda_hand"), "proof: "),
    "no claims": (set_to("proof", to=[]), "is missing"),
    "more clearance": (of_widest("clearance", lambda x: [v + 1e-3 for v in x]), "proof: clearance of"),
    "less displacement": (of_widest("displacement", lambda x: [0.0 for _ in x]), "proof: displacement of"),
    "endless clearance": (of_widest("clearance", lambda x: [1e308 for _ in x]), "clearance"),
    "clearance of 5 m": (set_to("scene_clearance", to=5.0), "5 m; it must be positive, and at most 1 m"),
    "clearance below 0": (set_to("self_clearance", to=-1.0), "-1 m; it must be positive"),
    "no moving claim": (lambda record: record["moving"].pop(), "is missing"),
    "less displacement beside what moves": (
        lambda record: record["moving"][0].update(displacement=[0.0] * len(record["moving"][0]["start"])),
        "proof: displacement of .* against ball from row .* is ",
    ),
    "a gap beside what moves": (
        lambda record: record["moving"][0]["stop"].__setitem__(-1, record["moving"][0]["stop"][-1] - 0.5),
        "proof: .*ball has a gap or an overlap between rows",
    ),
    "no proof": (set_to("proof", to=None), "proof is None; it takes list"),
    "nothing about what moves": (set_to("moving", to=None), "the part on moving obstacles is missing"),
    # tolerances
    "a missing tolerance": (lambda record: record["tolerances"].pop("chord"), "tolerances has no chord"),
    "a negative tolerance": (set_to("tolerances", "limit_slack", to=-1.0), "must not be negative"),
    "a narrower chord": (set_to("tolerances", "chord", to=1e-9), "its cubics leave the straight lines"),
    "a wide chord": (set_to("tolerances", "chord", to=1.0), "looser than"),
    "a wide goal": (set_to("tolerances", "goal_tolerance", to=10.0), "looser than"),
    "an endless tolerance": (set_to("tolerances", "rate_slack", to=1e308), "looser than"),
    "a tolerance that is not finite": (set_to("tolerances", "rest", to=float("nan")), "finite|NaN"),
    # the motion
    "times 1000 s earlier": (shifted_time(-1000.0), "times begin at -1000 s, not at 0"),
    "times 1000 s later": (shifted_time(1000.0), "times begin at 1000 s, not at 0"),
    "times a little later": (shifted_time(1e-6), "not at 0"),
    "twice as fast": (scaled_time(0.5), "exceeds its limit of"),
    "a little faster": (scaled_time(0.95), "exceeds its limit of"),
    "times alone faster": (scaled_rows("times", 0.5), "exceeds its limit of|inside the motion"),
    "times backwards": (scaled_rows("times", -1.0), "do not increase|inside the motion"),
    "velocities of 0": (scaled_rows("velocities", 0.0), "along its cubics"),
    "velocities turned round": (scaled_rows("velocities", -1.0), "along its cubics"),
    "accelerations of 0": (scaled_rows("accelerations", 0.0), "accelerations of .* off those of its cubics"),
    "accelerations turned round": (scaled_rows("accelerations", -1.0), "off those of its cubics"),
    "a row at rest": (set_to("motion", "velocities", 40, to=[0.0] * 7), "along its cubics"),
    "a bulge between two rows": (bulge, "along its cubics"),
    "two rows": (sparse, "its cubics leave the straight lines"),
    "a row twice": (lambda x: x["motion"]["positions"].__setitem__(40, x["motion"]["positions"][60]), "exceeds its limit of"),
    "no rates": (without_rates, "nothing about|prove anything about moving"),
    "no stop at the waypoint": (without_stop, "does not stop at waypoints"),
    "another start": (set_to("motion", "positions", 0, 6, to=0.8), "off the start"),
    "another end": (set_to("motion", "positions", -1, 6, to=0.8), "does not end at the goal"),
    "a row out of limits": (set_to("motion", "positions", 50, 5, to=9.0), "leaves its limits"),
    "places beyond the motion": (set_to("between", to=[-1.0]), "`between` must be inside the motion"),
    "samples beyond the motion": (set_to("looks", to=[1e5]), "`looks` must be inside the motion"),
    # what is stated besides
    "less jerk": (set_to("jerks", 0, 1, to=1.0), "jerks: that of panda_joint1"),
    "less torque": (set_to("torques", 1, 1, to=1.0), "torques: the bound of panda_joint2"),
    "no torques": (set_to("torques", to=[]), "torques: they are not those"),
    "a smaller angle": (set_to("constraints", 0, 1, to=0.0), "constraints: the bound of axis_cone"),
    "no constraints": (set_to("constraints", to=[]), "constraints: they are not those"),
    "another name": (set_to("robot", to="ur5e"), "robot: the problem has panda, the certificate ur5e"),
    "spheres of before": (set_to("robot_parts", "spheres of panda_link5", to="0" * 16), "has changed"),
    "an unknown field": (set_to("holds", to=True), "holds is unknown"),
    # the problem, judged by the true one
    "a lower table": (set_to("problem", "scene", 0, "box", "center", 2, to=-0.006), "table has changed"),
    "an allowed contact": (set_to("problem", "allowed_contacts", to={"table": "all"}), "may touch table is"),
    "a wider cone": (set_to("problem", "constraints", 0, "axis_cone", "angle", to=3.0), r"constraints\[0\]"),
    "a lighter load": (set_to("problem", "payload", "mass", to=0.01), "requests: payload has changed"),
    "a ball at rest": (set_to("problem", "moving", 0, "velocity", to=[0.0] * 3), "moving ball has changed"),
    "no ball": (without("moving", moving=None), "moving ball was added"),
    "no load": (without("payload", torques=[]), "payload was added"),
    # the problem, judged by itself
    "closed fingers": (set_to("problem", "locked", to=CLOSED), "joint panda_finger_joint1 has changed"),
    "a faster ball": (set_to("problem", "moving", 0, "velocity", to=[0, -1, 0]), "shown to be free|proof: "),
    "a ball of unknown motion": (lambda record: record["problem"]["moving"][0].update(velocity=None, max_speed=1.0), "proof: "),
    "an obstacle in the way": (lambda record: record["problem"]["scene"].append(IN_THE_WAY), "is not shown to be free"),
    # the hashes are not forged
    "an obstacle left out": (lambda record: record["problem"]["scene"].pop(), "scene: table is missing"),
    "a moved waypoint": (set_to("motion", "positions", 7, 2, to=0.1), "not the one that was certified: its"),
}
ALONE = [*FORGED][-6:]
PLAIN = [*FORGED][-2:]


@pytest.mark.parametrize("name", FORGED)
def test_forgeries_are_refused_with_the_reason(name: str, true: tuple[FilePath, rd.Problem], tmp_path: FilePath) -> None:
    forge, wanted = FORGED[name]
    record = json.loads(true[0].read_text())
    forge(record)
    file = tmp_path / "forged.json"
    try:
        if name not in PLAIN:
            sealed(record)
        file.write_text(json.dumps(record))
        found = rd.load_certificate(file).check(None if name in ALONE else true[1]).differences
    except rd.InputError as error:
        found = (str(error),)
    assert any(re.search(wanted, line) for line in found), found
    assert not [line for line in found if "\n" in line]


def test_another_robot_is_caught_and_named(true: tuple[FilePath, rd.Problem]) -> None:
    certificate, problem = rd.load_certificate(true[0]), true[1]
    assert certificate.check().differences == certificate.check(problem).differences == ()
    opened = replace(problem, robot=problem.robot.with_locked({"panda_finger_joint1": 0.01}))
    assert "robot: joint panda_finger_joint1 has changed" in certificate.check(opened).differences
    wider = dict(problem.robot.spheres) | {"panda_link5": problem.robot.spheres["panda_link5"] * 1.1}
    found = certificate.check(replace(problem, robot=replace(problem.robot, spheres=wider))).differences
    assert "robot: spheres of panda_link5 has changed" in found
    found = certificate.check(rd.Problem(box_arm(), problem.scene, [0, 0, 0], [0, 0, 0])).differences
    assert any(line.startswith("motion: its joints are panda_joint1") for line in found)


def test_thin_spheres_are_refused() -> None:
    thin = {link: spheres * [1, 1, 1, 0.5] for link, spheres in PANDA.spheres.items()}
    problem = rd.Problem(replace(PANDA, spheres=thin), rd.Scene(), START, GOAL)
    found = rd.certify(problem, rd.Path(PANDA.joint_names, np.array([START, GOAL]))).check(problem).differences
    assert any(re.match("robot: the meshes of panda_link5 stick out of its spheres by 0.0", line) for line in found)


def test_the_robot_is_described() -> None:
    panda = rd.load_robot("panda", {"panda_finger_joint1": 0.01})
    assert described(panda) == "panda, the bundled one"
    small = {link: tuple(replace(m, vertices=0.5 * m.vertices) for m in of) for link, of in panda.meshes.items()}
    shrunk = described(replace(panda, meshes=small, source="/robots/panda"))
    assert shrunk.startswith("panda from /robots/panda, not the bundled one: meshes of panda_link0 has changed")
    assert "not bundled" in described(replace(panda, name="mine"))


def test_what_is_not_checked_is_told(true: tuple[FilePath, rd.Problem]) -> None:
    problem = rd.Problem(PANDA, rd.Scene(), START, GOAL, start_velocity=[0.1, 0, 0, 0, 0, 0, 0])
    assert "start_velocity" in not_checked(problem, rd.Path(PANDA.joint_names, np.array([START, GOAL])))
    assert not_checked(true[1], rd.load_certificate(true[0]).motion) == ["sharp reversals"]
