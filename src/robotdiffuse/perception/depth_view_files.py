"""Reads and writes the depth views of problem files, and reads depth images. A view has one of these forms:

- {depth: shelf.png, scale: 0.001, intrinsics: [fx, fy, cx, cy], camera: {xyz: [...], wxyz: [...]}}
- {depth: shelf.png, intrinsics: camera.json, camera: {...}}; without the field intrinsics, they are read from
  shelf.json, shelf.yaml, shelf.txt or shelf.npy
- {cloud: shelf.ply, camera: {...}, configuration: [...]}

Further fields are configuration, pose_deviation, range and noise. They have the same meaning as in DepthView.
"""

import warnings
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.core.errors import (
    InputError,
    located,
    needs,
    numbers,
    positive,
    reading,
    shown,
    unit_quaternion,
    vector,
)
from robotdiffuse.core.files import (
    JsonObject,
    input_file,
    known_ending,
    read_array,
    read_arrays,
    read_json,
    read_yaml,
)
from robotdiffuse.core.transforms import pose_entry, rotation_from_quaternion, transform
from robotdiffuse.perception.depth_view import INTEGER_NO_RETURN, INTRINSICS, DepthNoise, DepthView, Source
from robotdiffuse.scenes.files import check_fields, name_from
from robotdiffuse.scenes.point_cloud import read_points

IMAGE_FIELDS = ("intrinsics", "scale")
INTRINSICS_FORMATS = (".json", ".yaml", ".txt", ".npy")
MAX_PIXELS = 2**24
"""Maximum number of pixels of a depth image, in all channels: a small file can unpack to a huge image."""
INTEGER_SCALE = 0.001
"""Meters per unit of integer depth images, unless a scale is given."""


def read_depth(file: str | Path, scale: float | None = None) -> Float[ndarray, "h w"]:
    """A depth image [m] from a 16 bit .png, a .npy, a .npz (its array `depth`, or its only array), or a .exr.

    scale: meters per unit; None: 0.001 for integers, 1 for floating-point numbers. Integers of 65535, and
    the largest of their type, count as 0, "no return". Raises InputError for a file that is missing, is not a
    depth image or has more than MAX_PIXELS, for a scale that is not positive, and for a .exr without the
    package OpenEXR.
    """
    file = Path(file)
    read = _READERS[known_ending(file, "depth image", _READERS)]
    input_file(file, "depth image")
    with reading(f"depth image {file}"):
        image = read(file)
    _check_size(file, image.size)
    if image.ndim == 3 and image.shape[2] == 1:
        image = image[:, :, 0]
    if image.ndim != 2 or image.dtype.kind not in "uif":
        form = " x ".join(map(str, image.shape))
        raise InputError(
            f"depth image {file} holds {image.dtype} of {form}; it must be numbers, height x width"
        )
    integers = image.dtype.kind in "ui"
    if scale is None:
        scale = INTEGER_SCALE if integers else 1.0
    no_return = (INTEGER_NO_RETURN, np.iinfo(image.dtype).max) if integers else ()
    depth = image.astype(np.float64)
    return np.where(np.isin(image, no_return), 0.0, depth * positive("view", "scale", scale))


def _read_png(file: Path) -> ndarray:
    from PIL import Image

    with warnings.catch_warnings(action="ignore"), Image.open(file) as image:  # Pillow warns of large images
        if image.mode not in ("I;16", "I;16B", "I"):
            raise InputError(
                f"depth image {file} has the mode {image.mode}; it must be grayscale with 16 bits"
            )
        _check_size(file, image.width * image.height)
        return np.asarray(image).astype(np.int64)


def _check_size(file: Path, pixels: int) -> None:
    if pixels > MAX_PIXELS:
        raise InputError(f"depth image {file} has {pixels:,} pixels; it must have at most {MAX_PIXELS:,}")


def _read_exr(file: Path) -> ndarray:
    with needs("OpenEXR", "exr"):
        import OpenEXR
    parts = [part.header for part in OpenEXR.File(str(file), header_only=True).parts]
    _check_size(file, sum(len(part["channels"]) * _area(*part["dataWindow"]) for part in parts))
    channels = OpenEXR.File(str(file)).channels()
    depths = [channels[name] for name in ("Z", "Y", "depth", "R") if name in channels]
    if not depths and len(channels) > 1:
        raise InputError(f"depth image {file} has the channels {', '.join(channels)}; one must be named Z")
    return np.asarray((depths or [*channels.values()])[0].pixels)


def _field(record: JsonObject, name: str) -> ndarray | None:
    """The numbers of a field of camera_info, a list or a mapping with the list `data`; None if there are
    none."""
    entry = record.get(name)
    return numbers(entry.get("data") if isinstance(entry, dict) else entry)


def read_intrinsics(file: Path, size: tuple[int, ...], notes: list[str]) -> Any:
    """The intrinsics of a camera, in a form that DepthView accepts. size: height and width of its image.
    Distortion is ignored, and noted in `notes`.

    A .npy or .txt file holds the camera matrix or fx, fy, cx, cy as numbers. A .json or .yaml file holds a
    camera_info of ROS, intrinsics written by librealsense or Open3D, or fx, fy, cx and cy by name. Raises
    InputError for a file that cannot be read or holds no intrinsics, for another ending, and for a file that
    states another size of the image.
    """
    ending = known_ending(file, "intrinsics", (*INTRINSICS_FORMATS, ".yml"))
    input_file(file, "file of intrinsics")
    record: Any
    if ending == ".npy":
        record = read_arrays(file)[""]
    elif ending == ".txt":
        with reading(file):
            record = np.loadtxt(file, max_rows=4)
    else:
        record = read_json(file) if ending == ".json" else read_yaml(file)
    if isinstance(record, ndarray) and record.shape in ((4,), (3, 3)):
        return record
    if isinstance(record, dict):
        stated = tuple(record.get(name, record.get(f"image_{name}")) for name in ("height", "width"))
        if all(stated) and stated != size:
            raise InputError(f"{file} is for images of {shown(stated)} pixels, h x w; this one has {size}")
        distorted = False
        for name in ("D", "d", "distortion_coefficients", "coeffs"):
            distortion = _field(record, name)
            if distortion is not None and distortion.any():
                notes.append(f"{file.name}: the distortion {name} is ignored; the image must be rectified")
                distorted = True
        for name in ("P", "p", "projection_matrix") if distorted else ():
            matrix = _field(record, name)
            if matrix is not None and matrix.size == 12 and matrix.flat[0] > 0:
                return matrix.reshape(3, 4)[:, :3]
        if record.get("depth_scale", 1) not in (1, 1000):  # these stand for millimeters in BOP and Open3D
            notes.append(
                f"{file.name}: depth_scale {shown(record['depth_scale'])} is ignored: state the meters per "
                "unit of the image as scale"
            )
        for name in ("K", "k", "cam_K", "camera_matrix", "intrinsic_matrix"):
            if name in record:
                matrix = _field(record, name)
                if matrix is None or matrix.size != 9:
                    break
                matrix = matrix.reshape(3, 3)
                return matrix.T if name == "intrinsic_matrix" else matrix  # Open3D writes columns
        values = {{"ppx": "cx", "ppy": "cy"}.get(name, name): value for name, value in record.items()}
        if {*INTRINSICS} <= {*values}:
            return {name: values[name] for name in INTRINSICS}
    raise InputError(f"{file} holds no intrinsics: neither fx, fy, cx and cy nor a camera matrix of 3 x 3")


def _area(first: ndarray, last: ndarray) -> int:
    """Pixels from the first to the last corner, both included."""
    width, height = (last.astype(np.int64) - first + 1).tolist()
    return width * height


_READERS: dict[str, Callable[[Path], ndarray]] = {
    ".png": _read_png,
    **dict.fromkeys((".npy", ".npz"), partial(read_array, name="depth")),
    ".exr": _read_exr,
}


def read_views(entries: object, folder: Path) -> tuple[tuple[DepthView, ...], tuple[str, ...]]:
    """The views of a problem file, and notes on removed points and on ignored distortion and scales.

    File names are relative to `folder`.

    Raises InputError for unknown and missing fields, values of the wrong type and files that cannot be read;
    the message starts with the place in the file, e.g. views[1].
    """
    if not isinstance(entries, list):
        raise InputError(f"views is {shown(entries)}; it must be a list of views, each with depth or cloud")
    views = list[DepthView]()
    notes = list[str]()
    for i, entry in enumerate(entries):
        with located(f"views[{i}]"):
            views.append(_view(f"views[{i}]", entry, folder, notes))
    return tuple(views), tuple(notes)


def _view(where: str, entry: object, folder: Path, notes: list[str]) -> DepthView:
    source: Source | None = None
    is_cloud = isinstance(entry, dict) and "cloud" in entry
    required = ("cloud", "camera") if is_cloud else ("depth", "camera")
    optional = ("configuration", "pose_deviation", "range", "noise", *(() if is_cloud else IMAGE_FIELDS))
    values = check_fields(where, entry, required, optional)
    optional_fields = {
        name: values[name] for name in ("range", "pose_deviation") if values.get(name) is not None
    }
    if values.get("noise") is not None:
        optional_fields["noise"] = DepthNoise.from_json(values["noise"], f"{where}.noise")
    camera = check_fields(f"{where}.camera", values["camera"], ("xyz", "wxyz"))
    rotation = rotation_from_quaternion(unit_quaternion("camera", camera["wxyz"]))
    T_base_camera = transform(vector("camera", "xyz", camera["xyz"], 3), rotation)
    configuration = values.get("configuration")
    if is_cloud:
        points = values["cloud"]
        if isinstance(points, str):
            file = str(folder / points)
            points, new_notes = read_points(file)
            notes.extend(new_notes)
            source = {"cloud": str(Path(file).absolute())}
        view = DepthView.from_cloud(points, T_base_camera, configuration, source)
        return replace(view, **optional_fields)
    image = values["depth"]
    scale = values.get("scale")
    if isinstance(image, str):
        file = str(folder / image)
        image = read_depth(file, scale)
        name = Path(values["depth"])
        candidates = (name.with_suffix(suffix) for suffix in INTRINSICS_FORMATS)
        existing = (str(path) for path in candidates if path != name and (folder / path).is_file())
        values = {"intrinsics": next(existing, None), **values}
        source = {"depth": str(Path(file).absolute())} | ({} if scale is None else {"scale": scale})
    elif scale is not None:
        raise InputError(
            "view.scale cannot be combined with an image in the problem file, which is in meters"
        )
    intrinsics = values.get("intrinsics")
    if intrinsics is None:
        files = ", ".join(INTRINSICS_FORMATS)
        raise InputError(f"{where} has no intrinsics, nor a file of them with the image's name ({files})")
    if isinstance(intrinsics, str):
        intrinsics = read_intrinsics(folder / intrinsics, getattr(numbers(image), "shape", ()), notes)
    return DepthView(image, intrinsics, T_base_camera, configuration, source=source, **optional_fields)


def _is_that_of_file(view: DepthView) -> bool:
    """Whether a view's image or cloud is still that of its file; `dataclasses.replace` keeps the source."""
    source: Any = view.source
    with suppress(InputError, KeyError):
        if view.cloud is not None:
            return np.array_equal(read_points(source["cloud"])[0], view.cloud)
        image = read_depth(source["depth"], source.get("scale"))
        return np.array_equal(replace(view, depth=image).depth, view.depth, equal_nan=True)
    return False


def view_entry(view: DepthView, folder: Path | None) -> JsonObject:
    """The entry of a view, in the form that `read_views` reads. Data that were read from a file are written
    as the file's name, relative to the folder."""
    entry: JsonObject = {}
    if view.source is not None and _is_that_of_file(view):
        entry |= {
            name: name_from(folder, Path(value)) if isinstance(value, str) else value
            for name, value in view.source.items()
        }
    elif view.cloud is not None:
        entry["cloud"] = view.cloud.tolist()
    else:
        # JSON has no NaN or infinity: missing returns become 0, and infinite depths 1e9
        entry["depth"] = np.nan_to_num(view.depth, nan=0.0, posinf=1e9, neginf=0.0).tolist()
    if view.cloud is None:
        entry["intrinsics"] = list(view.intrinsics)
    entry["camera"] = pose_entry(view.T_base_camera)
    if view.configuration is not None:
        entry["configuration"] = view.configuration.tolist()
    if any(view.pose_deviation):
        entry["pose_deviation"] = list(view.pose_deviation)
    if view.range is not None:
        entry["range"] = view.range
    if view.noise is not None:
        entry["noise"] = view.noise.to_json()
    return entry
