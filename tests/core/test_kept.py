"""What was found good and is to stay so: hostile files, and the same path whoever plans it."""

import ast
import json
import os
import re
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

import robotdiffuse as rd
from robotdiffuse.core.errors import InputError
from robotdiffuse.core.input_files import parse_xml, read_arrays
from robotdiffuse.problems.files import load_problem
from robotdiffuse.visualization.replay_page import write_replay

SOURCE = Path(__file__).parents[1] / "src" / "robotdiffuse"
SHELF = SOURCE / "examples" / "shelf.yaml"
LETTERS = "abcdefghij"
NESTED = "".join(f'<!ENTITY {b} "{10 * f"&{a};"}">' for a, b in pairwise(LETTERS))


@pytest.mark.parametrize(
    "text",
    [
        f'<!DOCTYPE robot [<!ENTITY a "lol">{NESTED}]><robot>&j;</robot>',
        f'<!DOCTYPE robot [<!ENTITY a "{50_000 * "x"}">]><robot>{2000 * "&a;"}</robot>',
        '<!DOCTYPE robot [<!ENTITY a SYSTEM "file:///etc/passwd">]><robot name="&a;"/>',
        '<!DOCTYPE robot [<!ENTITY a SYSTEM "file:///etc/passwd">]><robot>&a;</robot>',
    ],
    ids=["nested entities", "a long entity many times", "a file in an attribute", "a file as text"],
)
def test_xml_bombs_are_refused_in_one_line(text: str) -> None:
    with pytest.raises(InputError, match="not well-formed XML"):
        parse_xml(text.encode(), "it")


@pytest.mark.parametrize("ending", [".npy", ".npz"])
def test_arrays_of_python_objects_are_refused(ending: str, tmp_path: Path) -> None:
    file, objects = tmp_path / f"points{ending}", np.array([{"a": 1}], object)
    if ending == ".npy":
        np.save(file, objects, allow_pickle=True)
    else:
        np.savez(file, points=objects)
    with pytest.raises(InputError, match="is damaged"):
        read_arrays(file)


def test_nothing_unpickles_files() -> None:
    """Processes of one program exchange objects through the standard library; files never hold any."""
    for file in SOURCE.rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text())):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            found = {name.partition(".")[0] for name in names} & {
                "pickle",
                "dill",
                "joblib",
                "shelve",
                "marshal",
            }
            assert not found, f"{file}: {found}"
            call = isinstance(node, ast.Call) and ast.unparse(node.func)
            assert call != "torch.load", f"{file}: {call}"
            if call in ("np.load", "numpy.load"):
                allowed = [key.value for key in node.keywords if key.arg == "allow_pickle"]  # type: ignore[attr-defined]
                assert all(isinstance(one, ast.Constant) and one.value is False for one in allowed), file


def test_names_of_obstacles_stay_text_in_a_replay(tmp_path: Path) -> None:
    panda, name = rd.load_robot("panda"), "</script><script>alert(1)</script>"
    q = np.zeros((2, panda.dof))
    motion = rd.Trajectory(panda.joint_names, np.array([0.0, 1.0]), q, 0 * q, 0 * q)
    file = tmp_path / "replay.html"
    write_replay(panda, rd.Scene([rd.Sphere([1, 1, 1], 0.1, name=name)]), motion, file)
    text = file.read_text("utf-8")
    assert "<script>alert" not in text
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', text, re.S)
    assert found is not None and name in json.dumps(json.loads(found.group(1)), ensure_ascii=False)


@pytest.mark.parametrize("planner", ["rrt_connect", "aorrtc"])
def test_another_process_with_other_threads_finds_the_same_path(planner: str) -> None:
    code = (
        "import sys, robotdiffuse as rd\n"
        f"result = rd.load_planner({planner!r}).plan(rd.load_problem(sys.argv[1]), 60.0, seed=3)\n"
        "print(result.path.positions.tobytes().hex())"
    )
    threads = {"OMP_NUM_THREADS": "2", "NUMBA_NUM_THREADS": "2", "MKL_NUM_THREADS": "2"}
    there = subprocess.run(
        [sys.executable, "-c", code, str(SHELF)],
        env=os.environ | threads | {"PYTHONPATH": str(SOURCE.parent)},
        capture_output=True,
        text=True,
        check=True,
    )
    here = rd.load_planner(planner).plan(load_problem(SHELF), 60.0, seed=3)
    assert here.path is not None
    assert there.stdout.strip() == here.path.positions.tobytes().hex()
