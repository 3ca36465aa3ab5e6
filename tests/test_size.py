"""The code of each package has at most as many tokens as CONTRIBUTING.md allows; tokens ignore layout."""

import ast
import io
import re
import tokenize
from collections import defaultdict
from pathlib import Path

import robotdiffuse

ROOT = Path(__file__).parents[1]
SOURCE = Path(robotdiffuse.__file__).parent
SLACK = 1.02
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


def test_what_counts() -> None:
    text = '"""Doc."""\nx = f(\n    1,  # one\n    2,\n)\n"""About x."""\n'
    assert token_count(text) == len(["x", "=", "f", "1", "2"])


def test_no_package_grows_beyond_its_row() -> None:
    """A package that needs more tokens raises its number in the table and gives the reason; one that shrank lowers it."""
    rows = re.findall(r"^\| `([\w.]+)` \| ([\d,]+) \|", (ROOT / "CONTRIBUTING.md").read_text(), re.MULTILINE)
    allowed = {name: int(tokens.replace(",", "")) for name, tokens in rows}
    tokens: dict[str, int] = defaultdict(int)
    for file in SOURCE.rglob("*.py"):
        parts = file.relative_to(SOURCE).parts
        tokens[parts[0] if len(parts) > 1 else "."] += token_count(file.read_text())
    assert tokens.keys() == allowed.keys()
    larger = {name: count for name, count in tokens.items() if count > SLACK * allowed[name]}
    assert not larger, f"shorten {larger} or raise their rows of CONTRIBUTING.md, with the reason"
