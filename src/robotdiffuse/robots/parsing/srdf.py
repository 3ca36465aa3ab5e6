"""Reads SRDF files, which MoveIt's Setup Assistant writes for a URDF.

Format: https://docs.ros.org/en/noetic/api/srdfdom/html/ and MoveIt's "URDF and SRDF" page.
"""

import math
import xml.etree.ElementTree as ET
from dataclasses import dataclass, field
from pathlib import Path

from robotdiffuse.core.bounds import MAX_COORDINATE
from robotdiffuse.core.errors import InputError, shown, unknown_name
from robotdiffuse.core.input_files import is_file, parse_xml, read_bytes
from robotdiffuse.robots.joints import MOVING_KINDS, Joint

SRDF_FOLDERS = (".", "../srdf", "../config", "srdf", "config")
"""Folders that are searched for the SRDF of a URDF, relative to the URDF's folder."""
REST_POSES = (
    "home",
    "default",
    "ready",
    "rest",
    "neutral",
    "zero",
    "init",
    "tuck",
    "tucked",
    "open",
    "opened",
)
"""Names of poses in which joints outside the planned group are held, in order of preference."""


@dataclass(frozen=True)
class Srdf:
    """Content of an SRDF file. Names are not checked against the URDF."""

    path: Path
    allowed: dict[frozenset[str], str] = field(default_factory=dict)
    """Pairs of links that are not checked, with the reason: Adjacent, Never, Default, Always, User ..."""
    groups: dict[str, "Group"] = field(default_factory=dict)
    poses: dict[str, dict[str, float]] = field(default_factory=dict)
    """Named poses: values by joint [rad] or [m]. States of several groups with the same name are merged."""
    passive: frozenset[str] = frozenset()
    """Joints without an actuator."""

    def joints(self, group: str, joints: tuple[Joint, ...]) -> list[Joint]:
        """The movable joints of a group and of its subgroups, parents before children.

        Raises InputError for an unknown group, joint or link.
        """
        named = self._named(group, {joint.child: joint for joint in joints}, ())
        return [joint for joint in joints if joint.name in named and joint.kind in MOVING_KINDS]

    def tips(self, group: str) -> list[str]:
        """Tip links of the chains that define a group and its subgroups; the group must exist."""
        content = self.groups[group]
        return [tip for _, tip in content.chains] + [tip for sub in content.groups for tip in self.tips(sub)]

    def _named(self, group: str, above: dict[str, Joint], within: tuple[str, ...]) -> set[str]:
        if group not in self.groups or group in within:
            raise unknown_name(f"group in {self.path}", group, self.groups)
        content = self.groups[group]
        known = {joint.name for joint in above.values()}
        for name in content.joints:
            if name not in known:
                raise unknown_name(f"joint of group {group} in {self.path}", name, known)
        found = set(content.joints)
        found |= {above[link].name for link in content.links if link in above}
        for base, tip in content.chains:
            link = tip
            while link != base:
                if link not in above:
                    raise InputError(f"{self.path}: group {group}: no joints lead from {base} to {tip}")
                found.add(above[link].name)
                link = above[link].parent
        return found.union(*(self._named(name, above, (*within, group)) for name in content.groups))

    def resting(self) -> dict[str, float]:
        """Values of joints in the poses named in `REST_POSES` [rad] or [m], the first pose that has the
        joint."""
        values: dict[str, float] = {}
        for name in REST_POSES:
            values = self.poses.get(name, {}) | values
        return values


@dataclass(frozen=True)
class Group:
    """A group as defined in the file, by any combination of the fields."""

    joints: tuple[str, ...] = ()
    links: tuple[str, ...] = ()
    """Links, each of which stands for its parent joint."""
    chains: tuple[tuple[str, str], ...] = ()
    """Base and tip link of each chain."""
    groups: tuple[str, ...] = ()


def srdf_beside(urdf: str | Path, robot: str) -> Path | None:
    """The SRDF with the name of the URDF or of its robot, in the URDF's folder or in `SRDF_FOLDERS`; None if
    none."""
    urdf = Path(urdf)
    names = dict.fromkeys((urdf.name.split(".")[0], robot))
    found = (urdf.parent / folder / f"{name}.srdf" for name in names for folder in SRDF_FOLDERS)
    return next((file for file in found if is_file(file)), None)


def read_srdf(file: str | Path) -> Srdf:
    """Read an SRDF file; raises InputError that names the file if it is unreadable or incomplete."""
    path = Path(file)
    root = parse_xml(read_bytes(path, "SRDF"), str(path))
    if root.tag != "robot":
        raise InputError(f"{path} is not an SRDF: its root element is <{root.tag}>, not <robot>")

    def text(element: ET.Element, what: str) -> str:
        value = element.get(what)
        if not value:
            raise InputError(f"{path}: a <{element.tag}> has no {what}")
        return value

    def number(element: ET.Element) -> float:
        try:
            value = float(text(element, "value").split()[0])
        except ValueError:
            value = math.nan
        if not abs(value) <= MAX_COORDINATE:
            raise InputError(
                f"{path}: joint {element.get('name')}: value is {shown(element.get('value'))}; "
                f"it must be a number within ±{MAX_COORDINATE:g}"
            )
        return value

    poses: dict[str, dict[str, float]] = {}
    for state in root.findall("group_state"):
        values = {text(joint, "name"): number(joint) for joint in state.findall("joint")}
        poses.setdefault(text(state, "name"), {}).update(values)
    return Srdf(
        path=path,
        allowed={
            frozenset((text(pair, "link1"), text(pair, "link2"))): pair.get("reason", "")
            for pair in root.findall("disable_collisions")
        },
        groups={
            text(group, "name"): Group(
                joints=tuple(text(joint, "name") for joint in group.findall("joint")),
                links=tuple(text(link, "name") for link in group.findall("link")),
                chains=tuple(
                    (text(chain, "base_link"), text(chain, "tip_link")) for chain in group.findall("chain")
                ),
                groups=tuple(text(sub, "name") for sub in group.findall("group")),
            )
            for group in root.findall("group")
        },
        poses=poses,
        passive=frozenset(text(joint, "name") for joint in root.findall("passive_joint")),
    )
