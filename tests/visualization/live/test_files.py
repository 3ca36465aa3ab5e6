"""The first problem of the page, uploads, and saved files."""

import json

import pytest

from helpers.refusals import refuses
from robotdiffuse import load_robot
from robotdiffuse.problems.files import problem_record
from robotdiffuse.visualization.live.session import first_problem, problem_for, problem_text, uploaded_problem

DEMO = first_problem(None, None)


def test_problems_go_out_and_come_back() -> None:
    for text, name in ((problem_text(DEMO), "p.yaml"), (json.dumps(problem_record(DEMO)).encode(), "p.json")):
        assert problem_record(uploaded_problem(text, name, DEMO.robot)) == problem_record(DEMO), name


@pytest.mark.parametrize("name", ["panda", "so101", "ur10"])
def test_every_arm_has_a_first_problem(name: str) -> None:
    assert problem_for(load_robot(name)).robot.name == name


GOOD = """robot: panda
scene: []
start: [0, 0, 0, -1.5, 0, 1.5, 0]
goal: {joints: [1, 0, 0, -1.5, 0, 1.5, 0]}
"""


@pytest.mark.parametrize(
    ("text", "wrong"),
    [
        (GOOD.replace("panda", "pandora"), "unknown robot 'pandora'; known: "),
        (GOOD.replace("panda", "/etc/robot.urdf"), "unknown robot '/etc/robot.urdf'; known: "),
        (GOOD.replace("panda", "[panda]"), r"unknown robot \['panda'\]; known: "),
        (GOOD.replace("[]", "secret.yaml"), "secret.yaml is a file, and files are not read here"),
        (GOOD.replace("[]", "[{mesh: {file: /etc/passwd}}]"), "/etc/passwd is a file, and files are not"),
        (
            GOOD + "views: [{cloud: x.ply, camera: {xyz: [1, 0, 1], wxyz: [0, 1, 0, 0]}}]\n",
            "x.ply is a file, and files are not read here",
        ),
        (GOOD + "attached: [{link: panda_hand, mesh: {file: x.stl}}]\n", "x.stl is a file, and files are not read here"),
        (GOOD.replace("-1.5", "9"), "start: panda_joint4 is 9 rad; its limits are"),
        ("robot: panda\nscene: []\nrequest: x.yaml\n", "x.yaml is a file, and files are not read here"),
        (GOOD.replace("start", "begin"), "unknown field of problem: 'begin'"),
        ("[1, 2", "p.yaml.*"),
        ("", "problem is None"),
    ],
)
def test_what_is_wrong_with_an_uploaded_problem_is_one_line(text: str, wrong: str) -> None:
    assert refuses(wrong, uploaded_problem, text.encode(), "p.yaml", DEMO.robot).startswith("p.yaml")


def test_a_problem_and_a_robot_at_once_and_uploads_that_are_no_text_or_too_long() -> None:
    refuses(r"p\.yaml is not UTF-8 text", uploaded_problem, b"\xff\xfe", "p.yaml", DEMO.robot)
    refuses("at most 5000000 are read", uploaded_problem, b" " * 5_000_001, "p.yaml", DEMO.robot)
    refuses(r"p\.yaml names its robot; give a problem or --robot ur5, not both", first_problem, "p.yaml", "ur5")
