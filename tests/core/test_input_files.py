"""Readers of untrusted files, including meshes, return a value or raise a one-line error, for any content."""

import ast
import copy
import json
import os
import re
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any, ClassVar

import coal
import numpy as np
import pytest
import trimesh
import yaml
from hypothesis import given, strategies as st
from numpy import ndarray
from trimesh.exchange.gltf import export_gltf
from trimesh.exchange.obj import export_obj
from trimesh.exchange.ply import export_ply

from helpers.refusals import refuses
from robotdiffuse import Box, InputError, Scene
from robotdiffuse.core import files
from robotdiffuse.core.errors import MAX_WORD, OutputError, distinct, joined, located, shown, unknown_name
from robotdiffuse.core.mesh_files import read_triangles
from robotdiffuse.core.types import check_motion_arrays
from robotdiffuse.scenes.scene import MAX_CONTACT_LINKS

SOURCE = Path(__file__).parents[2] / "src" / "robotdiffuse"
DEEP = 100_000
NESTED = "".join(f'<!ENTITY {b} "{10 * f"&{a};"}">' for a, b in pairwise("abcdefghij"))
BOMB = "a: &a [1, 1, 1, 1, 1, 1, 1, 1, 1]\n" + "".join(
    f"{b}: &{b} [{', '.join([f'*{a}'] * 9)}]\n" for a, b in zip("abcdefgh", "bcdefghi", strict=True)
)
SOLID = trimesh.creation.box((1.0, 1.0, 1.0))
NAMED = {
    "gltf": {name: bytes(part) for name, part in export_gltf(trimesh.Scene([SOLID])).items()},
    "obj": {"model.obj": b"mtllib beside.bin\nusemtl x\n" + export_obj(SOLID).encode()},
    "ply": {"model.ply": export_ply(SOLID).replace(b"format", b"comment TextureFile beside.bin\nformat", 1)},
}
"""Mesh files that name another, which glTF cannot do without."""


def one_line(call: Callable[[], object]) -> str:
    message = refuses(".", call)
    assert message.isprintable() and len(message) < 500
    return message


MALFORMED: dict[Callable[[Any, str], object], tuple[tuple[str | bytes, str], ...]] = {
    files.parse_json: (
        ("[" * DEEP, "more than 64 levels deep"),
        ('"' + "[" * DEEP, "is not valid JSON"),
        ("9" * 5000, "integer 9999"),
        ("[1, 2", "line 1, column 6"),
        ('{"a": {"b": 1, "b": 2}}', "b appears twice"),
    ),
    files.parse_yaml: (
        ("[" * DEEP, "more than 64 levels deep"),
        ("- " * DEEP, "more than 64 levels deep"),
        ("? " * DEEP, "a key is not a plain string"),
        (BOMB, "stands for more than 2,000,000 values in line 7"),
        ("a: &a [*a]", "alias 'a' has no anchor before it in line 1"),
        ("a: !!int foo", "tag 'tag:yaml.org,2002:int' is not supported"),
        ("a: !!python/object/apply:os.system [ls]", "is not supported in line 1"),
        ("? [1, 2]\n: 3", "a key is not a plain string in line 1"),
        ("9" * 5000, "integer 9999"),
        ("a: 1\n---\nb: 2", "more than one document"),
        ("a: 0x_", "'0x_' is not a number in line 1"),
        ("\0", "is not valid YAML"),
        ("\ud800", "surrogate"),
    ),
    files.parse_xml: (
        (b"<a>" * DEEP + b"</a>" * DEEP, "more than 64 levels deep"),
        (b'<?xml version="1.0" encoding="klingon"?><robot/>', "unknown encoding"),
        (b"", "no element found"),
        (f'<!DOCTYPE r [<!ENTITY a "lol">{NESTED}]><r>&j;</r>'.encode(), "not well-formed XML"),
        (f'<!DOCTYPE r [<!ENTITY a "{50_000 * "x"}">]><r>{2000 * "&a;"}</r>'.encode(), "not well-formed XML"),
        (b'<!DOCTYPE r [<!ENTITY a SYSTEM "file:///etc/passwd">]><r n="&a;"/>', "not well-formed XML"),
        (b'<!DOCTYPE r [<!ENTITY a SYSTEM "file:///etc/passwd">]><r>&a;</r>', "not well-formed XML"),
    ),
}


@pytest.mark.parametrize("parse", MALFORMED, ids=lambda parse: parse.__name__)
def test_text_that_is_malformed_nested_too_deep_or_a_bomb(parse: Callable[[Any, str], object]) -> None:
    for text, message in MALFORMED[parse]:
        assert message in one_line(lambda text=text: parse(text, "it"))


def test_comments_of_xml_as_mujoco_and_ros_read_them() -> None:
    """Regression: rulers of "-" in comments were refused, and comments or blank lines before the declaration."""
    text = b"\n<!-- ---- arm ---- -->\n<?xml version='1.0'?>\n<a><!-- <b> --><c/><!----><d/></a><!-- x"
    assert [child.tag for child in files.parse_xml(text, "it")] == ["c", "d"]


def test_brackets_in_texts_are_no_nesting() -> None:
    value = ["[" * 500, '\\"{' * 500, {"a": [[1]]}]
    assert files.parse_json(json.dumps(value), "it") == value


def test_what_yaml_means() -> None:
    text = "{a: 1e-3, b: [0x10, -2, yes, ~, 1:30, 2001-13-45], c: &x {d: .inf}, e: *x, f: '1', g: 1.5e3}"
    meant = {"a": 0.001, "b": [16, -2, True, None, 90, "2001-13-45"], "f": "1", "g": 1500.0}
    assert files.parse_yaml(text, "it") == meant | {"c": {"d": np.inf}, "e": {"d": np.inf}}
    assert files.parse_yaml("", "it") is None
    assert files.parse_yaml("{1: a, on: b, ~: c}", "it") == {"1": "a", "on": "b", "~": "c"}


values = st.recursive(
    st.none() | st.booleans() | st.integers(-(10**20), 10**20) | st.floats(allow_nan=False) | st.text(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
)


@given(values)
def test_what_is_written_is_read_back(value: object) -> None:
    assert files.parse_json(json.dumps(value), "it") == value
    assert files.parse_yaml(yaml.dump(value, Dumper=yaml.CSafeDumper), "it") == value


@given(st.binary(max_size=200))
def test_any_bytes_are_a_value_or_one_line(content: bytes) -> None:
    text = content.decode("latin-1")
    for parse in MALFORMED:
        try:
            parse(text.encode() if parse is files.parse_xml else text, "it")
        except InputError as error:
            assert "\n" not in str(error)


def test_files_that_are_none(tmp_path: Path) -> None:
    pipe, link, large, closed = (tmp_path / name for name in ("pipe", "link", "large", "closed"))
    os.mkfifo(pipe)
    link.symlink_to("/dev/zero")
    large.touch()
    os.truncate(large, 2**40)
    (tmp_path / "latin").write_bytes(b"gr\xfc\xdfe")
    for file, message in [
        (pipe, "a device or a pipe; it must be a file"),
        (link, "a device or a pipe"),
        ("/dev/zero", "a device or a pipe"),
        (tmp_path, "is a folder"),
        (large, "is too large: it has 1048576 MB"),
        (tmp_path / "none", "does not exist"),
        (tmp_path / "latin" / "below", "cannot be read: Not a directory"),
        (tmp_path / "latin", "is not UTF-8 text: byte 2"),
        ("a\0b", "not a valid file name"),
        ("\ud800", "not a valid file name"),
        ("x" * 1000, "File name too long"),
    ]:
        assert message in one_line(lambda file=file: files.read_text(file, "robot file"))
    assert not any(map(files.is_file, (pipe, link, tmp_path, "a\0b", "\ud800", "x" * 1000)))
    with pytest.MonkeyPatch.context() as patch:
        closed.touch()
        patch.setattr(os, "access", lambda *_: False)  # root may read everything
        assert "permission denied" in one_line(lambda: files.input_file(closed))
    long = tmp_path / ("y" * 200)
    assert str(long) in one_line(lambda: files.input_file(long)) or len(str(long)) > MAX_WORD


def test_a_broken_mesh_and_one_that_asks_for_memory_are_one_line(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    accessor = {"componentType": 5126, "count": 10**9, "type": "VEC3"}
    refused = {"a.stl": b"solid", "b.obj": b"f 1 2 3", "c.ply": b"ply\nformat", "d.glb": b"x"}
    refused |= {"empty.stl": b"", "points.obj": b"v 0 0 0\n", "a.txt": b""}
    refused["pointer.stl"] = b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 1\n"
    refused["large.gltf"] = json.dumps({"asset": {"version": "2.0"}, "accessors": [accessor]}).encode()
    messages = {"a.txt": "mesh format", "pointer.stl": "git lfs pull", "large.gltf": "20,000,000 elements"}
    for name, content in refused.items():
        (tmp_path / name).write_bytes(content)
        assert messages.get(name, "mesh file") in one_line(lambda name=name: read_triangles(tmp_path / name)), name
    assert capfd.readouterr().err == ""


def test_messages_quote_sixty_characters() -> None:
    for value in ("x" * 10**6, [1] * 10**6, 10**5000, np.zeros(10**6), "\x1b[31m\n\ud800", {"a": "b" * 100}):
        assert len(shown(value)) <= 60 and shown(value).isprintable()
    assert shown([np.float64(0.5), (np.int32(-2), np.float32(np.inf))]) == "[0.5, (-2, inf)]"
    inside: list[object] = []
    for _ in range(10**5):
        inside = [inside]
    assert shown(inside) == "a very long list"
    assert "and 9900 more" in str(unknown_name("joint", "j" * 10**4, [f"joint_{i}" for i in range(10**4)]))
    spaced = "{a: " * 1000  # no word of it is long
    assert joined([spaced, "b"]) == f"{spaced[:57]}..., b"
    assert len(str(InputError("x" * 10**4))) == 60


@pytest.mark.parametrize("kind", sorted(NAMED))
def test_a_pipe_that_a_mesh_file_names_is_not_waited_for(kind: str, tmp_path: Path) -> None:
    """Regression: reading a .gltf file whose buffer is a named pipe never ended."""
    for name, content in NAMED[kind].items():
        (tmp_path / name).write_bytes(content)
    assert len(read_triangles(tmp_path / f"model.{kind}")[1]) == 12
    for file in [*tmp_path.glob("*.bin"), tmp_path / "beside.bin"]:
        file.unlink(missing_ok=True)
        os.mkfifo(file)
    if kind == "gltf":
        assert "it is a device or a pipe" in one_line(lambda: read_triangles(tmp_path / "model.gltf"))
    else:
        assert len(read_triangles(tmp_path / f"model.{kind}")[1]) == 12


def test_arrays_of_python_objects_are_refused(tmp_path: Path) -> None:
    for name, save in (("points.npy", np.save), ("points.npz", np.savez)):
        save(tmp_path / name, np.array([{"a": 1}], object))
        refuses("is damaged", files.read_arrays, tmp_path / name)
    # an archive called .npy was returned unread and open
    np.savez(tmp_path / "points.npz", points=np.zeros(3))
    refuses("is damaged", files.read_arrays, (tmp_path / "points.npz").rename(tmp_path / "points.npy"))


def test_errors_keep_their_kind_and_their_lines_where_they_are_copied_or_located() -> None:
    """Regression: the lines of a list in an error were joined into one."""
    error = InputError("it is wrong:", ["a b", "c"])
    assert str(copy.copy(error)) == str(error) == "it is wrong:\n  a b\n  c"
    with pytest.raises(OutputError) as caught, located("a.json"):
        raise OutputError("is full", ["first", "second"])
    assert str(caught.value) == "a.json: is full\n  first\n  second"


def test_nothing_unpickles_files() -> None:
    """Files never contain pickled objects; only worker processes exchange them, through the standard library."""
    assert list(SOURCE.rglob("*.py"))
    for file in SOURCE.rglob("*.py"):
        text = file.read_text()
        if file.parent.name == "processes" or not re.search(r"\b(pickle|dill|joblib|shelve|marshal|load)\b", text):
            continue
        for node in ast.walk(ast.parse(text)):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            found = {"pickle", "dill", "joblib", "shelve", "marshal"}.intersection(name.partition(".")[0] for name in names)
            assert not found, f"{file}: {found}"
            call = isinstance(node, ast.Call) and ast.unparse(node.func)
            assert call != "torch.load", f"{file}: {call}"
            if call in ("np.load", "numpy.load"):
                allowed = [key.value for key in node.keywords if key.arg == "allow_pickle"]  # type: ignore[attr-defined]
                assert all(isinstance(one, ast.Constant) and one.value is False for one in allowed), file


@given(st.lists(st.floats(allow_nan=False), min_size=1, max_size=3), st.integers(2, 6))
def test_different_numbers_are_told_apart_by_few_digits(values: list[float], digits: int) -> None:
    assert len(set(distinct(*values, digits=digits))) >= len(set(values))
    assert (distinct(3.14, 9.0), distinct(3.1400001049, 3.14)) == (["3.14", "9"], ["3.1400001", "3.14"])


class Name(str):
    """A text that counts how often it is compared."""

    compared: ClassVar[int] = 0

    def __eq__(self, other: object) -> bool:
        Name.compared += 1
        return str.__eq__(self, str(other))

    __hash__ = str.__hash__


def test_names_are_compared_a_few_times_each(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Name, "compared", 0)
    count = 2000
    names = [Name(f"j{i}") for i in range(count)]
    refuses("joint_names has j7 more than once", check_motion_arrays, [*names, Name("j7")], {"positions": [[0.0]]})
    few = names[:MAX_CONTACT_LINKS]
    scene = Scene([Box([1, 0, 0], [0.1, 0.1, 0.1])], [("box", [name]) for name in few])
    assert Name.compared < 5 * count
    assert scene.allowed_contacts == (("box", tuple(few)),)
    refuses(f"'box' has over {MAX_CONTACT_LINKS} links; write 'all'", Scene, scene.shapes, [("box", names)])


TRIANGLES = '<triangles count="1"{}><input semantic="VERTEX" source="#v" offset="0"/><p>0 1 2</p></triangles>'
USE = '<node><instance_geometry url="#g"/></node>'


def collada(
    folder: Path, unit: str = "1", up: str = "Z_UP", mesh: str = TRIANGLES.format(""), more: str = "", scene: str = USE
) -> Path:
    """A triangle with the corners (1, 0, 0), (0, 2, 0) and (0, 0, 3) in a Collada file."""
    (folder / "part.dae").write_text(
        f"""<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
        <asset><unit meter="{unit}"/><up_axis>{up}</up_axis></asset>
        <library_geometries><geometry id="g"><mesh>
        <source id="p"><float_array id="a" count="9">1 0 0 0 2 0 0 0 3</float_array>
        <technique_common><accessor source="#a" count="3" stride="3"><param name="X" type="float"/>
        <param name="Y" type="float"/><param name="Z" type="float"/></accessor></technique_common></source>
        <vertices id="v"><input semantic="POSITION" source="#p"/></vertices>{mesh}</mesh></geometry>
        </library_geometries>{more}<library_visual_scenes><visual_scene id="s">{scene}</visual_scene>
        </library_visual_scenes><scene><instance_visual_scene url="#s"/></scene></COLLADA>"""
    )
    return folder / "part.dae"


def corners(file: Path, notes: list[str] | None = None, turn: bool = True) -> ndarray:
    """The corners by their distance from the origin."""
    vertices, _ = read_triangles(file, notes=notes, turn=turn)
    return vertices[np.argsort(np.linalg.norm(vertices, axis=1))]


def test_collada_is_read_in_meters(tmp_path: Path) -> None:
    """Regression: 100 mm were read as 100 m."""
    notes: list[str] = []
    np.testing.assert_allclose(corners(collada(tmp_path, "0.001"), notes), 1e-3 * np.diag([1, 2, 3]))
    assert notes == ["part.dae is in units of 0.001 m; it is read in meters"]
    refuses("its unit is '0' m", read_triangles, collada(tmp_path, "0"))


Y_UP = [[1, 0, 0], [0, 0, 2], [0, -3, 0]]
TURNED = {"Z_UP": [[1, 0, 0], [0, 2, 0], [0, 0, 3]], "Y_UP": Y_UP, "X_UP": [[0, 0, 1], [-2, 0, 0], [0, -3, 0]], "glTF": Y_UP}


@pytest.mark.parametrize(("up", "expected"), TURNED.items())
def test_the_up_axis_becomes_z_but_not_of_links(up: str, expected: list[list[int]], tmp_path: Path) -> None:
    """Regressions: a wall in glTF lay flat; links of PR2, TIAGo and Kinova's Jaco were turned, unlike in Coal and RViz."""
    trimesh.Trimesh(np.diag([1, 2, 3]), [[0, 1, 2]]).export(tmp_path / "part.glb")
    file = tmp_path / "part.glb" if up == "glTF" else collada(tmp_path, up=up)
    notes: list[str] = []
    np.testing.assert_allclose(corners(file, notes), expected, atol=1e-12)
    assert len(notes) == (up != "Z_UP")
    link = coal.MeshLoader().load(str(file), np.ones(3))  # type: ignore[attr-defined]
    np.testing.assert_allclose(corners(file, turn=False), link.vertices(), atol=1e-12)


def test_a_missing_material_loses_no_geometry(tmp_path: Path) -> None:
    bound = '<bind_material><technique_common><instance_material symbol="m" target="#no"/></technique_common>'
    scene = USE + f'<node><instance_geometry url="#g">{bound}</bind_material></instance_geometry></node>'
    _, faces = read_triangles(collada(tmp_path, mesh=TRIANGLES.format(' material="m"'), scene=scene))
    assert len(faces) == 2


def test_small_collada_files_cannot_fill_the_memory(tmp_path: Path) -> None:
    """Regression: 6 kB that use a triangle 2^40 times took over a minute; a polygon of a billion corners took 8 GB."""
    twice = '<node id="n{0}"><instance_node url="#n{1}"/><instance_node url="#n{1}"/></node>'
    nodes = "".join(twice.format(i, i + 1) for i in range(40)) + '<node id="n40"><instance_geometry url="#g"/></node>'
    scene = '<node><instance_node url="#n0"/></node>'
    refuses("too often", read_triangles, collada(tmp_path, more=f"<library_nodes>{nodes}</library_nodes>", scene=scene))
    itself = '<library_nodes><node id="n0"><instance_node url="#n0"/></node></library_nodes>'
    refuses("contains itself", read_triangles, collada(tmp_path, more=itself, scene=scene))
    polygon = TRIANGLES.format("").replace("triangles", "polylist").replace("<p>", "<vcount>1000000000</vcount><p>")
    refuses("more corners than the file has bytes", read_triangles, collada(tmp_path, mesh=polygon))
