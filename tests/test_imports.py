"""The direction of imports, and what `import robotdiffuse` costs."""

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

SOURCE = Path(__file__).parents[1] / "src" / "robotdiffuse"
MODULES = sorted(SOURCE.rglob("*.py"))

CHAIN = (
    "compile_cache",
    "deadline",
    "errors",
    "reading",
    "checks",
    "registry",
    "settings",
    "files",
    "processes",
    "transforms",
    "types",
    "results",
    "robots",
    "scenes",
    "collision",
    "problems",
    "rates",
    "torques",
    "tolerances",
    "verify",
    "violations",
    "paths",
)
BELOW: dict[str, set[str]] = {room: set(CHAIN[: i + 1]) for i, room in enumerate(CHAIN)}
BELOW["certificates"] = {*CHAIN, "certificates"}
BELOW["handover"] = {*CHAIN, "certificates", "handover"}
BELOW["data"] = {*CHAIN[: CHAIN.index("problems") + 1], "data"}
BELOW["learning"] = {*BELOW["data"], "learning"}
BELOW["planners"] = {*CHAIN, "data", "learning", "planners"}
BELOW["simulation"] = {*CHAIN, "simulation"}
BELOW["viewer"] = {*CHAIN, "viewer"}
BELOW["serve"] = {*CHAIN, "planners", "serve"}
BELOW["live"] = {*CHAIN, "data", "learning", "planners", "viewer", "live"}
BELOW["generation"] = {*CHAIN, "data", "learning", "planners", "generation"}
BELOW["evaluation"] = {*CHAIN, "data", "learning", "planners", "simulation", "generation", "evaluation"}

EXTRAS = {
    "pybullet": {"simulation"},
    "pybullet_data": {"simulation"},
    "ompl": {"planners"},
    "OpenEXR": {"scenes"},
    "ray": {"processes"},
    "zarr": {"data"},
    "accelerate": {"learning"},
    "fastapi": {"serve"},
    "starlette": {"serve"},
    "uvicorn": {"serve"},
    "orjson": {"serve"},
    "viser": {"live"},
    "matplotlib": {"evaluation"},
    "foxglove_schemas_protobuf": {"handover"},
    "mcap": {"handover"},
    "mcap_protobuf": {"handover"},
    "rerun": {"handover"},
    "rosbags": {"handover"},
    "roslibpy": {"handover"},
    "pinocchio": {"robots"},
    "example_robot_data": set(),
}
"""Packages that the core install lacks, and the rooms that may import them."""


ENTRANCES = {"__init__", "__main__", "cli"}
"""These may import everything."""


def room(file: Path) -> str:
    first = file.relative_to(SOURCE).parts[0]
    return first.removesuffix(".py")


def imported(file: Path) -> Iterator[str]:
    """Full names of everything that a module imports, at the top or inside functions."""
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{file}:{node.lineno}: relative import"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


@pytest.mark.parametrize("file", MODULES, ids=lambda file: str(file.relative_to(SOURCE)))
def test_imports_point_one_way(file: Path) -> None:
    here = room(file)
    for name in imported(file):
        top, _, rest = name.partition(".")
        if top in EXTRAS:
            assert here in EXTRAS[top], f"{here} must not import {top}: the core install lacks it"
        there = rest.partition(".")[0]
        if top != "robotdiffuse" or here in ENTRANCES:
            continue
        assert there in BELOW[here] or there == "__version__", f"{here} must not import {there}"


def test_every_room_has_a_place_in_the_order() -> None:
    assert {room(file) for file in MODULES} <= {*BELOW, *ENTRANCES}


def run(code: str) -> str:
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_import_loads_nothing_heavy() -> None:
    code = "import sys, robotdiffuse, robotdiffuse.cli; print([m for m in {} if m in sys.modules])"
    assert run(code.format(("torch", "numba", "coal", "toppra", "matplotlib"))) == "[]"


def test_searches_the_hybrid_the_validator_the_bench_and_the_data_factory_load_no_pytorch() -> None:
    """It takes longer to load than all else that their processes need at the start."""
    code = (
        "import sys, robotdiffuse.generation.shard_maker, robotdiffuse.validation.validator\n"
        "import robotdiffuse.planning.search.rrt_connect, robotdiffuse.planning.diffusion.hybrid\n"
        "import robotdiffuse.evaluation.bench.planner_process\n"
        "print('torch' in sys.modules)"
    )
    assert run(code) == "False"


def test_a_plan_by_search_loads_what_it_needs_and_no_more(tmp_path: Path) -> None:
    """What it does not need takes longer to load than planning."""
    problem = tmp_path / "problem.yaml"
    problem.write_text(
        "robot: panda\nscene: []\nstart: [0, -0.785, 0, -2.356, 0, 1.571, 0.785]\n"
        "goal: {joints: [0.5, -0.6, 0.1, -2.2, 0, 1.6, 0.8]}\n"
    )
    code = (
        "import sys\nfrom robotdiffuse import cli\nfrom robotdiffuse.cli import console\n"
        "console.PATIENCE = 600.0\n"
        f"assert cli.main(['plan', {str(problem)!r}, '--planner', 'aorrtc', '--time-limit', '20']) == 0\n"
        "unwanted = ('torch', 'toppra', 'trimesh', 'rich', 'scipy.linalg', 'scipy.spatial')\n"
        "own = 'planners.constrained.kernel', 'planners.poses', 'problems.path_constraints'\n"
        "unwanted += tuple(f'robotdiffuse.{name}' for name in own)\n"
        "print([name for name in unwanted if name in sys.modules])"
    )
    assert run(code).splitlines()[-1] == "[]"


def test_public_names_resolve_and_verify_is_the_function() -> None:
    code = (
        "import robotdiffuse as rd, robotdiffuse.validation.validator\n"
        "print(callable(rd.verify), all(hasattr(rd, name) for name in rd.__all__))"
    )
    assert run(code) == "True True"


def test_unknown_attribute() -> None:
    import robotdiffuse

    with pytest.raises(AttributeError, match="no attribute 'planing'"):
        _ = robotdiffuse.planing  # type: ignore[attr-defined]
