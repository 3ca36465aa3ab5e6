"""Reads robots from URDF, xacro and MuJoCo files, and limits of joints from MoveIt's joint_limits.yaml."""

import hashlib
import math
import re
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy import ndarray

from robotdiffuse.core.errors import (
    MAX_COORDINATE,
    MAX_RATE,
    MIN_RATE,
    MIN_SIZE,
    InputError,
    check_name,
    check_type,
    joined,
    located,
    points,
    repeated,
    shown,
    unit_quaternion,
    within,
)
from robotdiffuse.core.files import parse_xml, read_bytes, read_yaml
from robotdiffuse.core.mesh_files import read_triangles
from robotdiffuse.core.transforms import (
    inverse,
    placed,
    rotation_from_quaternion,
    rotation_from_rpy,
    transform,
)
from robotdiffuse.core.types import Points, Pose, Values
from robotdiffuse.robots.bodies import ConvexMesh, Inertia, inertia_of, polygon_around_circle
from robotdiffuse.robots.fitting.convex_parts import MIN_THICKNESS, Surface, convex_hull, thickened
from robotdiffuse.robots.kinematic_tree import CONTINUOUS_LIMIT, MOVING_KINDS, Joint, Mimic, with_mimics
from robotdiffuse.robots.parsing.mjcf import ConvertedModel, ellipsoid
from robotdiffuse.robots.parsing.packages import Packages, compiled_xacro, is_xacro, with_prefixes
from robotdiffuse.robots.parsing.srdf import Srdf, linkage_notes, planned_joints, srdf_beside
from robotdiffuse.robots.robot import Robot

ROTATING_KINDS = ("revolute", "continuous")
RIGHT_ANGLE_TOLERANCE = 1e-3
"""Largest absolute cosine of an angle that counts as a right angle."""


def moves_in_a_plane(joints: Sequence[Joint]) -> bool:
    """Whether a chain of joints moves in a plane, like a base on wheels: it has two perpendicular prismatic
    joints, and a rotating joint with an axis perpendicular to both."""
    moving = [joint for joint in joints if joint.kind != "fixed"]
    if sorted(joint.kind in ROTATING_KINDS for joint in moving) != [False, False, True]:
        return False
    R = np.eye(3)
    axes = []
    for joint in joints:
        R = R @ joint.T_parent_joint[:3, :3]
        if joint.kind != "fixed":
            axes.append(R @ joint.axis)
    return bool(np.abs(np.array(axes) @ np.transpose(axes) - np.eye(3)).max() < RIGHT_ANGLE_TOLERANCE)


PRIMITIVES = ("box", "capsule", "cylinder", "sphere")
MOMENTS = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
KINDS = (*MOVING_KINDS, "fixed")
SINGLE = ("origin", "geometry", "parent", "child", "axis", "limit", "mimic", "inertial")
"""Elements that a link, a joint or a collision element has at most once."""
MAX_LINKS = 500
"""Largest number of links of a robot; humanoids with hands have about 100."""
MAX_LINK_SIZE = 10.0
"""Size of a link above which a note asks to check the units [m]."""
MAX_SIZE_PER_REACH = 10.0
"""A moving link above MAX_LINK_SIZE is refused if it is larger than the arm's reach by this factor."""
DEFAULT_VELOCITY = 1.0
"""Velocity limit of movable joints for which the URDF gives none [rad/s] or [m/s]."""
RATE_LIMITS = ("velocity", "acceleration", "deceleration", "jerk")
"""Attributes of <limit> that are read if they are positive; few URDFs have more than velocity."""
ACCELERATION_PER_VELOCITY = 4.0
"""Ratio of acceleration and velocity limits [1/s], for URDFs without acceleration limits: full speed is
reached after 0.25 s."""
JERK_PER_ACCELERATION = 10.0
"""Ratio of jerk and acceleration limits [1/s]: full acceleration is reached after 0.1 s."""


class UrdfTree:
    """The links and joints of one URDF file or MuJoCo model, checked as they are read."""

    text: bytes
    """The URDF; for a xacro file or a MuJoCo model, the URDF that was made from it."""

    def __init__(self, path: Path, folders: dict[str, str | Path], compile_xacro: bool = False) -> None:
        """Read the file. `folders` are folders of ROS packages by name. If `compile_xacro` is true, a xacro
        file is compiled, which runs code in it; otherwise, a xacro file raises InputError."""
        self.path = path
        self.packages = Packages(path, folders)
        self.notes = list[str]()
        self.semantics: Srdf | None = None
        """Named poses and allowed pairs of a MuJoCo model."""
        self.unlimited = set[str]()
        """Joints without a velocity limit."""
        self.unranged = set[str]()
        """Joints without limits of position, such as wheels; they are planned only if the argument
        `limits` of the method `robot` gives position limits, and can be held at any value."""
        self._surfaces = dict[str, tuple[Surface, ...]]()

        def parsed(text: bytes) -> ET.Element:
            self.text = with_prefixes(text)
            return parse_xml(self.text, str(self.path))

        if ".usd" in self.path.suffix.lower():
            raise InputError(
                f"{self.path} is a USD file; robots are read from URDF, xacro and MuJoCo models (MJCF): "
                "convert it to one of them"
            )
        root = parsed(read_bytes(self.path, "URDF"))
        if is_xacro(self.path, root):
            if not compile_xacro:
                raise InputError(
                    f"{self.path} is a xacro file, and compiling it would run code in it; if you trust it, "
                    f"prepare it first: robotdiffuse robot add {self.path} --name NAME, and use that name"
                )
            root = parsed(compiled_xacro(self.path, self.packages))
            self.notes.append(
                f"{self.path.name} was compiled by xacro, which runs the code in its expressions"
            )
        if root.tag == "mujoco":
            model = ConvertedModel(self.path)
            root = parsed(model.urdf)
            self.semantics = model.semantics
            self.notes += model.notes
            self._mesh_folder = model.folder  # removed with this object
            self.packages = Packages(Path(model.folder.name, self.path.name), {})
        if root.tag != "robot":
            raise InputError(
                f"{self.path} is neither a URDF nor a MuJoCo model: its root element is <{root.tag}>, not "
                f"<robot> or <mujoco>; convert other formats first"
            )
        self.name = root.get("name") or self.path.stem
        self.links = self._named(root, "link")
        if len(self.links) > MAX_LINKS:
            raise InputError(f"{self.path} has {len(self.links)} links; at most {MAX_LINKS} are supported")
        solid = any(link.find("collision") is not None for link in self.links.values())
        self.kind = "collision" if solid else "visual"
        """Tag of the elements that are read as collision geometry: "visual" only if no link has
        "collision"."""
        self.elements = self._named(root, "joint")
        self.parents = dict[str, str]()
        """Parent joint of each link except the root."""
        self.children = dict[str, list[str]]()
        self.ends = dict[str, tuple[str, str]]()
        """Parent and child link of each joint."""
        for name, element in self.elements.items():
            parent = self._end(name, element, "parent")
            child = self._end(name, element, "child")
            self.ends[name] = parent, child
            if child in self.parents:
                raise InputError(
                    f"{self.path}: link {child} has two parent joints ({self.parents[child]}, {name}); a "
                    f"URDF is a tree: remove one of them; joints of a loop can follow others by <mimic>"
                )
            self.parents[child] = name
            self.children.setdefault(parent, []).append(name)
        roots = [link for link in self.links if link not in self.parents]
        reached = [*roots]
        for link in reached:  # the list grows while it is read
            reached += [self.ends[name][1] for name in self.children.get(link, ())]
        looped = sorted(self.links.keys() - reached)
        if looped:
            raise InputError(f"{self.path}: the joints of {joined(looped)} form a loop; remove one")
        if len(roots) != 1:
            raise InputError(
                f"{self.path}: a URDF must have one root link; this one has {len(roots)}"
                + (
                    f" ({', '.join(roots[:5])}); connect them with fixed joints"
                    if roots
                    else ": it has no links; if it only defines macros, add a xacro file that uses them"
                )
            )
        self.root = roots[0]

    def robot(
        self,
        base: str | None = None,
        tip: str | None = None,
        locked: dict[str, float] | None = None,
        group: str | None = None,
        srdf: Srdf | None = None,
        limits: Mapping[str, dict[str, float]] | None = None,
    ) -> Robot:
        """The robot, with convex collision meshes and without spheres.

        Planned joints are the movable joints of the group, or all movable joints from base to tip. Passive
        joints and mimic joints are not planned, nor are joints with equal limits or with a value in `locked`.
        All joints that are not planned are locked: at their value in `locked`, which is not clipped; else at
        their value in a rest pose of the SRDF, or at zero, clipped to their limits. Locked mimic joints
        follow the joints that they mimic.

        Acceleration and jerk limits that the file lacks are 4 s⁻¹ times the velocity limit and 10 s⁻¹ times
        the acceleration limit; `limits` may change them. Each collision element becomes a convex hull in
        the link's frame; cylinders, capsules and spheres become polyhedra around the shape. If no link has
        collision elements, visual elements are used, with a note.

        Args:
            base: First link of the robot; by default the root. Links between the root and the base are left
                out. The pose of the base in the root's frame is kept, for scenes that are given in the root's
                frame.
            tip: Last link. By default the link where a gripper or a hand begins (see `robots.parsing.srdf`),
                such as panda_hand for a Panda with fingers; without a gripper, the deepest link.
            locked: Values of locked joints by name [rad] or [m].
            group: A group of the SRDF, the common prefix of an arm's joint names, "both" for two arms, or
                "all" for all arms. A group of several chains, such as two arms, is one robot with several
                tips. Without group and tip, the robot must have exactly one arm.
            srdf: Source of groups, named poses and passive joints.
            limits: Limits that replace those of the file, see `with_limits`.

        Raises:
            InputError: If the file or the arguments are incomplete or contradictory; for mistakes in the
                file, it names the file.
        """
        base = base or self.root
        srdf = srdf or Srdf(self.path)
        check_name(f"base link in {self.path.name}", base, self.links)
        joints = self.below(base)
        names = [base, *(joint.child for joint in joints)]
        planned, ends = planned_joints(self.path, base, joints, tip, group, srdf)
        limits = limits or {}
        ranged = {name for name, fields in limits.items() if {"lower", "upper"} & fields.keys()}
        unranged = sorted(planned & self.unranged.difference(ranged, locked or {}))
        if unranged:
            raise InputError(
                f"{self.path}: {joined(unranged)}: no <limit lower= upper=>; add it, give position limits "
                "with --limits, or hold them with --lock"
            )
        notes = [
            f"joint {joint.name} is passive; it is held" for joint in joints if joint.name in srdf.passive
        ]
        unlimited = [
            joint.name
            for joint in joints
            if joint.name in planned & self.unlimited and "velocity" not in limits.get(joint.name, ())
        ]
        if unlimited:
            notes.append(f"no velocity limit for {joined(unlimited)}; {DEFAULT_VELOCITY:g} assumed")
        robot = Robot(
            name=self.name,
            base=base,
            tip=ends[0],
            other_tips=tuple(ends[1:]),
            joints=tuple(joints),
            meshes=self.geometry(names),
            inertias=self.inertias(names),
            notes=tuple(dict.fromkeys((*self.notes, *notes))),
            root=self.pose_link(base),
            above=self.above(base),
            poses=dict(srdf.poses),
        )
        robot = with_limits(robot, limits)
        movable = [joint for joint in robot.joints if joint.movable]
        fixed_joints = [joint.name for joint in movable if joint.lower == joint.upper]
        # a mimic joint has its offset if the joint that it mimics is above the base
        resting = {joint.name: joint.mimic.offset for joint in movable if joint.mimic} | srdf.resting()
        rest = {
            joint.name: float(np.clip(resting.get(joint.name, 0.0), joint.lower, joint.upper))
            for joint in movable
            if joint.name not in planned.difference(fixed_joints)
        }
        robot = replace(robot, locked=with_mimics(robot.joints, rest)).with_locked(locked or {})
        if robot.dof == 0:
            raise InputError(
                f"{self.path}: no movable joint between {base} and {ends[0]}; "
                + (
                    f"the limits of {joined(fixed_joints)} leave no range"
                    if fixed_joints
                    else "choose another --base or --tip"
                )
            )
        return replace(
            robot, notes=(*robot.notes, *linkage_notes(self.path, robot), *self._size_notes(robot))
        )

    def _size_notes(self, robot: Robot) -> list[str]:
        """Notes on links above MAX_LINK_SIZE. Raises InputError if such a link moves and is larger than
        MAX_SIZE_PER_REACH times the arm's reach."""
        notes = []
        for link, parts in robot.meshes.items():
            size = float(np.ptp(np.concatenate([part.vertices for part in parts]), axis=0).max())
            if size <= MAX_LINK_SIZE:
                continue
            note = (
                f"check the units: link {link} is {size:.4g} m long; lengths are in meters, and a mesh in "
                f'millimeters needs scale="0.001 0.001 0.001"'
            )
            if robot.link_frame(link) > 0 and size > MAX_SIZE_PER_REACH * robot.reach:
                raise InputError(f"{self.path}: {note}")
            notes.append(note)
        return notes

    @property
    def digest(self) -> str:
        """SHA-256 of the URDF and of the mesh files of its collision geometry. Of a xacro file or a MuJoCo
        model, the URDF that was made from it is hashed; of a MuJoCo model, also its excluded pairs and
        poses."""
        digest = hashlib.sha256(self.text)
        if self.semantics:
            allowed = sorted(map(sorted, self.semantics.allowed))
            digest.update(repr((allowed, self.semantics.poses)).encode())
        for element in self.links.values():
            for mesh in element.findall(f"{self.kind}/geometry/mesh"):
                with suppress(InputError):  # links above the base may lack their meshes
                    file = self.packages.file(mesh.get("filename", ""))
                    digest.update(read_bytes(file, "mesh file"))
                    if file.suffix.lower() == ".gltf":  # its buffers may be other files
                        digest.update(read_triangles(file)[0].tobytes())
        return digest.hexdigest()

    @cached_property
    def srdf(self) -> Path | None:
        """The SRDF that belongs to the file (see `srdf_beside`); None if there is none, and for a MuJoCo
        model."""
        return None if self.semantics else srdf_beside(self.path, self.name)

    @property
    def srdf_digest(self) -> str:
        """SHA-256 of the SRDF that belongs to the file; empty if there is none."""
        return hashlib.sha256(read_bytes(self.srdf, "SRDF")).hexdigest() if self.srdf else ""

    def _named(self, root: ET.Element, what: str) -> dict[str, ET.Element]:
        """The links or joints by name. Raises InputError for missing or repeated names, and for elements in
        SINGLE that appear more than once."""
        elements = dict[str, ET.Element]()
        for element in root.findall(what):
            name = element.get("name")
            if not name:
                raise InputError(f"{self.path}: a <{what}> has no name")
            if name in elements:
                raise InputError(
                    f"{self.path}: two {what}s have the name {shown(name)}; rename or remove one"
                )
            for part in (element, *element.findall("collision")):
                for tag in {*SINGLE}.intersection(repeated(child.tag for child in part)):
                    raise InputError(
                        f"{self.path}: {what} {name}: a <{part.tag}> must have one <{tag}>, not more"
                    )
            elements[name] = element
        return elements

    def _end(self, name: str, element: ET.Element, what: str) -> str:
        link = _attributes(element, what).get("link", "")
        if link not in self.links:
            raise InputError(f"{self.path}: joint {name}: its {what} link {shown(link)} is not in the file")
        return link

    def below(self, link: str) -> list[Joint]:
        """Joints below a link, parents before children."""
        joints = list[Joint]()
        for name in self.children.get(link, []):
            joints.append(self._joint(name))
            joints += self.below(joints[-1].child)
        return joints

    def above(self, link: str) -> dict[str, Pose]:
        """T_link_ancestor of each ancestor that fixed joints alone connect to the link."""
        transforms = dict[str, ndarray]()
        T_link_ancestor = np.eye(4)
        while link in self.parents:
            name = self.parents[link]
            element = self.elements[name]
            if element.get("type") != "fixed":
                break
            link = self.ends[name][0]
            T_link_ancestor = T_link_ancestor @ inverse(self._origin(element, f"joint {name}"))
            transforms[link] = T_link_ancestor
        return transforms

    def pose_link(self, link: str) -> str:
        """The link whose pose a scene file gives as the pose of the robot.

        It is the root, unless the URDF begins with a mobile base without geometry: a planar or floating
        joint, or three joints that move in a plane. Then it is the link after these joints. Only joints from
        the root to `link` are considered.
        """
        joints = list[str]()  # from the root to `link`
        end = link
        while end in self.parents:
            joints.insert(0, self.parents[end])
            end = self.ends[joints[0]][0]
        for k, name in enumerate(joints, 1):
            parent, child = self.ends[name]
            if any(self.links[parent].find(kind) is not None for kind in ("collision", "visual")):
                break
            if self.elements[name].get("type") in ("planar", "floating") or moves_in_a_plane(
                [self._joint(joint) for joint in joints[:k]]
            ):
                return child
        return self.root

    def _joint(self, name: str) -> Joint:
        element = self.elements[name]
        location = f"joint {name}"
        kind = element.get("type", "")
        if kind not in KINDS:
            raise InputError(
                f"{self.path}: {location} has type {shown(kind)}; supported: {', '.join(KINDS)}; remove it "
                f"with what it carries, or use --base {self.ends[name][1]} to plan only for what it carries"
            )
        T_parent_joint = self._origin(element, location)
        joint = Joint(name, kind, *self.ends[name], T_parent_joint, np.array([1.0, 0.0, 0.0]))
        if kind == "fixed":
            return joint
        axis = self._numbers(_attributes(element, "axis").get("xyz", "1 0 0"), 3, f"{location}: axis")
        if np.linalg.norm(axis) < 1e-6:
            raise InputError(f"{self.path}: {location}: its axis is zero; give it a direction")
        hard = _attributes(element, "limit")
        joint = self._with_limits(
            replace(joint, axis=axis / np.linalg.norm(axis), mimic=self._mimic(name, element)), hard
        )
        soft = _attributes(element, "safety_controller")
        soft_limits = [
            f"{end} {soft[f'soft_{end}_limit']}"
            for end in ("lower", "upper")
            if soft.get(f"soft_{end}_limit") not in (None, hard.get(end))
        ]
        if soft_limits:
            self.notes.append(
                f"{location}: the soft limits of its safety_controller ({', '.join(soft_limits)}) are "
                f"ignored; set limits with --limits"
            )
        return joint

    def _mimic(self, name: str, element: ET.Element) -> Mimic | None:
        followed = element.find("mimic")
        if followed is None:
            return None
        leaders = [name]
        leader = followed
        while leader is not None:
            joint = leader.get("joint", "")
            if joint not in self.elements or joint in leaders:
                raise InputError(
                    f"{self.path}: joint {leaders[-1]} mimics {shown(joint)}, which must be another joint of "
                    f"the file and must not mimic {leaders[-1]}"
                )
            leaders.append(joint)
            leader = self.elements[joint].find("mimic")
        if self.elements[leaders[1]].get("type") == "fixed":
            self.notes.append(f"joint {name} mimics the fixed joint {leaders[1]}; treated as independent")
            return None
        numbers = [
            float(self._numbers(followed.get(field, default), 1, f"joint {name}: mimic {field}")[0])
            for field, default in (("multiplier", "1"), ("offset", "0"))
        ]
        return Mimic(leaders[1], *numbers)

    def _with_limits(self, joint: Joint, attributes: dict[str, str]) -> Joint:
        stated = {name: text for name, text in attributes.items() if not _is_endless(text)}
        # an endless position limit, such as 1e16, voids the other one too
        ranged = joint.kind != "continuous" and {"lower", "upper"}.isdisjoint(attributes.keys() - stated)
        limits = {
            name: float(self._numbers(stated[name], 1, f"joint {joint.name}: {name} limit")[0])
            for name in (("lower", "upper", *RATE_LIMITS) if ranged else RATE_LIMITS)
            if name in stated
        }
        if joint.kind == "continuous":
            limits |= {"lower": -CONTINUOUS_LIMIT, "upper": CONTINUOUS_LIMIT}
        if "lower" not in limits and "upper" not in limits:
            self.unranged.add(joint.name)
        lower = limits.get("lower", 0.0)
        upper = limits.get("upper", 0.0)
        if lower > upper:
            raise InputError(
                f"{self.path}: joint {joint.name}: lower limit {lower} is above upper {upper}; exchange them "
                "(a limit that is not given is 0)"
            )
        for name in RATE_LIMITS:
            if 0 < limits.get(name, 0.0) < MIN_RATE:
                raise InputError(
                    f"{self.path}: joint {joint.name}: {name} limit is {limits[name]:g}; it must be at least "
                    f"{MIN_RATE:g}, or 0 if there is none"
                )
        velocity = limits.get("velocity", 0.0)
        if velocity <= 0:
            velocity = DEFAULT_VELOCITY
            self.unlimited.add(joint.name)
        effort = 0.0
        with suppress(ValueError):  # only planning with a payload needs effort limits
            effort = float(attributes.get("effort", ""))
        joint = replace(joint, lower=lower, upper=upper, effort=effort if 0 < effort <= MAX_RATE else 0.0)
        rates = {name: limits[name] for name in RATE_LIMITS[1:] if limits.get(name, 0.0) > 0}
        braking = rates.pop("deceleration", math.inf)
        if braking < rates.get("acceleration", ACCELERATION_PER_VELOCITY * velocity):
            rates["acceleration"] = braking
        return _changed(joint, {"velocity": velocity} | rates)

    def inertias(self, links: list[str]) -> dict[str, Inertia]:
        """Inertias of the links that have a mass. Incomplete and physically impossible inertias are left out,
        with a note."""
        inertias = {}
        for link in links:
            element = self.links[link].find("inertial[mass]")
            if element is None:
                continue
            mass = _attributes(element, "mass").get("value", "")
            if re.fullmatch(r"0+\.?0*", mass.strip()):
                continue
            attributes = _attributes(element, "inertia")
            try:
                T = self._origin(element, link)
                texts = (mass, *(attributes.get(name, "") for name in MOMENTS))
                value, *entries = (self._numbers(text, 1, link)[0] for text in texts)
                own = inertia_of([value, *T[:3, 3], *entries])
                inertias[link] = own._replace(moments=T[:3, :3] @ own.moments @ T[:3, :3].T)
            except (InputError, ValueError):
                self.notes.append(f"link {link} has an incomplete or physically impossible inertia; left out")
        return inertias

    def geometry(self, links: list[str]) -> dict[str, tuple[ConvexMesh, ...]]:
        """Convex hulls of the collision elements of each link that has some, in the link's frame.

        If no link of the file has collision elements, the hulls of the visual elements are returned.
        """
        parts = {
            link: tuple(convex_hull(surface.vertices) for surface in surfaces)
            for link in links
            if (surfaces := self.surfaces(link))
        }
        self.notes += [
            f"link {link} has {self.kind} geometry without volume, made {1e3 * MIN_THICKNESS:g} mm thick"
            for link in links
            if any(len(thickened(part.vertices)) > len(part.vertices) for part in self.surfaces(link))
        ]
        if self.kind == "visual" and parts:
            self.notes.append("no link has collision geometry; the visual geometry is used")
        else:
            without_collision = [
                link for link in links if link not in parts and self.links[link].find("visual") is not None
            ]
            if without_collision:
                self.notes.append(
                    f"links without collision geometry are not checked: {', '.join(without_collision)}"
                )
        return parts

    def surfaces(self, link: str) -> tuple[Surface, ...]:
        """The link's elements of the tag `kind` as triangle meshes, in the link's frame.

        Shapes whose sizes are all 0, as in the URDFs of Jaco and Atlas, are left out, with a note. Raises
        InputError for elements without exactly one shape, unknown shapes, wrong sizes, scales and origins,
        and meshes that are missing or damaged.
        """
        if link in self._surfaces:
            return self._surfaces[link]
        parts = []
        for element in self.links[link].findall(self.kind):
            shapes = element.findall("geometry/*")
            if len(shapes) != 1:
                raise InputError(
                    f"{self.path}: link {link}: a <{self.kind}> has {len(shapes)} shapes; it must have one"
                )
            shape = shapes[0]
            if re.fullmatch("[ .]*0[ .0]*", " ".join(shape.attrib.values())):
                self.notes.append(f"link {link}: a <{self.kind}> of size 0 is ignored")
                continue
            if shape.tag == "mesh":
                surface = self._mesh(shape, link)
            elif shape.tag in PRIMITIVES:
                surface = convex_hull(self._primitive(shape, link))
            else:
                raise InputError(
                    f"{self.path}: link {link}: {self.kind} shape <{shape.tag}> is not supported; "
                    f"known: {', '.join(sorted((*PRIMITIVES, 'mesh')))}"
                )
            T = self._origin(element, f"link {link}: {self.kind}")
            parts.append(Surface(placed(T, surface.vertices), surface.faces))
        self._surfaces[link] = tuple(parts)
        return self._surfaces[link]

    def _primitive(self, shape: ET.Element, link: str) -> Points:
        """Corners of a polyhedron that encloses a primitive shape [m], in the shape's frame."""

        def positive(name: str, count: int) -> Values:
            location = f"link {link}: {shape.tag} {name}"
            values = self._numbers(shape.get(name, ""), count, location)
            if (values < MIN_SIZE).any():
                raise InputError(
                    f"{self.path}: {location} is {shown(shape.get(name))}; it must be at least 1e-9"
                )
            return values

        if shape.tag == "box":
            return np.array(trimesh.creation.box(positive("size", 3)).vertices)
        radius = positive("radius", 1)
        if shape.tag == "cylinder":
            end_points = np.insert(polygon_around_circle(float(radius[0])), 2, 0.0, axis=1)
        else:
            end_points = np.array(ellipsoid(np.repeat(radius, 3)).vertices)
        if shape.tag == "sphere":
            return end_points
        half = float(positive("length", 1)[0]) / 2
        return np.concatenate([end_points + np.array([0, 0, z]) for z in (-half, half)])

    def _mesh(self, shape: ET.Element, link: str) -> Surface:
        file = self.packages.file(shape.get("filename", ""))
        location = f"link {link}: mesh"
        scale = self._numbers(shape.get("scale", "1 1 1"), 3, f"{location} scale")
        if (np.abs(scale) < MIN_SIZE).any():
            raise InputError(
                f"{self.path}: {location} scale is {shown(shape.get('scale'))}; numbers must be beyond ±1e-9"
            )
        with located(self.path):
            vertices, faces = read_triangles(file, merge=True, notes=self.notes, turn=False)
            vertices = points(location, "vertices", vertices * scale)
        if len(vertices) < 4:
            raise InputError(
                f"{self.path}: link {link}: {file} has no triangle mesh with at least four vertices; "
                f"repair it or remove its element"
            )
        return Surface(vertices, faces)

    def _numbers(self, text: str, count: int, what: str) -> Values:
        """The `count` numbers of an attribute. Raises InputError for another number of values, and for values
        that are not finite or not within ±MAX_COORDINATE."""
        try:
            values = np.array([float(word) for word in text.split()])
        except ValueError:
            values = np.zeros(0)
        if len(values) != count or not np.isfinite(values).all():
            expected = "a finite number" if count == 1 else f"{count} finite numbers"
            raise InputError(f"{self.path}: {what} is {shown(text)}; it must be {expected}")
        if not within(values):
            raise InputError(f"{self.path}: {what} is {shown(text)}; it must be within ±{MAX_COORDINATE:g}")
        return values

    def _origin(self, element: ET.Element, what: str) -> Pose:
        """The transform of the element's <origin>: T_link_element, or T_parent_joint of a joint."""
        origin = _attributes(element, "origin")
        xyz = self._numbers(origin.get("xyz", "0 0 0"), 3, f"{what}: origin xyz")
        quaternion = origin.get("quat_xyzw")
        if quaternion is None:
            rpy = self._numbers(origin.get("rpy", "0 0 0"), 3, f"{what}: origin rpy")
            return transform(xyz, rotation_from_rpy(*map(float, rpy)))
        if "rpy" in origin:
            raise InputError(f"{self.path}: {what}: origin has rpy and quat_xyzw; it must have one of them")
        xyzw = self._numbers(quaternion, 4, f"{what}: origin quat_xyzw")
        wxyz = np.roll(unit_quaternion(f"{self.path}: {what}", xyzw, "origin quat_xyzw"), 1)
        return transform(xyz, rotation_from_quaternion(wxyz))


def _is_endless(limit: str) -> bool:
    """Whether a limit is so large, such as 1e16 or inf, that it means no limit."""
    with suppress(ValueError):
        return abs(float(limit)) > MAX_COORDINATE
    return False


def _attributes(element: ET.Element, tag: str) -> dict[str, str]:
    """Attributes of an element's child; none if there is no such child."""
    child = element.find(tag)
    return {} if child is None else child.attrib


# FIELDS: fields of joint_limits.yaml of MoveIt and ros2_control, and those of `Joint`. FACTORS: ignored
# fields of MoveIt for which the note names an argument of `plan`.
FIELDS = {
    "min_position": "lower",
    "max_position": "upper",
    "max_velocity": "velocity",
    "max_acceleration": "acceleration",
    "max_jerk": "jerk",
    "max_effort": "effort",
}
FACTORS = ("default_velocity_scaling_factor", "default_acceleration_scaling_factor")


def read_limits(file: str | Path) -> tuple[dict[str, dict[str, float]], tuple[str, ...]]:
    """Read limits from a YAML or JSON file. Returns values by joint and by field of `Joint`, and notes.

    The file has the form joint_limits: {JOINT: {max_velocity: 2.0}}, with the fields min_position,
    max_position, max_velocity, max_acceleration, max_jerk and max_effort. A field is ignored if MoveIt's flag
    for it, such as has_velocity_limits, is false. All other fields that begin with has_, and
    angle_wraparound, are ignored without a note. Other entries beside joint_limits, such as MoveIt's default
    scaling factors, are ignored, with a note. Raises InputError for a file that cannot be read or lacks
    joint_limits, for an entry that is not a mapping, for max_deceleration and unknown fields, and for wrong
    values.
    """
    data = read_yaml(file, "joint limits")
    joints = data.get("joint_limits") if isinstance(data, dict) else None
    if not isinstance(joints, dict):
        raise InputError(
            f"{file} has no joint_limits; it must contain joint_limits: {{JOINT: {{max_velocity: ...}}}}"
        )
    notes = tuple(
        f"{Path(file).name}: {name} {shown(value)} is ignored"
        + (
            f"; plan with {name.removeprefix('default_').removesuffix('_factor')}={value}"
            if name in FACTORS
            else ""
        )
        for name, value in data.items()
        if name != "joint_limits"
    )
    return {str(name): _fields(str(file), str(name), entry) for name, entry in joints.items()}, notes


def with_limits(robot: Robot, limits: Mapping[str, dict[str, float]]) -> Robot:
    """The robot with changed limits, given by joint and field. Raises InputError for an unknown joint, and
    for a lower limit above the upper one.

    A new velocity limit also sets the acceleration limit, and a new acceleration limit the jerk limit, in the
    default ratios, unless these limits are given too, or were in other ratios before. A continuous joint
    with a position limit becomes revolute; if only one of its limits is given, the other one is half a turn
    from zero.
    """
    movable = [joint.name for joint in robot.joints if joint.movable]
    for name in limits:
        check_name(f"movable joint below {robot.base} in joint_limits", name, movable)
    return replace(robot, joints=tuple(_changed(joint, limits.get(joint.name, {})) for joint in robot.joints))


def _fields(file: str, joint: str, entry: Any) -> dict[str, float]:
    check_type(f"{file}: joint_limits of {joint}", entry, dict, "a mapping")
    fields = dict[str, float]()
    for key, value in entry.items():
        # flags of MoveIt, such as has_jerk_limits
        if str(key).startswith("has_") or key == "angle_wraparound":
            continue
        kind = "position" if str(key).endswith("position") else str(key).removeprefix("max_")
        if entry.get(f"has_{kind}_limits") is False:
            continue
        if key == "max_deceleration":
            raise InputError(
                f"{file}: max_deceleration of {joint} is not supported, since motions brake as hard as they "
                "accelerate; set max_acceleration to the smaller of both"
            )
        check_name(f"field of {joint} in {file}", key, FIELDS)
        max_value = MAX_COORDINATE if kind == "position" else MAX_RATE
        number = isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= max_value
        if not number or (kind != "position" and value < MIN_RATE):
            rule = f"within ±{max_value:g}" if kind == "position" else f"from {MIN_RATE:g} to {max_value:g}"
            raise InputError(f"{file}: {key} of {joint} is {shown(value)}; it must be a number {rule}")
        fields[FIELDS[key]] = float(value)
    return fields


def _changed(joint: Joint, fields: dict[str, float]) -> Joint:
    for rate, following, ratio in (
        ("velocity", "acceleration", ACCELERATION_PER_VELOCITY),
        ("acceleration", "jerk", JERK_PER_ACCELERATION),
    ):
        default = getattr(joint, following) == ratio * getattr(joint, rate)  # a new joint has zeros
        if rate in fields and following not in fields and default:
            fields = fields | {following: ratio * fields[rate]}
    if joint.kind == "continuous" and {"lower", "upper"} & fields.keys():
        joint = replace(joint, kind="revolute", lower=-math.pi, upper=math.pi)
    joint = replace(joint, **fields)
    if joint.lower > joint.upper:
        raise InputError(
            f"joint_limits of {joint.name}: min_position {joint.lower} is above max_position {joint.upper}"
        )
    return joint
