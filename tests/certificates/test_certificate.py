"""Certificates: valid motions can be certified, certified motions are free, and tampering is detected."""

from dataclasses import asdict
from pathlib import Path as FilePath

import numpy as np
import pytest
import trimesh

import robotdiffuse as rd
from helpers.box_arm import box_arm
from helpers.commands import python
from helpers.refusals import refuses
from robotdiffuse.certificates.bounds import Prover, Stretches
from robotdiffuse.certificates.checker import describe_claim
from robotdiffuse.certificates.proof import StretchProof, Tolerances, hash_of, robot_parts, scene_parts
from robotdiffuse.certificates.search import NotValidError
from robotdiffuse.collision.exact_meshes import ExactCollision
from robotdiffuse.scenes.shapes import Shape
from robotdiffuse.validation.report import Report
from robotdiffuse.validation.validator import VerifySettings

SWING = np.array([[-0.6, 0.2, 0.3], [0.6, 0.2, 0.3], [0.6, 0.9, 0.3]])


def problem_of(rows: np.ndarray, *shapes: Shape) -> tuple[rd.Problem, rd.Path]:
    robot = box_arm()
    return rd.Problem(robot, rd.Scene(shapes), rows[0], rd.JointGoal(rows[-1:])), rd.Path(robot.joint_names, rows)


def near_things() -> dict[str, tuple[Shape, ...]]:
    shelf = rd.Box([0.6, 0, -0.032 - 0.05], [1.5, 1.5, 0.1])
    sides = trimesh.creation.box(shelf.size)
    side = np.linspace(-0.7, 0.7, 30)
    cloud = np.stack(np.meshgrid(side + 0.6, side, [-0.037]), axis=-1).reshape(-1, 3)
    return {
        "nothing": (),
        "far": (rd.Sphere([0, -1, 0], 0.2),),
        "a box 2 mm below": (shelf,),
        "a mesh 2 mm below": (rd.Mesh(sides.vertices, sides.faces, shelf.center),),
        "points 2 mm below": (rd.PointCloud(cloud, 0.005),),
    }


@pytest.mark.parametrize("name", near_things())
def test_what_is_valid_can_be_certified_and_what_is_certified_is_free(name: str) -> None:
    problem, path = problem_of(SWING, *near_things()[name])
    report = rd.verify(problem, path)
    certificate = rd.certify(problem, path)
    assert certificate.check(problem).differences == ()
    exact = ExactCollision(problem.robot, problem.scene)
    q = np.stack([np.interp(np.linspace(0, 2, 60), np.arange(3), column) for column in SWING.T], axis=1)
    least = min(d.distance for row in q for d in exact.distances(row) if d.other not in problem.robot.link_names)
    assert report.scene_clearance is not None
    assert 0.5 * report.scene_clearance - 1e-4 <= certificate.scene_clearance <= min(least, 1.0)
    assert bool(certificate.proof.planes) == ("below" in name)


def test_motions_that_are_not_valid_and_certificates_without_their_problem_are_refused() -> None:
    problem, path = problem_of(SWING, rd.Sphere([1.1, 0.3, 0], 0.1))
    with pytest.raises(NotValidError, match=r"the motion is not valid: l\d is .* inside sphere"):
        rd.certify(problem, path)
    problem, path = problem_of(SWING)
    refuses("holds no problem; give the problem that it is for", rd.certify(problem, path).check)


def test_the_checker_loads_neither_compiled_code_nor_coal() -> None:
    """The checker is independent of the validator's code, and starts in a fraction of the validator's time."""
    code = (
        "import sys, robotdiffuse.certificates.checker, robotdiffuse.problems.files\n"
        "print([m for m in ('numba', 'coal', 'torch') if m in sys.modules])\n"
        "own = 'robotdiffuse.collision', 'robotdiffuse.validation.validator'\n"
        "print([m for m in sys.modules if m.startswith(own)])"
    )
    assert python(code).stdout == "[]\n[]\n"


STEPS = np.arange(5264.0)
# 2 rad in 20 ms, and a row a nanosecond after the last
SHORT_STEP = np.append(np.linspace(0, 2, 21), 2.0), np.append(np.arange(21) * 1e-3, 0.02 + 1e-9)
TOO_QUICK = {
    "one short step": (*SHORT_STEP, "mean velocity between rows"),
    "1e-8 s": (1.9e-6 * STEPS, STEPS * 1e-8, "mean velocity from one row to another"),
    "5e-7 s": (1.9e-6 * STEPS, STEPS * 5e-7, "mean velocity from one row to another"),
    "1e-6 s": (1.9e-6 * STEPS, STEPS * 1e-6, "mean acceleration computed from positions"),
}


@pytest.mark.parametrize("name", TOO_QUICK)
def test_short_steps_hide_no_rate_from_the_checker(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The validator, which would reject these motions, is patched to accept them."""
    place, times, wanted = TOO_QUICK[name]
    problem, path = problem_of(np.outer(place, [1, 0, 0]))
    still = np.zeros_like(path.positions)
    motion = rd.Trajectory(path.joint_names, times, path.positions, still, still)
    monkeypatch.setattr("robotdiffuse.certificates.search.verify", lambda *_: Report(True, None, 1.0, 0.2))
    found = rd.certify(problem, motion).check(problem).differences
    assert any(wanted in line for line in found), found
    assert all(line.startswith("motion: ") and "j0" in line for line in found), found


@pytest.mark.parametrize("with_times", [False, True])
def test_an_empty_proof_of_one_row_is_none(with_times: bool) -> None:
    """Start and goal are inside a box; a motion of one row has no intervals that stretches could miss."""
    robot = box_arm()
    here = np.zeros((1, 3))
    problem = rd.Problem(robot, rd.Scene([rd.Box([0.3, 0, 0], [2, 2, 2])]), here[0], rd.JointGoal(here))
    motion = rd.Trajectory(robot.joint_names, np.zeros(1), here, here, here)
    motion = motion if with_times else rd.Path(robot.joint_names, here)
    none = np.zeros(0)
    claims = Prover(robot, problem.scene, here, np.zeros((0, 3))).claims
    proof = StretchProof(claims, Stretches(none.astype(int), none, none), none.astype(bool), none, none, ())
    parts = robot_parts(robot), scene_parts(problem.scene), hash_of(motion)
    certificate = rd.Certificate(robot.name, *parts, Tolerances(), motion, none, 0.5, 0.5, proof)
    missing = tuple(f"proof: {describe_claim(claim)} has a gap or an overlap between rows 0 and 0" for claim in claims)
    assert certificate.check(problem).differences == missing


def test_tolerances_are_those_of_the_validator() -> None:
    """The checker has its own copy of the tolerances, since it does not import the validator."""
    for name, value in asdict(Tolerances()).items():
        assert getattr(VerifySettings(), name) == value


def test_files_that_are_none(tmp_path: FilePath) -> None:
    file = tmp_path / "c.json"
    for text, wanted in (
        ("{}", "is not a certificate"),
        ("[1]", "is not a certificate"),
        ('{"is": "robotdiffuse certificate", "version": 9}', "version 9"),
        ('{"is": "robotdiffuse certificate", "version": 1}', "is damaged: KeyError"),
    ):
        file.write_text(text)
        refuses(wanted, rd.load_certificate, file)


def test_a_cloud_on_a_base_is_the_one_that_was_certified() -> None:
    """Regression: the stored cloud was rounded in the world's frame, so that it "has changed"."""
    robot, points = rd.load_robot("panda"), np.random.default_rng(0).uniform([1.2, -1, 0], [1.8, 1, 1], (3000, 3))
    base = rd.pose([0.1, 0.2, 0.7], rpy=[0, 0, 0.3])
    problem = rd.Problem.in_world(base, robot, rd.Scene([rd.PointCloud(points, 0.01)]), "ready", "ready")
    assert rd.certify(problem, rd.Path(robot.joint_names, problem.start[None])).check().valid
