"""Contacts that the allowed collision matrix of a MoveIt scene allows."""

import shutil
from pathlib import Path
from typing import Any

import pytest
import yaml

from helpers.moveit_files import MOTION_BENCH_MAKER
from robotdiffuse import InputError, load_problem, load_robot
from robotdiffuse.core.input_files import read_yaml
from robotdiffuse.problems.moveit import matrix_contacts, read_moveit_scene

LINKS = ("hand", "finger")


def matrix(names: list[str], pairs: list[tuple[str, str]], **defaults: bool) -> dict[str, Any]:
    enabled = {frozenset(pair) for pair in pairs}
    rows = [{"enabled": [frozenset((a, b)) in enabled for b in names]} for a in names]
    return {
        "entry_names": names,
        "entry_values": rows,
        "default_entry_names": list(defaults),
        "default_entry_values": list(defaults.values()),
    }


def test_pairs_of_links_and_objects_count() -> None:
    names = ["hand", "finger", "can", "stale"]
    found = matrix_contacts(
        matrix(names, [("hand", "can"), ("hand", "finger"), ("stale", "can")]), ["can", "board"], LINKS
    )
    assert found == {"can": ("hand",)}


def test_defaults_decide_where_no_pair_does() -> None:
    data = matrix(["hand", "can"], [], can=True, board=True, finger=False)
    assert matrix_contacts(data, ["can", "board"], LINKS) == {"board": ("hand",)}
    assert matrix_contacts(matrix([], [], can=True), ["can"], LINKS) == {"can": LINKS}


def test_rows_may_be_lists_and_the_octomap_has_its_own_name() -> None:
    data = {"entry_names": ["hand", "<octomap>"], "entry_values": [[0, 1], [1, 0]]}
    assert matrix_contacts(data, ["octomap"], LINKS) == {"octomap": ("hand",)}


def test_no_matrix_allows_nothing() -> None:
    assert matrix_contacts(None, ["can"], LINKS) == {}


@pytest.mark.parametrize(
    "data",
    [
        {"entry_names": ["hand", "can"], "entry_values": [[0, 1]]},
        {"entry_names": ["hand"], "entry_values": [[0, 1]]},
        {"entry_names": "hand"},
        ["hand"],
    ],
)
def test_a_damaged_matrix_is_an_error(data: object) -> None:
    with pytest.raises(InputError, match="allowed_collision_matrix"):
        matrix_contacts(data, ["can"], LINKS)


def test_a_scene_and_a_problem_file_allow_contacts(tmp_path: Path) -> None:
    shutil.copytree(MOTION_BENCH_MAKER, tmp_path, dirs_exist_ok=True)
    file = tmp_path / "scene0001.yaml"
    data = read_yaml(file)
    names = [entry["id"] for entry in data["world"]["collision_objects"]]
    data["allowed_collision_matrix"] = matrix(["panda_hand", names[0], "gone"], [("panda_hand", names[0])])
    file.write_text(yaml.safe_dump(data))
    scene, _ = read_moveit_scene(file, load_robot("panda"))
    assert scene.allowed_contacts == ((names[0], ("panda_hand",)),)

    problem = {"robot": "panda", "scene": "scene0001.yaml", "request": "request0001.yaml"}
    (tmp_path / "problem.yaml").write_text(yaml.safe_dump(problem | {"allowed_contacts": {names[1]: "all"}}))
    loaded = load_problem(tmp_path / "problem.yaml")
    assert loaded.scene.allowed_contacts == ((names[0], ("panda_hand",)), (names[1], "all"))
