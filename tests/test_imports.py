"""The source: directions of imports, what `import robotdiffuse` costs, public names in tests, the size of packages."""

import ast
import io
import re
import tokenize
from collections import defaultdict
from collections.abc import Iterator
from functools import cache
from graphlib import TopologicalSorter
from importlib.metadata import distributions
from pathlib import Path

from packaging.specifiers import SpecifierSet

from helpers.commands import python, write_problem

ROOT = Path(__file__).parents[1]
SOURCE = ROOT / "src" / "robotdiffuse"
MODULES = sorted(SOURCE.rglob("*.py"))
ORDER = (
    *("core", "processes", "robots", "scenes", "collision", "perception"),
    *("drawables", "problems", "trajectories", "validation"),
    *("certificates", "interop", "datasets", "learning", "planning", "baselines", "adapters"),
    *("generation", "simulation", "evaluation", "visualization", "server", "cli"),
)
"""A package imports only itself and packages before it."""
APART = {
    "certificates": {"interop"},
    "datasets": {"validation", "certificates", "interop"},
    "learning": {"validation", "certificates", "interop"},
    "planning": {"certificates", "interop"},
    "baselines": {"certificates", "interop"},
    "adapters": {"certificates", "interop", "datasets", "learning", "baselines"},
    "generation": {"certificates", "interop", "baselines", "adapters"},
    "simulation": {"certificates", "interop", "datasets", "learning", "planning", "baselines", "generation"},
    "evaluation": {"certificates", "interop"},
    "visualization": {"baselines", "generation", "simulation", "evaluation"},
    "server": {"certificates", "interop", "datasets", "learning", "baselines", "generation", "simulation"}
    | {"evaluation", "visualization"},
}
"""Packages before it that a package does without, so that it can be used, and understood, without them."""
EXTRAS = {
    "simulation": {"pybullet", "pybullet_data"},
    "baselines": {"ompl"},
    "perception": {"OpenEXR"},
    "processes": {"ray"},
    "datasets": {"zarr", "torch"},
    "learning": {"torch", "onnx", "onnxscript", "accelerate"},
    "server": {"fastapi", "starlette", "uvicorn", "orjson"},
    "visualization": {"viser"},
    "evaluation": {"markdown_it", "matplotlib"},
    "interop": {"foxglove_schemas_protobuf", "mcap", "mcap_protobuf", "rerun", "rosbags", "roslibpy"},
    "robots": {"mujoco", "pinocchio"},
    "scenes": {"mujoco"},
    "no package": {"example_robot_data", "toppra"},
}
"""Distributions that the core install lacks, by the packages that may import them."""
ENTRANCES = {"__init__", "__main__"}
"""These may import everything."""


def package(file: Path) -> str:
    return file.relative_to(SOURCE).parts[0].removesuffix(".py")


@cache
def tree_of(file: Path) -> ast.Module:
    return ast.parse(file.read_text())


@cache
def imported(file: Path) -> list[str]:
    """Full names of everything that a module imports, at the top or inside functions."""
    names: list[str] = []
    for node in ast.walk(tree_of(file)):
        if isinstance(node, ast.Import):
            names += (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{file}:{node.lineno}: relative import"
            names += (f"{node.module}.{alias.name}" for alias in node.names)
    return names


def test_every_package_has_a_place_in_the_order_and_imports_point_one_way() -> None:
    assert {package(file) for file in MODULES} == {*ORDER, *ENTRANCES}
    for file in MODULES:
        here = package(file)
        for name in imported(file):
            top, _, rest = name.partition(".")
            if top in frozenset().union(*EXTRAS.values()):
                assert top in EXTRAS.get(here, ()), f"{file} must not import {top}: the core install lacks it"
            there = rest.partition(".")[0]
            if top != "robotdiffuse" or here in ENTRANCES or there == "__version__":
                continue
            before = ORDER[: ORDER.index(here) + 1]
            assert there in before and there not in APART.get(here, ()), f"{file} must not import {there}"


def test_no_module_imports_itself_through_others() -> None:
    paths = {file: ".".join(file.relative_to(SOURCE.parent).with_suffix("").parts) for file in MODULES}
    names = {path.removesuffix(".__init__"): file for file, path in paths.items()}
    del names["robotdiffuse"]  # it lists the public names of all packages
    graph = {name: {n for full in imported(file) if (n := _module(full, names))} for name, file in names.items()}
    # the table of planners names their class in types alone
    graph["robotdiffuse.planning"].discard("robotdiffuse.planning.planner")
    TopologicalSorter({name: of - {name} for name, of in graph.items()}).prepare()  # raises CycleError


def _module(full: str, names: dict[str, Path]) -> str | None:
    """The module that a full name denotes or is in."""
    while full:
        if full in names:
            return full
        full = full.rpartition(".")[0]
    return None


def defined_names(tree: ast.AST) -> Iterator[str]:
    """Names that a module defines, without those that it imports."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            yield node.name
        elif isinstance(node, ast.Name | ast.Attribute) and isinstance(node.ctx, ast.Store):
            yield node.id if isinstance(node, ast.Name) else node.attr


def used_names(tree: ast.AST) -> Iterator[str]:
    """Names that a module uses from other modules: imported names, attributes, and strings that `setattr` takes."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.Attribute) and not (isinstance(node.value, ast.Name) and node.value.id == "self"):
            yield node.attr
        if isinstance(node, ast.Call):
            texts = [arg.value for arg in node.args if isinstance(arg, ast.Constant)]
            if texts and ast.unparse(node.func).endswith(("setattr", "patch.object")):
                yield from (text.rpartition(".")[2] for text in texts if isinstance(text, str))


def test_tests_benchmarks_and_examples_use_no_private_names() -> None:
    private = {name for file in MODULES for name in defined_names(tree_of(file)) if name[0] == "_" != name[-1]}
    private -= {"_replace"}  # a public method of named tuples
    folders = (ROOT / folder for folder in ("tests", "benchmarks", "examples"))
    for file in (file for folder in folders for file in folder.rglob("*.py")):
        text = file.read_text()
        if private.isdisjoint(re.findall(r"\b_\w+", text)):
            continue
        own = ast.parse(text)
        used = private.intersection(used_names(own))
        used -= set(defined_names(own)) if used else set()
        assert not used, f"{file.relative_to(ROOT)} uses {', '.join(sorted(used))}"


def test_import_loads_nothing_heavy_and_public_names_resolve() -> None:
    heavy = ("torch", "onnxruntime", "numba", "coal", "toppra", "matplotlib")
    code = (
        f"import sys, robotdiffuse as rd, robotdiffuse.cli; print([m for m in {heavy} if m in sys.modules])\n"
        "import robotdiffuse.validation.validator\n"
        "print(callable(rd.verify), all(hasattr(rd, name) for name in dir(rd)))"
    )
    assert python(code).stdout == "[]\nTrue True\n"


def test_a_misspelled_name_is_answered_with_a_similar_one_and_commands_need_no_docstrings() -> None:
    ended = python("import robotdiffuse as rd; rd.load_problems", status=1)
    assert "no attribute 'load_problems'. Did you mean: 'load_problem'?" in ended.stderr
    # Regression: with PYTHONOPTIMIZE=2, which leaves out docstrings, every command was a KeyError
    code = "from robotdiffuse import cli; cli.main(['planner', 'info', 'aorrtc'])"
    assert "range" in python(code, PYTHONOPTIMIZE="2").stdout


def test_a_plan_by_search_loads_what_it_needs_and_no_more(tmp_path: Path) -> None:
    """Loading further modules would take longer than planning."""
    problem = write_problem(tmp_path, "problem.yaml", scene=[])
    code = (
        "import sys\nfrom robotdiffuse import cli\nfrom robotdiffuse.cli import console\nconsole.SPINNER_DELAY = 600.0\n"
        f"assert cli.main(['plan', {str(problem)!r}, '--planner', 'aorrtc', '--time-limit', '60']) == 0\n"
        "unwanted = ('torch', 'coal', 'toppra', 'trimesh', 'rich', 'scipy.linalg', 'scipy.spatial')\n"
        "own = 'planning.search.constrained', 'planning.pose_goals', 'problems.compiled_constraints'\n"
        "unwanted += tuple(f'robotdiffuse.{name}' for name in own)\n"
        "print([name for name in unwanted if name in sys.modules])"
    )
    assert python(code).stdout.splitlines()[-1] == "[]"


def test_every_pinned_version_installs_on_python_3_11_0() -> None:
    """Regression: one pin needed 3.11.5, and the first `make test` on Debian 12, which has 3.11.2, failed."""
    pins = (ROOT / "constraints.txt").read_text().lower()
    pinned = [item for item in distributions() if f"\n{item.name.lower()}=={item.version}\n" in pins]
    late = [item.name for item in pinned if "3.11.0" not in SpecifierSet(item.metadata["Requires-Python"] or "")]
    assert len(pinned) > 50 and not late


# what a compiler does not see, and brackets and commas, which follow from the layout
NOT_COUNTED = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER}


def token_count(text: str) -> int:
    """The tokens of a module without comments, docstrings, round brackets and commas."""
    texts = {
        line
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
        for line in range(node.lineno, (node.end_lineno or node.lineno) + 1)
    }
    return sum(
        token.type not in NOT_COUNTED
        and token.string not in ("", ",", "(", ")")
        and not (token.type == tokenize.STRING and token.start[0] in texts)
        for token in tokenize.generate_tokens(io.StringIO(text).readline)
    )


def test_no_package_grows_beyond_its_row() -> None:
    """A package that needs more tokens raises its number in the table and gives the reason; one that shrank lowers it."""
    text = '"""Doc."""\nx = f(\n    1,  # one\n    2,\n)\n"""About x."""\n'
    assert token_count(text) == len(["x", "=", "f", "1", "2"])
    rows = re.findall(r"^\| `([\w.]+)` \| ([\d,]+) \|", (ROOT / "CONTRIBUTING.md").read_text(), re.MULTILINE)
    allowed = {name: int(tokens.replace(",", "")) for name, tokens in rows}
    tokens: dict[str, int] = defaultdict(int)
    for file in SOURCE.rglob("*.py"):
        parts = file.relative_to(SOURCE).parts
        tokens[parts[0] if len(parts) > 1 else "."] += token_count(file.read_text())
    assert tokens.keys() == allowed.keys()
    larger = {name: count for name, count in tokens.items() if count > 1.02 * allowed[name]}
    assert not larger, f"shorten {larger} or raise their rows of CONTRIBUTING.md, with the reason"
