"""Files of points in all formats that are read, written here from the descriptions of the formats."""

import io
import struct
from pathlib import Path

import numpy as np
from numpy import ndarray

PCD = (Path(__file__).parents[1] / "files" / "header.pcd").read_text()
PCD_FORMS = ["pcd ascii", "pcd binary", "pcd binary_compressed"]
FORMS = ["npy", "npz", "ply ascii", "ply binary", *PCD_FORMS, "csv", "csv with names", "xyz"]


def ply(points: ndarray, binary: bool) -> bytes:
    kind = "binary_little_endian" if binary else "ascii"
    header = f"ply\nformat {kind} 1.0\nelement vertex {len(points)}\n"
    header += "property float x\nproperty float y\nproperty float z\nend_header\n"
    return header.encode() + (points.astype("<f4").tobytes() if binary else text(points, " "))


def npy(array: ndarray) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


def pcd(points: ndarray, storage: str) -> bytes:
    header = PCD.format(n=len(points), data=storage).encode()
    if storage == "ascii":
        return header + "".join(f"7 {x!r} {y!r} {z!r} 0 0 0 0\n" for x, y, z in points.tolist()).encode()
    record = np.zeros(len(points), np.dtype([("rgb", "<u4"), ("xyz", "<f4", 3), ("_", "u1", 4)]))
    record["xyz"] = points
    if storage == "binary":
        return header + record.tobytes()
    content = b"".join(np.ascontiguousarray(column).tobytes() for column in [record["rgb"], *record["xyz"].T, record["_"]])
    packed = lzf_packed(content)
    return header + struct.pack("<II", len(packed), len(content)) + packed


def lzf_packed(content: bytes) -> bytes:
    """Data in LibLZF's format: literal bytes, and repetitions of earlier bytes, which may overlap."""
    out = bytearray()
    at = 0
    while at < len(content):
        limit = min(len(content) - at, 264)
        start = content.rfind(content[at : at + 3], max(at - 8192, 0), at + 2) if limit >= 3 else -1
        if start < 0:
            out += bytes([0, content[at]])
            at += 1
            continue
        length = 3
        while length < limit and content[start + length] == content[at + length]:
            length += 1
        away = at - start - 1
        long = [length - 9] if length >= 9 else []
        out += bytes([min(length - 2, 7) << 5 | away >> 8, *long, away & 255])
        at += length
    return bytes(out)


def text(points: ndarray, delimiter: str, header: str = "") -> bytes:
    return (header + "".join(delimiter.join(map(repr, row)) + "\n" for row in points.tolist())).encode()


def write_points(folder: Path, form: str, points: ndarray) -> Path:
    file = folder / f"cloud.{form.split()[0]}"
    match form:
        case "npy":
            np.save(file, points)
        case "npz":
            np.savez(file, points=points, colors=points)
        case "ply ascii" | "ply binary":
            file.write_bytes(ply(points, form.endswith("binary")))
        case "pcd ascii" | "pcd binary" | "pcd binary_compressed":
            file.write_bytes(pcd(points, form.split()[1]))
        case "csv":
            file.write_bytes(text(points, ","))
        case "csv with names":
            file.write_bytes(text(points[:, ::-1], ",", "z, y, x\n"))
        case "xyz":
            file.write_bytes(text(np.column_stack([points, points]), " ", "# made by hand\n"))
    return file
