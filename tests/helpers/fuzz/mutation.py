"""Random damage of plain data and of bytes."""

import copy
import json
import re
from typing import Any

import numpy as np

NASTY: tuple[Any, ...] = (
    *(None, True, False, 0, -1, 1, 2**31, 2**63, 10**25, -0.0, 0.5, 1e-300, 1e-9, 1e4, 1e5, 1e20, 1e39),
    *(1e308, float("inf"), float("nan"), "", "x", "x" * 5000, "\0", "\ud800", "../..", "/dev/zero", "panda"),
    *("a/b.urdf", [], {}, [[]], [[1, 2, 3]], [[1, 2], [3]], {"x": 1}, [None] * 7, [0.0] * 7, [1e200] * 4),
    *([0, 0, 0, 0], {"file": "x" * 300}, {"file": "\0.stl"}, {"sphere": None}, [{"a": []}], "2001-13-45"),
    *("1_000", "0x"),
)
"""Replacements of values."""
TOKENS = (
    *(b"[", b"{", b"]" * 3, b"}", b"[" * 3000, b"{a: " * 200, b"- " * 300, b"&a ", b"*a", b"!!int foo"),
    *(b"!x ", b"9" * 5000, b"1e400", b"nan", b"-inf", b"\0", b"\xff\xfe", b"'", b'"', b":", b"\n", b"\t"),
    *(b"%", b"#", b"2001-13-45", b"<<: ", b"|", b"<a>" * 100, b"&lt;", b"<!DOCTYPE a>", b'encoding="utf-7"'),
    *(b"1e308", b"0"),
)
"""Replacements of bytes."""


def mutated(rng: np.random.Generator, value: Any) -> Any:
    """Plain data with one to three of its values, keys or rows changed."""
    value = json.loads(json.dumps(value))
    for _ in range(rng.integers(1, 4)):
        places = list(_places(value))
        if not places:
            return nasty(rng)
        owner, key = places[rng.integers(len(places))]
        action = rng.integers(9)
        if action < 3:
            owner[key] = nasty(rng)
        elif action == 3:
            del owner[key]
        elif action == 4 and isinstance(owner, dict):
            owner[str(nasty(rng))[:100]] = owner.pop(key)
        elif isinstance(owner, list):
            owner.insert(key, owner[key])
        elif isinstance(owner[key], int | float):
            by = rng.normal(scale=0.1) if rng.random() < 0.7 else rng.uniform(-30, 30)
            owner[key] *= float(10.0**by)
    return value


def _places(value: Any) -> Any:
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, inner in list(items):
        yield value, key
        yield from _places(inner)


def nasty(rng: np.random.Generator) -> Any:
    return copy.deepcopy(NASTY[rng.integers(len(NASTY))])


def damaged(rng: np.random.Generator, content: bytes) -> bytes:
    """Bytes with one to four changes: flipped, cut, doubled, or replaced by a token."""
    for _ in range(rng.integers(1, 5)):
        at = int(rng.integers(len(content) + 1))
        action = rng.integers(5)
        size = int(rng.integers(1, 30))
        token = TOKENS[rng.integers(len(TOKENS))]
        if action == 0:
            content = content[:at] + bytes(rng.integers(0, 256, size, np.uint8)) + content[at + size :]
        elif action == 1:
            content = content[:at] + token + content[at + size :]
        elif action == 2:
            content = content[:at] + token + content[at:]
        elif action == 3:
            content = content[:at] + content[at + int(rng.integers(1, 200)) :]
        else:
            content = content[:at] if rng.random() < 0.3 else content[:at] + content[at // 2 :]
    return content


def text_of(rng: np.random.Generator, data: Any, ending: str) -> bytes:
    """Plain data as JSON or YAML, its values changed, or its bytes."""
    import yaml

    by_value = rng.random() < 0.6
    data = mutated(rng, data) if by_value else data
    if ending in (".yaml", ".yml"):
        text = yaml.dump(data, Dumper=yaml.SafeDumper, default_flow_style=None, allow_unicode=False)
    else:
        text = json.dumps(data)
    content = text.encode("utf-8", "surrogatepass")
    return content if by_value else damaged(rng, content)


def numbers_changed(rng: np.random.Generator, content: bytes) -> bytes:
    """XML with bytes damaged or with attributes replaced."""
    if rng.random() < 0.4:
        return damaged(rng, content)
    values = list(re.finditer(rb'"[^"]*"', content))
    for match in [values[i] for i in rng.integers(len(values), size=rng.integers(1, 3))]:
        new = str(nasty(rng)).encode("utf-8", "surrogatepass")
        content = content.replace(match.group(), b'"' + new.replace(b'"', b"'").replace(b"<", b"") + b'"', 1)
    return content
