"""Finds the files and ROS packages that a URDF refers to, and compiles xacro files."""

import os
import re
import xml.etree.ElementTree as ET
from pathlib import Path
from threading import Lock
from typing import NamedTuple
from urllib.parse import unquote

from robotdiffuse.core.errors import MAX_WORD, InputError, shortened, shown
from robotdiffuse.core.files import is_file

MAX_PACKAGES = 32
"""Largest number of attempts to compile a xacro file. Each attempt knows one more package, which was looked
up after the attempt before had failed."""
NAMESPACE_PREFIX = re.compile(rb"""</?([A-Za-z_][\w.-]*):[\w.-]+|\s([A-Za-z_][\w.-]*):[\w.-]+\s*=\s*["']""")
"""Matches the namespace prefix of an XML element or attribute."""
XACRO = Lock()
"""Lock that is held while xacro compiles a file, because xacro keeps its state in module globals."""
PACKAGE_NOT_FOUND = re.compile(r"Package not found: (\S+)")
"""Matches xacrodoc's error for an unknown package."""


class Packages(NamedTuple):
    """Finds the ROS packages of a URDF.

    The folder of a package is looked for in `folders`, then in ROS_PACKAGE_PATH and AMENT_PREFIX_PATH, then
    from the URDF's folder upwards: first folders with the package's name, then subfolders with that name.
    A file that the package's folder lacks is looked for in the URDF's folder and in all folders above it, at
    its path in the package, with and without the package's name in front.
    """

    urdf: Path
    folders: dict[str, str | Path]

    def folder(self, name: str) -> Path | None:
        """The folder of a package, from `folders`, the environment, or the folders above the URDF; None if it
        is not found."""
        if name in self.folders:
            return Path(self.folders[name])
        ros = _folders("ROS_PACKAGE_PATH")
        ament = _folders("AMENT_PREFIX_PATH")
        above = self.urdf.resolve().parents
        candidates = [
            *(root for root in ros if root.name == name),
            *(root / name for root in ros),
            *(prefix / "share" / name for prefix in ament),
            *(folder for folder in above if folder.name == name),
            *(folder / name for folder in above),
        ]
        return next((folder for folder in candidates if folder.is_dir()), None)

    def file(self, filename: str) -> Path:
        """The path of a package://, file:// or relative file name. Escapes such as %20 are understood.

        Raises InputError if there is no such file.
        """
        above = self.urdf.resolve().parents
        if filename.startswith("package://"):
            package, _, rest = filename.removeprefix("package://").partition("/")
            folder = self.folder(package)
            places = [] if folder is None else [folder]
            places += (up / below for up in above for below in (package, ""))
            where = f"the package is {folder}" if folder else f"searched from {above[0]} upwards"
            advice = (
                f" ({where}); give the package's folder: ROS_PACKAGE_PATH, or robot add --package "
                f"{package}=FOLDER"
            )
        else:
            rest = filename.removeprefix("file://")
            places = [above[0]]
            advice = "; add it, or remove its element"
        for place in places:
            for name in (rest, unquote(rest)):
                if is_file(place / name):
                    return place / name
        raise InputError(f"{self.urdf}: mesh file '{shortened(filename, MAX_WORD)}' does not exist{advice}")


def _folders(variable: str) -> list[Path]:
    return [Path(folder) for folder in os.environ.get(variable, "").split(os.pathsep) if folder]


def is_xacro(file: Path, root: ET.Element) -> bool:
    """Whether a file must be compiled by xacro: its name says so, or it has elements of xacro, or expressions
    in attributes."""
    return ".xacro" in file.name.lower() or any(
        "xacro" in element.tag.rpartition("}")[0]
        or any("${" in value or "$(" in value for value in element.attrib.values())
        for element in root.iter()
    )


def with_prefixes(text: bytes) -> bytes:
    """The XML with declarations added for undeclared namespace prefixes. Elements of simulators, such as
    <drake:member>, often use prefixes without declaring them."""
    used = {prefix for pair in NAMESPACE_PREFIX.findall(text) for prefix in pair if prefix}
    missing = sorted(name for name in used - {b"xml", b"xmlns"} if b"xmlns:" + name not in text)
    declared = b"".join(b' xmlns:%s="%s"' % (name, name) for name in missing)
    # comments before the root may contain "<robot", too
    pattern = re.compile(rb"(<!--.*?-->)|<robot", re.DOTALL)
    return pattern.sub(lambda m: m[0] if m[1] else m[0] + declared, text) if missing else text


def compiled_xacro(path: Path, packages: Packages) -> bytes:
    """The URDF that xacro compiles from a xacro file. This runs the code in its expressions. After an error
    for an unknown package, the package's folder is added to xacrodoc's look-up, and the file is compiled
    again.

    Raises InputError if the file cannot be compiled, or if xacrodoc is not installed.
    """
    try:
        import xacro
        from xacrodoc import packages as known  # on import, xacrodoc replaces xacro's package look-up
    except ImportError:
        raise InputError(
            f"{path} is a xacro file; install its compiler with pip install 'robotdiffuse[xacro]', or "
            f"compile it elsewhere: xacro {path.name} > {path.name.split('.')[0]}.urdf"
        ) from None
    with XACRO:
        known.reset()
        known.walk_up_from(path)
        known.update_package_cache(packages.folders)
        for _ in range(MAX_PACKAGES):
            try:
                xacro.init_stacks(str(path.resolve()))  # includes are relative to this file
                document = xacro.parse(None, str(path.resolve()))
                xacro.process_doc(document, mappings={})
                return document.toxml("utf-8")  # type: ignore[attr-defined]
            except Exception as error:  # xacro passes on and wraps exceptions of any kind
                why = " ".join(str(error).split())
                missing = PACKAGE_NOT_FOUND.search(why)
                if missing is None:
                    text = f"{path}: xacro cannot compile it ({why})"
                    if "Undefined substitution argument" in why:
                        urdf = f"{path.name.split('.')[0]}.urdf"
                        text += f"; compile it with its arguments: xacro {path.name} NAME:=VALUE > {urdf}"
                    raise InputError(text) from None
                name = missing[1]
                folder = packages.folder(name)
                if folder is None:
                    raise InputError(
                        f"{path}: package {shown(name)} is not found; give its folder: "
                        f"ROS_PACKAGE_PATH, or robot add --package {name}=FOLDER"
                    ) from None
                known.update_package_cache({name: folder})
    raise InputError(f"{path} refers to {MAX_PACKAGES} packages or more that had to be looked up")
