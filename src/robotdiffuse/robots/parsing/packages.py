"""Files that a URDF names, in packages too, and the URDF that a xacro file stands for."""

import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from robotdiffuse.core.errors import InputError, shown
from robotdiffuse.core.input_files import input_file, is_file, read_bytes

MOST_PACKAGES = 32
"""Packages of a xacro file that are looked for one after the other."""
PREFIX = re.compile(rb"""</?([A-Za-z_][\w.-]*):[\w.-]+|\s([A-Za-z_][\w.-]*):[\w.-]+\s*=\s*["']""")
"""The prefix of an element or of an attribute."""
MISSING = re.compile(r"Package not found: (\S+)")
"""What xacrodoc says of a package."""


@dataclass(frozen=True)
class Packages:
    """Where the packages that a URDF names are looked for.

    A package's folder is taken from `folders`, then from ROS_PACKAGE_PATH and AMENT_PREFIX_PATH, then it is
    any folder from the URDF's upwards that has the file, with the package's name before it or without.
    """

    urdf: Path
    folders: dict[str, str | Path]

    def folder(self, name: str) -> Path | None:
        """The folder of a package by option, environment, or its name upwards of the URDF."""
        if name in self.folders:
            return Path(self.folders[name])
        ros, ament = _folders("ROS_PACKAGE_PATH"), _folders("AMENT_PREFIX_PATH")
        start = self.urdf.resolve().parent
        candidates = [
            *(root for root in ros if root.name == name),
            *(root / name for root in ros),
            *(prefix / "share" / name for prefix in ament),
            *(folder for folder in (start, *start.parents) if folder.name == name),
            *(folder / name for folder in (start, *start.parents)),
        ]
        return next((folder for folder in candidates if folder.is_dir()), None)

    def file(self, filename: str) -> Path:
        """The file of a package://, file:// or relative name; InputError, with what helps, without."""
        start = self.urdf.resolve().parent
        if not filename.startswith("package://"):
            found = start / filename.removeprefix("file://")
            if is_file(found):
                return found
            raise InputError(
                f"{self.urdf}: mesh file {shown(filename)} is not there; put it there, or take its "
                f"element out"
            )
        package, _, rest = filename.removeprefix("package://").partition("/")
        folder = self.folder(package)
        upwards = [up / tail for up in (start, *start.parents) for tail in (f"{package}/{rest}", rest)]
        candidates = [*([] if folder is None else [folder / rest]), *upwards]
        for candidate in candidates:
            if is_file(candidate):
                return candidate
        raise InputError(
            f"{self.urdf}: mesh file {shown(filename)} is not there (looked from {start} upwards); say where "
            f"the package is: --package {package}=FOLDER, or ROS_PACKAGE_PATH"
        )


def _folders(variable: str) -> list[Path]:
    return [Path(folder) for folder in os.environ.get(variable, "").split(os.pathsep) if folder]


def urdf_text(path: Path, packages: Packages) -> bytes:
    """The URDF in a file, or the one that a xacro file stands for, compiled by xacrodoc.

    Raises InputError if it cannot be read or compiled, or for a xacro file without xacrodoc.
    """
    text = read_bytes(path, "URDF")
    if path.suffix == ".xacro" or b"<xacro:" in text:
        text = _compiled(path, packages)
    return _with_prefixes(text)


def _with_prefixes(text: bytes) -> bytes:
    """The XML with undeclared prefixes declared: simulators' elements, as <drake:member>, often lack it."""
    used = {found for pair in PREFIX.findall(text) for found in pair if found}
    missing = sorted(name for name in used - {b"xml", b"xmlns"} if b"xmlns:" + name not in text)
    declared = b"".join(b' xmlns:%s="%s"' % (name, name) for name in missing)
    return text.replace(b"<robot", b"<robot" + declared, 1) if missing else text


def _compiled(path: Path, packages: Packages) -> bytes:
    try:
        import xacro
        from xacrodoc import packages as known
    except ImportError:
        raise InputError(
            f"{path} is a xacro file; install what compiles it, pip install 'robotdiffuse[xacro]', or "
            f"compile it elsewhere: xacro {path.name} > {path.name.split('.')[0]}.urdf"
        ) from None
    for module in (xacro, known):
        module.open = _open_file  # type: ignore[attr-defined]
    try:
        return _by_xacro(xacro, known, path, packages)
    finally:
        for module in (xacro, known):
            del module.open  # type: ignore[attr-defined]


def _open_file(file: str | Path, mode: str = "r") -> IO[Any]:
    """`open` for xacro: it would wait for ever for a pipe that is included."""
    return input_file(file).open(mode)


def _by_xacro(xacro: Any, known: Any, path: Path, packages: Packages) -> bytes:
    """`known`: the packages that xacro asks for."""
    known.reset()
    known.walk_up_from(path)
    known.update_package_cache(packages.folders)
    for _ in range(MOST_PACKAGES):
        try:
            xacro.init_stacks(str(path.resolve()))  # what is included is looked for from here
            document = xacro.parse(None, str(path.resolve()))
            xacro.process_doc(document, mappings={})
            return document.toxml("utf-8")
        except Exception as error:  # xacro raises whatever it meets, and wraps what was raised within it
            why = " ".join(str(error).split())
            missing = MISSING.search(why)
            if missing is None:
                raise InputError(
                    f"{path}: xacro cannot compile it ({why}); compile it with its arguments: xacro "
                    f"{path.name} NAME:=VALUE > {path.name.split('.')[0]}.urdf"
                ) from None
            name = missing[1]
            folder = packages.folder(name)
            if folder is None:
                raise InputError(
                    f"{path}: package {shown(name)} is not found; say where it is: --package {name}=FOLDER, "
                    f"or ROS_PACKAGE_PATH"
                ) from None
            known.update_package_cache({name: folder})
    raise InputError(f"{path}: it names more than {MOST_PACKAGES} packages")
