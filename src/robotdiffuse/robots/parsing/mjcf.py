"""Reads robots from MuJoCo models (MJCF). MuJoCo compiles the model, which is then written as a URDF with
mesh files.

Each body of the robot (see `robot_bodies`), and each site on one, becomes a link with the body's or site's
frame. Joint values are MuJoCo's `qpos`.
"""

import warnings
import xml.etree.ElementTree as ET
from contextlib import suppress
from itertools import combinations
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import trimesh
from numpy import ndarray

from robotdiffuse.core.errors import MAX_WORD, InputError, needs, shortened, shown
from robotdiffuse.core.transforms import (
    inverse,
    rotation_about,
    rotation_from_quaternion,
    transform,
    xyzw_of,
)
from robotdiffuse.core.types import Mask, Pose, Values, Vector
from robotdiffuse.robots.fitting.convex_parts import convex_hull
from robotdiffuse.robots.parsing.srdf import Srdf

GEOMS = ("sphere", "capsule", "ellipsoid", "cylinder", "box", "mesh")
"""Types of geoms that are converted: ellipsoids to meshes, the others to elements that `urdf.py` reads."""
WORLD = 0
"""Index of the world body, which does not move."""
EXCLUDED = "excluded by the model"
"""Reason for not checking a pair of links (`Srdf.allowed`)."""
MIN_SHIFT = 1e-9
"""A joint closer than this to the origin of its body counts as being at the origin [m]."""


def imported_mujoco() -> Any:
    """The module mujoco, which has no types for type checkers."""
    import mujoco

    return mujoco


def compiled_model(path: Path) -> Any:
    """The model of an MJCF file, as MuJoCo compiles it.

    Raises InputError for a damaged file, and if MuJoCo is not installed.
    """
    with needs("mujoco (to read MuJoCo models)", "mujoco"):
        mujoco = imported_mujoco()
    handler = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(str)  # without a handler, MuJoCo writes MUJOCO_LOG.TXT in the working folder
    try:
        with warnings.catch_warnings(action="ignore"):
            spec = mujoco.MjSpec.from_file(str(path))
            spec.compiler.fusestatic = False  # bodies without joints are links, too
            return spec.compile()
    except Exception as error:  # MuJoCo raises several kinds of errors for a damaged model
        text = shortened(error, MAX_WORD)
        unopened = text.startswith("Error: Error opening")
        remedy = "; meshes (STL, OBJ or MSH) are in its meshdir, textures in texturedir" if unopened else ""
        raise InputError(f"{path} is no valid MuJoCo model: {text}{remedy}") from None
    finally:
        mujoco.set_mju_user_warning(handler)


def colliding_geoms(model: Any) -> Mask:
    """Whether each geom collides with anything: by its masks, or in a pair that the model names."""
    colliding = (model.geom_contype | model.geom_conaffinity) > 0
    colliding[[*model.pair_geom1, *model.pair_geom2]] = True
    return colliding


def robot_bodies(model: Any) -> list[int]:
    """The bodies of the robot, parents before children: the bodies of all kinematic trees that actuators of
    joints move. If there is no such tree, the robot is all trees with hinges or slides that are no soft body
    and have no free joint, or else, as for a humanoid, also those with a free joint."""
    roots = model.body_rootid[model.jnt_bodyid]
    kinds = [kind_of("Joint", kind) for kind in model.jnt_type]
    chosen = {
        roots[model.actuator_trnid[k, 0]]
        for k in range(model.nu)
        if kind_of("Trn", model.actuator_trntype[k]) in ("joint", "jointinparent")
    }
    if not chosen:
        moving = {*roots[np.isin(kinds, ("hinge", "slide"))]} - {*model.flex_vertbodyid}
        chosen = moving - {*roots[np.isin(kinds, "free")]} or moving
    return np.flatnonzero(np.isin(model.body_rootid, [*chosen])).tolist()


def placing_joints(model: Any, bodies: list[int]) -> set[int]:
    """The joints that only place the base: free joints, and slide joints without a range if the robot has
    other joints too."""
    joints = _joints_of(model, bodies)
    free, slides = (
        {k for k in joints if kind_of("Joint", model.jnt_type[k]) == kind and not model.jnt_limited[k]}
        for kind in ("free", "slide")
    )
    return free | slides if len(slides) < len(joints) else free


def kind_of(enumeration: str, value: Any) -> str:
    """The name of a value of one of MuJoCo's enumerations (Joint, Geom, Trn, Eq), such as "hinge"."""
    return getattr(imported_mujoco(), f"mjt{enumeration}")(int(value)).name.rpartition("_")[2].lower()


def _joints_of(model: Any, bodies: list[int]) -> list[int]:
    return np.flatnonzero(np.isin(model.jnt_bodyid, bodies)).tolist()


class ConvertedModel:
    """The robot of an MJCF file as a URDF whose root link is the world."""

    def __init__(self, path: Path) -> None:
        """Raises InputError as `compiled_model` does, for a model without hinge or slide joints, for ball
        joints, for flexes and colliding geoms of types that are not converted, for keyframes with values that
        are not finite, and if all joints are slide joints without a range."""
        self.path = path
        self.model = model = compiled_model(path)
        self.folder = TemporaryDirectory(prefix="robotdiffuse-mjcf-")
        """Contains the mesh files that the URDF names."""
        name = bytes(model.names).partition(b"\0")[0].decode()
        # MuJoCo's name for models without one
        self.root = ET.Element("robot", name=path.stem if name in ("", "MuJoCo Model") else name)
        self.bodies = robot_bodies(model)
        self.held = placing_joints(model, self.bodies)
        self.colliding = colliding_geoms(model)
        self.notes = list[str]()
        self.links = set[str]()
        self.meshes = dict[str, str]()

        if not self.bodies:
            raise InputError(
                f"{self.path} has no robot: no body is moved by a hinge or a slide joint; "
                "rd.Scene.from_mujoco reads obstacles"
            )
        if np.isin(model.flex_vertbodyid, self.bodies).any():
            raise InputError(f"{self.path}: the robot has a soft part (flex); use geoms in its place")
        self._link("world")
        self.mimics = self._mimics()
        """The attributes of <mimic>, by index of the joint, for joints that a linear equality constraint ties
        to another joint."""
        for body in self.bodies:
            self._body(body)
        self._sites()
        ET.indent(self.root)
        self.semantics = Srdf(self.path, allowed=self._excluded(), poses=self._poses())
        """Named poses (the keyframes), and the pairs of links that the model excludes from collision."""
        self.urdf = ET.tostring(self.root)

    def name(self, kind: str, index: int) -> str:
        """The name of an element of the model; if it has none, its kind and index, such as "geom3", with an
        underscore if another element has this name."""
        named = getattr(self.model, kind)
        label = named(index).name or f"{kind}{index}"
        with suppress(KeyError):
            return f"{label}_" if named(label).id != index else label
        return label

    def _element(self, name: str, kind: str, parent: str, child: str, T: Pose) -> ET.Element:
        """Adds a joint to the URDF; T is T_parent_joint."""
        joint = ET.SubElement(self.root, "joint", name=name, type=kind)
        ET.SubElement(joint, "parent", link=parent)
        ET.SubElement(joint, "child", link=child)
        _origin(joint, T)
        return joint

    def _link(self, name: str) -> ET.Element:
        self.links.add(name)
        return ET.SubElement(self.root, "link", name=name)

    def _body(self, body: int) -> None:
        """Adds the link of a body and its joints to the URDF. The frame of a joint is at the joint's anchor,
        which may differ from the origin of the body's frame."""
        model = self.model
        name = self.name("body", body)
        parent = int(model.body_parentid[body])
        above = "world" if parent == WORLD else self.name("body", parent)
        T = _pose(model.body(body))
        joints = _joints_of(model, [body])
        for joint in joints:
            label = self.name("joint", joint)
            kind = kind_of("Joint", model.jnt_type[joint])
            if joint in self.held:
                slide = f"slide joint {label}, which has no range,"
                held_joint = slide if kind == "slide" else f"the free joint of {name}"
                self.notes.append(f"{held_joint} is held where the model places it")
                continue
            if kind == "ball":
                raise InputError(f"{self.path}: joint {label} is a ball joint; use three hinges in its place")
            anchor = transform(model.jnt_pos[joint])
            # the pose of the joint at the value 0, seen from its pose at the value in `qpos0`
            axis = model.jnt_axis[joint]
            value = -float(model.qpos0[model.jnt_qposadr[joint]])
            reference = (
                transform(value * axis)
                if kind == "slide"
                else transform(np.zeros(3), rotation_about(axis, value))
            )
            last = joint == joints[-1] and np.linalg.norm(model.jnt_pos[joint]) < MIN_SHIFT
            child = name if last else f"{label}_anchor"
            if not last:
                self._link(child)
            self._joint(joint, above, child, T @ anchor @ reference)
            above = child
            T = inverse(anchor)
        if above != name:
            self._element(f"{name}_fixed", "fixed", above, name, T)
        self._geometry(self._link(name), body)

    def _joint(self, joint: int, parent: str, child: str, T: ndarray) -> None:
        model = self.model
        label = self.name("joint", joint)
        slides = kind_of("Joint", model.jnt_type[joint]) == "slide"
        limited = model.jnt_limited[joint]
        if slides and not limited:
            raise InputError(f"{self.path}: slide joint {label} has no range; give it one")
        kind = "prismatic" if slides else "revolute" if limited else "continuous"
        element = self._element(label, kind, parent, child, T)
        ET.SubElement(element, "axis", xyz=_text(model.jnt_axis[joint]))
        limits = {"effort": repr(self._effort(joint))}
        if limited:
            limits["lower"], limits["upper"] = map(repr, model.jnt_range[joint].tolist())
        ET.SubElement(element, "limit", limits)
        if joint in self.mimics:
            ET.SubElement(element, "mimic", self.mimics[joint])

    def _effort(self, joint: int) -> float:
        """The joint's own limit of the force or torque of its actuators, else the largest limit of one of
        them [N] or [N m]; 0 if there is none."""
        model = self.model
        if model.jnt_actfrclimited[joint]:
            return float(np.abs(model.jnt_actfrcrange[joint]).max())
        return max(
            (
                float(np.abs(model.actuator_forcerange[k]).max() * abs(model.actuator_gear[k, 0]))
                for k in range(model.nu)
                if model.actuator_trnid[k, 0] == joint
                and kind_of("Trn", model.actuator_trntype[k]) in ("joint", "jointinparent")
                and model.actuator_forcelimited[k]
            ),
            default=0.0,
        )

    def _mimics(self) -> dict[int, dict[str, str]]:
        model = self.model
        self.notes += [
            f"the limits of tendon {self.name('tendon', k)} are ignored"
            for k in range(model.ntendon)
            if model.tendon_limited[k]
        ]
        mimics = dict[int, dict[str, str]]()
        movable = {*_joints_of(model, self.bodies)} - self.held
        for k in range(model.neq):
            if not model.eq_active0[k]:
                continue
            follower = int(model.eq_obj1id[k])
            leader = int(model.eq_obj2id[k])
            offset, slope, *higher = model.eq_data[k, :5].tolist()
            kind = kind_of("Eq", model.eq_type[k])
            if kind == "joint" and follower not in movable:
                continue
            if kind != "joint" or leader not in movable or any(higher):
                self.notes.append(
                    f"equality {self.name('equality', k)} ({kind}) is ignored; --lock can hold what it ties"
                )
                continue
            start = model.qpos0[model.jnt_qposadr[[follower, leader]]]
            mimics[follower] = {
                "joint": self.name("joint", leader),
                "multiplier": repr(slope),
                "offset": repr(float(start[0] + offset - slope * start[1])),
            }
        return mimics

    def _geometry(self, link: ET.Element, body: int) -> None:
        """Adds the inertia and the geoms of a body to its link. Geoms that collide with nothing become visual
        elements, or are left out if their type is not converted."""
        model = self.model
        if model.body_mass[body] > 0:
            inertial = ET.SubElement(link, "inertial")
            R = rotation_from_quaternion(model.body_iquat[body])
            _origin(inertial, transform(model.body_ipos[body], R))
            ET.SubElement(inertial, "mass", value=repr(float(model.body_mass[body])))
            xx, yy, zz = map(repr, model.body_inertia[body].tolist())
            ET.SubElement(inertial, "inertia", ixx=xx, iyy=yy, izz=zz, ixy="0", ixz="0", iyz="0")
        for geom in np.flatnonzero(model.geom_bodyid == body).tolist():
            if not self.colliding[geom] and kind_of("Geom", model.geom_type[geom]) not in GEOMS:
                continue
            element = ET.SubElement(link, "collision" if self.colliding[geom] else "visual")
            _origin(element, _pose(model.geom(geom)))
            self._shape(ET.SubElement(element, "geometry"), geom)

    def _shape(self, parent: ET.Element, geom: int) -> None:
        """Adds the shape of a geom. A mesh that collides is replaced by its convex hull, as MuJoCo does."""
        kind = kind_of("Geom", self.model.geom_type[geom])
        size = self.model.geom_size[geom]
        if kind == "sphere":
            ET.SubElement(parent, "sphere", radius=_text(size[:1]))
        elif kind == "box":
            ET.SubElement(parent, "box", size=_text(2 * size))
        elif kind in ("capsule", "cylinder"):
            ET.SubElement(parent, kind, radius=_text(size[:1]), length=_text(2 * size[1:2]))
        elif kind == "ellipsoid":
            ET.SubElement(parent, "mesh", filename=self._written(ellipsoid(size), f"geom{geom}"))
        elif kind == "mesh":
            index = int(self.model.geom_dataid[geom])
            solid = self.colliding[geom]
            name = f"{'hull' if solid else 'mesh'}{index}"
            if name not in self.meshes:
                mesh = mesh_of(self.model, index)
                if solid:
                    hull = convex_hull(mesh.vertices)
                    mesh = trimesh.Trimesh(hull.vertices, hull.faces, process=False)
                self.meshes[name] = self._written(mesh, name)
            ET.SubElement(parent, "mesh", filename=self.meshes[name])
        else:
            name = self.name("geom", geom)
            body = self.name("body", int(self.model.geom_bodyid[geom]))
            raise InputError(
                f"{self.path}: {name} of body {body} is of type {kind}; use one of {', '.join(GEOMS)}, or "
                "let it collide with nothing (contype and conaffinity 0)"
            )

    def _written(self, mesh: trimesh.Trimesh, name: str) -> str:
        mesh.export(Path(self.folder.name, f"{name}.stl"))
        return f"{name}.stl"

    def _sites(self) -> None:
        for site in range(self.model.nsite):
            body = int(self.model.site_bodyid[site])
            name = self.name("site", site)
            if body not in self.bodies:
                continue
            link = name if name not in self.links else f"{name}_site"
            T = _pose(self.model.site(site))
            self._element(f"{link}_fixed", "fixed", self.name("body", body), link, T)
            self._link(link)

    def _excluded(self) -> dict[frozenset[str], str]:
        """Pairs of links that MuJoCo does not check for collision: excluded pairs, rigidly connected links, a
        link and the link that carries it (unless the model disables filterparent), and links whose geoms all
        exclude each other by their masks. Links with geoms that the model names as a pair are checked."""
        model = self.model
        excluded, named = (
            {frozenset(divmod(int(signature), 2**16)) for signature in signatures}
            for signatures in (model.exclude_signature, model.pair_signature)
        )
        unfiltered = bool(model.opt.disableflags & imported_mujoco().mjtDisableBit.mjDSBL_FILTERPARENT)
        geoms = {
            body: np.flatnonzero((model.geom_bodyid == body) & self.colliding).tolist()
            for body in self.bodies
        }
        solid = [body for body in self.bodies if geoms[body]]

        def meet(first: int, second: int) -> bool:
            """Whether the masks let a geom of one body collide with a geom of the other."""
            a, b = geoms[first], geoms[second]
            kinds, partners = model.geom_contype, model.geom_conaffinity
            return bool((kinds[a, None] & partners[b] | kinds[b] & partners[a, None]).any())

        pairs = [
            pair
            for pair in combinations(solid, 2)
            if frozenset(pair) not in named
            and (frozenset(pair) in excluded or _related(model, *pair, unfiltered) or not meet(*pair))
        ]
        if len(solid) > 1 and len(pairs) == len(solid) * (len(solid) - 1) // 2:
            self.notes.append("by the masks and exclusions of the model, no two of its links may collide")
        return {frozenset(self.name("body", body) for body in pair): EXCLUDED for pair in pairs}

    def _poses(self) -> dict[str, dict[str, float]]:
        model = self.model
        for k, qpos in enumerate(model.key_qpos):
            if not np.isfinite(qpos).all():
                name = f"qpos of keyframe {self.name('key', k)}"
                raise InputError(f"{self.path}: {name} is {shown(qpos)}; its numbers must be finite")
        places = {
            self.name("joint", joint): model.jnt_qposadr[joint]
            for joint in _joints_of(model, self.bodies)
            if joint not in self.held
        }
        return {
            self.name("key", key): {name: float(model.key_qpos[key, place]) for name, place in places.items()}
            for key in range(model.nkey)
        }


def mesh_of(model: Any, mesh: int) -> trimesh.Trimesh:
    """A mesh of a model in the frame of its geoms [m]."""
    vertices = model.mesh_vert[model.mesh_vertadr[mesh] :][: model.mesh_vertnum[mesh]]
    faces = model.mesh_face[model.mesh_faceadr[mesh] :][: model.mesh_facenum[mesh]]
    return trimesh.Trimesh(vertices, faces, process=False)


def ellipsoid(radii: Vector) -> trimesh.Trimesh:
    """A polyhedron around an ellipsoid."""
    ball = trimesh.creation.icosphere(subdivisions=2)
    inradius = np.einsum("fd,fd->f", ball.face_normals, ball.triangles[:, 0]).min()
    ball.apply_scale(radii / inradius)
    return ball


def _related(model: Any, first: int, second: int, unfiltered: bool) -> bool:
    """Whether two bodies are rigidly connected, or one is the parent of the other. Rigidly connected bodies
    count as one body, and bodies fixed to the world are no parents. `unfiltered`: whether the model lets a
    body collide with its parent."""
    welded = model.body_weldid[[first, second]]
    above = model.body_weldid[model.body_parentid[welded]]
    carried = welded[0] == above[1] or welded[1] == above[0]
    return bool(welded[0] == welded[1] or (carried and WORLD not in welded and not unfiltered))


def _pose(part: Any) -> Pose:
    """The pose of a body, geom or site in its parent."""
    return transform(part.pos, rotation_from_quaternion(part.quat))


def _origin(element: ET.Element, T: Pose) -> None:
    ET.SubElement(element, "origin", xyz=_text(T[:3, 3]), quat_xyzw=_text(xyzw_of(T)))


def _text(numbers: Values) -> str:
    return " ".join(map(repr, numbers.tolist()))
