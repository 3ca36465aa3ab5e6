"""Reads and writes the scenes of problem files: converts plain dictionaries to shapes, and shapes to
dictionaries."""

from collections.abc import Collection, Iterable
from contextlib import suppress
from dataclasses import MISSING, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray

from robotdiffuse.core.errors import (
    MAX_RPY,
    InputError,
    check_name,
    check_type,
    filled_text,
    located,
    shown,
    vector,
)
from robotdiffuse.core.files import JsonObject, known_ending, read_array
from robotdiffuse.core.mesh_files import read_triangles
from robotdiffuse.core.transforms import quaternion_from_rotation, rotation_from_rpy
from robotdiffuse.scenes.point_cloud import default_radius, read_points
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import (
    IDENTITY,
    Box,
    Capsule,
    Cylinder,
    HeightMap,
    Mesh,
    PointCloud,
    Shape,
    Sphere,
)

SHAPES: dict[str, type[Shape]] = {
    shape.kind: shape for shape in (Sphere, Box, Cylinder, Capsule, Mesh, PointCloud, HeightMap)
}
FILE_CONTENT = {"mesh": ("vertices", "faces"), "point_cloud": ("points",), "height_map": ("heights",)}
"""For each kind of shape that may be read from a file, the fields that the file contains."""


def check_fields(where: str, data: Any, required: Iterable[str], optional: Iterable[str] = ()) -> JsonObject:
    """The data, with a field `rpy` converted to `wxyz`.

    Raises InputError unless `data` is a mapping with all required fields and without unknown fields.
    """
    required = tuple(required)
    field_names = tuple(dict.fromkeys((*required, *optional)))
    check_type(where, data, dict, f"a mapping with the fields {', '.join(field_names)}")
    if "rpy" in data and "wxyz" in field_names:
        if "wxyz" in data:
            raise InputError(f"{where} has both wxyz and rpy; give one of them")
        rpy = vector(where, "rpy [rad]", data["rpy"], 3, MAX_RPY)
        data = {name: value for name, value in data.items() if name != "rpy"}
        data["wxyz"] = quaternion_from_rotation(rotation_from_rpy(*rpy)).tolist()
    for name in data:
        check_name(f"field of {where}:", name, field_names)
    missing = [name for name in required if name not in data]
    if missing:
        raise InputError(f"{where} has no {' and no '.join(missing)}; known fields: {', '.join(field_names)}")
    return data


def only_field(where: str, entry: object, kinds: Collection[str], what: str) -> tuple[str, Any]:
    """The name and the value of a mapping with one of the names in `kinds`. Raises InputError for anything
    else; the message says what it must be (`what`)."""
    if not isinstance(entry, dict) or len(entry) != 1:
        raise InputError(f"{where} is {shown(entry)}; it must be {what}; known: {', '.join(kinds)}")
    [(kind, value)] = entry.items()
    check_name(f"field of {where}:", kind, kinds)
    return kind, value


def read_scene(
    entries: Any, folder: Path, contacts: object = (), field: str = "scene"
) -> tuple[Scene, tuple[str, ...]]:
    """The scene that a list of shapes in a problem file describes, and notes on changes that were made to it.

    `contacts` are the scene's allowed contacts. File names are relative to `folder`. Raises InputError for
    unknown shapes and fields, values of the wrong type and files that cannot be read. The message starts with
    the place in the problem file, e.g. scene[2].
    """
    or_file = " or the name of a MoveIt scene file" if field == "scene" else ""
    check_type(field, entries, list, f"a list of shapes{or_file}")
    notes = list[str]()
    shapes = [read_shape(f"{field}[{i}]", entry, folder, notes) for i, entry in enumerate(entries)]
    scene = Scene(shapes, contacts)  # type: ignore[arg-type]
    for i, (shape, named) in enumerate(zip(shapes, scene.shapes, strict=True)):
        if shape.name not in (shape.kind, named.name):
            notes.append(
                f"{field}[{i}]: an earlier shape is named {shape.name} too; this one is {named.name}"
            )
    return scene, tuple(notes)


def read_shape(where: str, entry: object, folder: Path, notes: list[str]) -> Shape:
    """The shape of an entry such as {box: {...}}; see `read_scene`. Notes are added to `notes`."""
    kind, values = only_field(where, entry, SHAPES, "one shape, e.g. {sphere: {...}}")
    return _shape(f"{where}.{kind}", SHAPES[kind], values, folder, notes)


def required_fields(kind: Any) -> list[str]:
    """The names of the fields of a dataclass that have no default."""
    return [field.name for field in fields(kind) if field.default is field.default_factory is MISSING]


def _shape(where: str, kind: type[Shape], values: object, folder: Path, notes: list[str]) -> Shape:
    required = required_fields(kind)
    optional = [f.name for f in fields(kind) if f.name not in required]  # type: ignore[arg-type]
    content = FILE_CONTENT.get(kind.kind, ())
    if content and isinstance(values, dict) and "file" in values:
        required = ["file", *(name for name in required if name not in content)]
        optional = [name for name in optional if name != "file"]
        values = dict(check_fields(where, values, required, optional))
        file = filled_text(f"{where}.file", values["file"], "the name of a file")
        values["file"] = str(folder / file)
        with located(where):
            if kind is PointCloud and "point_radius" not in values:
                values["point_radius"] = default_radius(values["file"])
            arrays = _content(kind, values["file"], notes)
        values |= dict(zip(content, arrays, strict=True))
    else:
        values = check_fields(where, values, required, optional)
        if kind is HeightMap:
            values = {**values, "heights": _with_holes(values["heights"])}
    try:
        return kind(**values)
    except InputError as error:  # its message begins with the kind
        raise InputError(f"{where.removesuffix(kind.kind)}{error}") from None


def _with_holes(heights: Any) -> Any:
    """The heights of a file, with NaN in place of null."""
    if isinstance(heights, list):
        return [_with_holes(height) for height in heights]
    return float("nan") if heights is None else heights


def _content(kind: type[Shape], file: str, notes: list[str]) -> tuple[ndarray, ...]:
    """The arrays that a file contains, in the order of FILE_CONTENT."""
    if kind is Mesh:
        return read_triangles(file, notes=notes)
    if kind is HeightMap:
        known_ending(file, "height map", (".npy", ".npz"))
        return (read_array(file, "heights"),)
    points, new_notes = read_points(file)
    notes.extend(new_notes)
    return (points,)


def _in_file(shape: Shape) -> bool:
    """Whether the shape has a file that still holds its arrays."""
    file = getattr(shape, "file", None)
    if file is None:
        return False
    with suppress(InputError, TypeError):
        arrays = [getattr(shape, name) for name in FILE_CONTENT[shape.kind]]
        stored = _content(type(shape), file, [])
        return all(np.array_equal(*pair, equal_nan=True) for pair in zip(arrays, stored, strict=True))
    return False


def scene_entries(scene: Scene, folder: Path | None) -> list[dict[str, dict[str, object]]]:
    """The scene as entries from which `read_scene` restores it exactly. For shapes that are as in their
    files, the file name is written."""
    entries = []
    for shape in scene.shapes:
        if not _in_file(shape):
            values = plain_fields(shape, "file")
            if isinstance(shape, HeightMap):  # JSON has no NaN: holes are null
                heights = shape.heights.astype(object)
                heights[np.isnan(shape.heights)] = None
                values["heights"] = heights.tolist()
        else:
            values = plain_fields(shape, "file", *FILE_CONTENT[shape.kind])
            values = {"file": name_from(folder, Path(shape.file)), **values}  # type: ignore[attr-defined]
        if values["name"] == shape.kind:
            del values["name"]
        if values.get("wxyz") == list(IDENTITY):
            del values["wxyz"]
        entries.append({shape.kind: values})
    return entries


def plain_fields(value: Any, *left_out: str) -> JsonObject:
    """The fields of a dataclass by name, with lists in place of arrays."""
    names = [field.name for field in fields(value) if field.name not in left_out]
    content = [getattr(value, name) for name in names]
    plain = (part.tolist() if isinstance(part, ndarray) else part for part in content)
    return dict(zip(names, plain, strict=True))


def contacts_entry(scene: Scene) -> dict[str, object]:
    """The allowed contacts in the form of problem files."""
    return {name: links if isinstance(links, str) else list(links) for name, links in scene.allowed_contacts}


def name_from(folder: Path | None, file: Path) -> str:
    """The path of a file as it is written: relative to `folder` if the file is in or below it, so that the
    folder can be moved, else absolute."""
    file = file.parent.resolve() / file.name  # a link's target may have another ending
    if folder is None:
        return str(file)
    folder = folder.resolve()
    return file.relative_to(folder).as_posix() if file.is_relative_to(folder) else str(file)
