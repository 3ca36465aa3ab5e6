"""Reads SRDF files, which MoveIt's Setup Assistant writes for a URDF, and chooses the planned joints of a
robot.

Format: https://docs.ros.org/en/noetic/api/srdfdom/html/ and MoveIt's "URDF and SRDF" page.
"""

import math
import re
import xml.etree.ElementTree as ET
from collections.abc import Collection
from dataclasses import dataclass, field
from os.path import commonprefix
from pathlib import Path
from typing import NamedTuple

from robotdiffuse.core.errors import MAX_COORDINATE, InputError, check_name, repeated, shown, unknown_name
from robotdiffuse.core.files import is_file, parse_xml, read_bytes
from robotdiffuse.robots.kinematic_tree import Joint, chain
from robotdiffuse.robots.robot import Robot

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
"""Joints outside the planned group are held in a pose with one of these names, in order of preference."""


@dataclass(frozen=True)
class Srdf:
    """Content of an SRDF file. Names are not checked against the URDF."""

    path: Path
    allowed: dict[frozenset[str], str] = field(default_factory=dict)
    """Pairs of links that are not checked against each other, with the reason that the SRDF gives, such as
    Adjacent or Never."""
    unchecked: frozenset[str] = frozenset()
    """Links of <disable_default_collisions>: they are only checked against the links that `enabled` names."""
    enabled: frozenset[frozenset[str]] = frozenset()
    """Pairs of links of <enable_collisions>."""
    groups: dict[str, "Group"] = field(default_factory=dict)
    poses: dict[str, dict[str, float]] = field(default_factory=dict)
    """Named poses: values by joint [rad] or [m]. States with the same name, of several groups, are merged."""
    passive: frozenset[str] = frozenset()
    """Names of joints without an actuator."""

    def allowed_among(self, links: Collection[str]) -> dict[frozenset[str], str]:
        """`allowed`, and the pairs of these links that are not checked by default."""
        pairs = {frozenset((link, other)) for link in self.unchecked.intersection(links) for other in links}
        by_default = {pair: "Default" for pair in pairs - self.enabled if len(pair) > 1}
        return by_default | self.allowed

    def joints(self, group: str, joints: tuple[Joint, ...]) -> list[Joint]:
        """The movable joints of a group and of its subgroups, parents before children.

        Raises InputError for an unknown group or joint, a group that contains itself, and a chain whose links
        no joints connect. Single links without a joint above them are ignored.
        """
        named = self._named(group, {joint.child: joint for joint in joints}, ())
        return [joint for joint in joints if joint.name in named and joint.movable]

    def tips(self, group: str) -> list[str]:
        """Tip links of the chains that define a group and its subgroups. Raises KeyError for an unknown
        group."""
        content = self.groups[group]
        return [tip for _, tip in content.chains] + [tip for sub in content.groups for tip in self.tips(sub)]

    def _named(self, group: str, above: dict[str, Joint], within: tuple[str, ...]) -> set[str]:
        if group in within:
            raise InputError(f"{self.path}: group {group} contains itself")
        check_name(f"group in {self.path}", group, self.groups)
        content = self.groups[group]
        joint_names = {joint.name for joint in above.values()}
        for name in content.joints:
            check_name(f"joint of group {group} in {self.path}", name, joint_names)
        names = set(content.joints)
        names |= {above[link].name for link in content.links if link in above}
        for base, tip in content.chains:
            link = tip
            while link != base:
                if link not in above:
                    raise InputError(
                        f"{self.path}: group {group}: no joints below the robot's base lead from link "
                        f"{base} to link {tip}"
                    )
                names.add(above[link].name)
                link = above[link].parent
        return names.union(*(self._named(name, above, (*within, group)) for name in content.groups))

    def resting(self) -> dict[str, float]:
        """Values of joints in the poses named in `REST_POSES` [rad] or [m]; for each joint from the first
        pose that has it."""
        poses = (self.poses.get(name, {}) for name in reversed(REST_POSES))
        return {joint: value for pose in poses for joint, value in pose.items()}


class Group(NamedTuple):
    """A planning group as defined in the file, by any combination of the fields."""

    joints: tuple[str, ...] = ()
    links: tuple[str, ...] = ()
    """Links; each adds its parent joint to the group."""
    chains: tuple[tuple[str, str], ...] = ()
    """Base and tip link of each chain."""
    groups: tuple[str, ...] = ()


def srdf_beside(urdf: str | Path, robot: str) -> Path | None:
    """The SRDF in `SRDF_FOLDERS` that has the name of the URDF or of its robot; None if there is none."""
    urdf = Path(urdf)
    names = dict.fromkeys((urdf.name.split(".")[0], robot))
    candidates = (urdf.parent / folder / f"{name}.srdf" for name in names for folder in SRDF_FOLDERS)
    return next((file for file in candidates if is_file(file)), None)


def read_srdf(file: str | Path) -> Srdf:
    """Read an SRDF file; raises InputError that names the file if it is unreadable or incomplete."""
    path = Path(file)
    root = parse_xml(read_bytes(path, "SRDF"), str(path))
    if root.tag != "robot" or root.find("link") is not None:
        raise InputError(f"{path} is not an SRDF: its root <{root.tag}> must be a <robot> without <link>")

    def text(element: ET.Element, what: str) -> str:
        value = element.get(what)
        if not value:
            raise InputError(f"{path}: a <{element.tag}> has no {what}")
        return value

    def names(element: ET.Element, tag: str) -> tuple[str, ...]:
        return tuple(text(child, "name") for child in element.findall(tag))

    def number(element: ET.Element) -> float:
        try:
            value = float(text(element, "value").split()[0])
        except (ValueError, IndexError):
            value = math.nan
        if not abs(value) <= MAX_COORDINATE:
            raise InputError(
                f"{path}: joint {element.get('name')}: value is {shown(element.get('value'))}; "
                f"it must be a number within ±{MAX_COORDINATE:g}"
            )
        return value

    virtual = names(root, "virtual_joint")  # they connect the root to the world
    poses = dict[str, dict[str, float]]()
    for state in root.findall("group_state"):
        values = {text(joint, "name"): number(joint) for joint in state.findall("joint")}
        poses.setdefault(text(state, "name"), {}).update(values)
    return Srdf(
        path=path,
        allowed={
            frozenset((text(pair, "link1"), text(pair, "link2"))): pair.get("reason", "")
            for pair in root.findall("disable_collisions")
        },
        unchecked=frozenset(text(link, "link") for link in root.findall("disable_default_collisions")),
        enabled=frozenset(
            frozenset((text(pair, "link1"), text(pair, "link2")))
            for pair in root.findall("enable_collisions")
        ),
        groups={
            text(group, "name"): Group(
                joints=tuple(name for name in names(group, "joint") if name not in virtual),
                links=names(group, "link"),
                chains=tuple(
                    (text(chain, "base_link"), text(chain, "tip_link")) for chain in group.findall("chain")
                ),
                groups=names(group, "group"),
            )
            for group in root.findall("group")
        },
        poses=poses,
        passive=frozenset(names(root, "passive_joint")),
    )


GRIPPER = re.compile("grip|finger|jaw|claw|knuckle|thumb", re.IGNORECASE)
"""Matches words in names of gripper joints. A joint counts as a gripper joint if few joints come after it and
its name has more of these words than the name of the joint before it, since all joints of a robot may be
called finger."""
BOTH = "both"
"""Name of the group of all arms of a robot with two arms."""
ALL = "all"
"""Name of the group of all arms, for any number of arms from two on."""
FINGER = re.compile("finger|fngr|jaw|claw|knuckle|thumb", re.IGNORECASE)
"""Matches names of fingers. If the last joint of an arm moves a link with such a name, and at least
MIN_ARM_JOINTS own joints (see `Arm.own_joints`) come before it, this joint counts as a gripper joint,
whatever the joint's name is."""
NO_TIP = re.compile("camera|optical|sensor|finger|_sc$", re.IGNORECASE)
"""Matches names of links that become the tip only if no other kind of link has the same parent: sensors,
fixed fingers, and Franka's coarse collision geometry (`fr3_link7_sc`)."""
SUFFIX_CHARACTERS = "_-/0123456789 "
"""Characters stripped from the end of the common prefix of an arm's joint names."""
MAX_FINGER_JOINTS = 2
"""Largest number of independent joints per finger of a gripper with two fingers."""
MAX_HAND_FINGER_JOINTS = 3
"""Largest number of independent joints per finger of a gripper with another number of fingers; for an
exception, see MIN_ARM_JOINTS."""
MIN_ARM_JOINTS = 4
"""Chains with fewer own joints (see `Arm.own_joints`) count as arms only if no chain has this many. Three or
more branches after at least this many own joints form a hand, with any number of joints per finger. But if
one or two of these branches have at least LIMB_JOINTS joints, these are arms on a torso, and the rest may be
a head."""
LIMB_JOINTS = 6
"""Smallest number of independent joints of arms on a torso."""


class Arm(NamedTuple):
    """A chain of movable joints and the link at its end."""

    joints: tuple[str, ...]
    tip: str
    own_joints: int
    """Number of movable joints after the last link at which the tree branches."""

    @property
    def name(self) -> str:
        """The common prefix of the names of the arm's own joints; the name of the tip if there is no common
        prefix."""
        common = commonprefix(self.joints[-self.own_joints :])  # noqa: RUF071  (characters, not folders)
        return common.rstrip(SUFFIX_CHARACTERS).removesuffix("joint").rstrip("_-/ ") or self.tip


class JointTree:
    """The movable joints below a link."""

    def __init__(self, base: str, joints: list[Joint]) -> None:
        """`joints` are all joints below the base, parents before children, as in `Robot.joints`."""
        self.base = base
        self.below = dict[str, list[Joint]]()
        self.moving = dict[str, int]()
        """Largest number of independent movable joints in a chain below each link."""
        self.roots = set[str]()
        """Links with a movable joint below them, mimic joints included."""
        self._depth = dict[str, int]()
        """Number of joints in the longest chain below each link."""
        for joint in joints:
            self.below.setdefault(joint.parent, []).append(joint)
        for joint in reversed(joints):
            self.moving[joint.parent] = max(self.moving.get(joint.parent, 0), self._chain_length(joint))
            below = self._depth.get(joint.child, 0) + 1
            self._depth[joint.parent] = max(self._depth.get(joint.parent, 0), below)
            if joint.movable or joint.child in self.roots:
                self.roots.add(joint.parent)

    def _chain_length(self, joint: Joint) -> int:
        """Largest number of independent movable joints in a chain that begins with a joint."""
        return self.moving.get(joint.child, 0) + (joint.movable and joint.mimic is None)

    def arms(self) -> list[Arm]:
        """The chains below the base with at least MIN_ARM_JOINTS own joints; if there are none, the longest
        chains."""
        chains = self._arms_from(self.base, (), 0)
        arms_with_joints = [arm for arm in chains if arm.own_joints >= MIN_ARM_JOINTS]
        longest = max((len(arm.joints) for arm in chains), default=0)
        return arms_with_joints or [arm for arm in chains if len(arm.joints) == longest]

    def _arms_from(self, link: str, chain: tuple[str, ...], own_joints: int) -> list[Arm]:
        """Arms that continue a chain of joints at a link. The last `own_joints` joints of the chain come
        after the last branching."""
        while True:
            next_joints = [j for j in self.below.get(link, []) if j.movable or j.child in self.roots]
            if chain and self._begins_gripper(next_joints, own_joints, chain[-1]):
                return [Arm(chain, link, own_joints)]
            if len(next_joints) > 1:
                return [
                    arm for j in next_joints for arm in self._arms_from(j.child, *self._extended(j, chain, 0))
                ]
            if not next_joints:
                return [Arm(chain, self._deepest(link), own_joints)] if own_joints else []
            chain, own_joints = self._extended(next_joints[0], chain, own_joints)
            link = next_joints[0].child

    def _extended(self, joint: Joint, chain: tuple[str, ...], own_joints: int) -> tuple[tuple[str, ...], int]:
        """A chain and its number of own joints, extended by a joint if the joint is movable."""
        return ((*chain, joint.name), own_joints + 1) if joint.movable else (chain, own_joints)

    def _begins_gripper(self, branches: list[Joint], own_joints: int, before: str) -> bool:
        """Whether `branches` begin a gripper or a hand. `before` is the joint before them; `own_joints`
        joints precede them since the last branching."""
        lengths = [self._chain_length(joint) for joint in branches]
        if len(branches) == 1:
            [joint] = branches
            words = [len(GRIPPER.findall(name)) for name in (before, joint.name)]
            finger = lengths == [1] and own_joints >= MIN_ARM_JOINTS and FINGER.search(joint.child)
            jaw = finger or (words[0] < words[1] and lengths[0] <= MAX_HAND_FINGER_JOINTS)
            return bool(jaw) and joint.movable
        if len(branches) == 2:
            return max(lengths) <= MAX_FINGER_JOINTS
        hand = own_joints >= MIN_ARM_JOINTS and sum(length >= LIMB_JOINTS for length in lengths) not in (1, 2)
        return len(branches) > 2 and (max(lengths) <= MAX_HAND_FINGER_JOINTS or hand)

    def _deepest(self, link: str) -> str:
        """The link at the end of the deepest branches below a link. A branch whose first link matches
        `NO_TIP` is followed only if there is no other."""
        while self.below.get(link):
            link = max(
                self.below[link],
                key=lambda joint: (not NO_TIP.search(joint.child), self._depth.get(joint.child, 0)),
            ).child
        return link


def planned_joints(
    file: Path, base: str, joints: list[Joint], tip: str | None, group: str | None, srdf: Srdf
) -> tuple[set[str], list[str]]:
    """Names of the joints that are planned unless they are locked, and the tips.

    There are several tips if the group has several chains, such as two arms. `joints` are all joints below
    the base, parents before children. Raises InputError for an unknown tip or group, for a group without
    movable joints or with joints that do not lead to the given tip, and for a robot with several arms if
    neither `tip` nor `group` is given.
    """
    above = {joint.child: joint for joint in joints}
    if tip is not None:
        check_name(f"tip link below {base} in {file.name}", tip, [base, *above])
    chosen: list[str] | None = None
    tips = [tip] if tip else []
    if group in srdf.groups:
        chosen = [joint.name for joint in srdf.joints(group, tuple(joints))]
        if not chosen:
            raise InputError(f"{srdf.path}: group {group} has no movable joint below {base}")
        tips = tips or _ends(chosen, above, srdf.tips(group))
    elif group is not None or not tip:
        arms = _chosen_arms(file, JointTree(base, joints).arms(), group, [*srdf.groups])
        tips = tips or [arm.tip for arm in arms] or [base]
    leading = [joint for end in tips for joint in chain(above, end) if joint.movable]
    not_leading = [name for name in chosen or () if name not in {joint.name for joint in leading}]
    if not_leading:
        raise InputError(
            f"{file}: {tip} is not below {', '.join(not_leading)} of group {group}; leave out --tip, or "
            f"choose a group of one arm"
        )
    names = {joint.name for joint in leading if joint.mimic is None and joint.name not in srdf.passive}
    return names if chosen is None else names & {*chosen}, tips


def _ends(chosen: list[str], above: dict[str, Joint], written: list[str]) -> list[str]:
    """Tips of a group with the joints `chosen`: the child links of its last joints. A tip that the SRDF gives
    (`written`) replaces the one of these child links that leads to it."""
    last = {joint.child: joint.child for joint in above.values() if joint.name in chosen}
    for link in [*last]:
        for joint in chain(above, link)[:-1]:
            last.pop(joint.child, None)
    for tip in written:
        on_way = [joint.child for joint in chain(above, tip) if joint.child in last]
        if on_way:
            last[on_way[-1]] = tip
    return list(last.values())


def linkage_notes(file: Path, robot: Robot) -> list[str]:
    """Notes on joints that are held although they mimic planned joints or joints above the base. Raises
    InputError if a joint that mimics a planned joint moves geometry or a tip."""
    by_name = {joint.name: joint for joint in robot.joints}
    notes = []
    for joint in robot.joints:
        leader = joint
        while leader.mimic and leader.mimic.joint in by_name:
            leader = by_name[leader.mimic.joint]
        if leader.mimic:
            notes.append(
                f"joint {leader.name} mimics {leader.mimic.joint}, which is above the base: it is held at "
                f"{robot.locked[leader.name]:g}; --lock {leader.name}=VALUE sets another value"
            )
        if leader is joint or leader.name in robot.locked:
            continue
        problem = f"joint {joint.name} mimics {leader.name}, which is planned; that is not supported: "
        if any(joint in robot.joints_above(link) for link in (*robot.meshes, *robot.tips)):
            raise InputError(
                f"{file}: {problem}hold {leader.name} with --lock {leader.name}=VALUE, end the arm above it "
                f"with --tip, or remove {joint.name} and what it carries, which is then not checked"
            )
        notes.append(
            f"{problem}{joint.name} is held, so the pose of {joint.child} is wrong and must not be a goal"
        )
    return notes


def _chosen_arms(file: Path, arms: list[Arm], group: str | None, groups: list[str]) -> list[Arm]:
    """The arm with the name or tip `group`, or all arms for `ALL` and `BOTH`. Without `group`, the robot's
    only arm, or an empty list.

    `groups` are the names of groups in the SRDF, for messages. Raises InputError for an unknown name, and for
    several arms without `group`.
    """
    repeated_names = repeated(arm.name for arm in arms)
    names = [arm.tip if arm.name in repeated_names else arm.name for arm in arms]
    all_name = BOTH if len(arms) == 2 else ALL
    if group is None and len(arms) > 1:
        listed = (
            f"{name} ({len(arm.joints)} joints to {arm.tip})" for name, arm in zip(names, arms, strict=True)
        )
        raise InputError(
            f"{file} has {len(arms)} arms: {', '.join(listed)}; choose one, or {all_name} as one robot: "
            f"robotdiffuse robot add {file.name} --group {names[0]}"
            + (f" (groups of its SRDF: {', '.join(groups)})" if groups else "")
        )
    if group is None:
        return arms
    chosen = [arm for arm, name in zip(arms, names, strict=True) if group in (name, arm.tip)]
    all_names = sorted({ALL, all_name}) if len(arms) > 1 else []
    if not chosen and group not in all_names:
        raise unknown_name(f"group of {file}", group, [*names, *all_names, *groups])
    return chosen[:1] or arms
