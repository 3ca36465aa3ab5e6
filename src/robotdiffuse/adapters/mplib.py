"""MPlib's planner: `from robotdiffuse.adapters.mplib import Planner` in place of `from mplib import Planner`.

Methods, arguments and results are those of MPlib 0.1 and 0.2, on top of `rd.Workspace`. A pose is seven
numbers (x, y, z, and a quaternion w, x, y, z), an object with `p` and `q` such as `sapien.Pose`, or a 4 x 4
matrix. If a plan fails, `status` contains the reason too.
"""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache, partial, reduce
from math import inf
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy import ndarray
from numpy.typing import ArrayLike
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from robotdiffuse.core.errors import (
    InputError,
    check_list,
    check_name,
    located,
    numbers,
    positive,
    rigid_transform,
    shown,
)
from robotdiffuse.core.files import file_name, read_bytes
from robotdiffuse.core.mesh_files import read_triangles
from robotdiffuse.core.transforms import pose, transform
from robotdiffuse.core.types import PlanResult
from robotdiffuse.planning.workspace import Workspace
from robotdiffuse.problems.compiled_constraints import pose_difference
from robotdiffuse.problems.problem import JointGoal
from robotdiffuse.robots import known_robots, load_robot
from robotdiffuse.robots.bodies import RigidShape
from robotdiffuse.robots.fitting.preparation import add_robot
from robotdiffuse.robots.parsing.urdf import UrdfTree, with_limits
from robotdiffuse.robots.robot import Robot
from robotdiffuse.robots.robot_folder import ROBOT_FILE, user_robots
from robotdiffuse.scenes.scene import without_link
from robotdiffuse.scenes.shapes import Box, Mesh, PointCloud, Sphere
from robotdiffuse.validation.tolerances import DEFAULT

SUCCESS = "Success"
# MPlib's names
CLOUD = "scene_pcd"
HELD = "attached_geom"
# Jerk limits let the acceleration reach its limit within this time [s], since MPlib has no jerk limits.
RAMP_TIME = 0.01
# The last row is repeated for this time [s], in which position controllers reach it.
SETTLING_TIME = 0.24
# How far a motion that rotates unevenly may leave the straight line [m].
LOOSE_TOLERANCE = 0.002
# Weight of the rotation error against the position error, for poses that are out of reach [m/rad].
TILT_WEIGHT = 0.01
# With the smallest tilt that reaches the position, the arm is fully stretched; the motion ends with that
# tilt times this factor.
TILT_MARGIN = 1.25
# Locked joints, such as fingers, are held at multiples of this [rad] or [m].
HELD_JOINT_STEP = 0.002
# Smallest time between two rows of a motion [s].
MIN_TIME_STEP = 1e-4
OPTIONS = (
    "time_step",
    "planning_time",
    "wrt_world",
    "rrt_range",
    "fix_joint_limits",
    "planner_name",
    "simplify",
    "no_simplification",
    "use_point_cloud",
    "use_attach",
    "verbose",
)
"""Options of MPlib's plans: the first three have an effect, the rest are ignored. Options that are not listed
here, such as constraints, are refused."""


class Pose(NamedTuple):
    """MPlib 0.2's pose: position and quaternion w, x, y, z."""

    p: ArrayLike = (0.0, 0.0, 0.0)
    q: ArrayLike = (1.0, 0.0, 0.0, 0.0)


class Planner:
    """Plans motions of a robot, as `mplib.Planner` does.

    Args:
        urdf: The robot's URDF, prepared on first use, in about a minute; or the name of a bundled or added
            robot, for which `srdf` and `package_keyword_replacement` are ignored.
        move_group: The link that goal poses refer to.
        srdf: SRDF with pairs of links that need no check; "" or none: these pairs are found by sampling.
        package_keyword_replacement: The folder that replaces `package://` in the URDF.
        user_link_names: Links that `link_id` counts from 0.
        user_joint_names: Joints in the order of `qpos`; the planned ones must have the order of the chain.
            Empty: all that move, in the order of the URDF. A `qpos` may also hold the planned ones alone.
        joint_vel_limits: Velocity limits of the planned joints [rad/s]; none: 1, as in MPlib.
        joint_acc_limits: Acceleration limits of the planned joints [rad/s²]; none: those of the robot (MPlib:
            1).
        new_package_keyword: Another name for `package_keyword_replacement`.
        objects: Must be empty; obstacles are added with `workspace.add`.
        use_convex: Ignored: collision geometry is convex.
        verbose: Ignored.

    Raises:
        InputError: For files that cannot be read, a package folder that does not exist, an unknown
            `move_group`, unknown joints, `user_joint_names` that do not name each planned joint once and in
            order, limits that are not a positive number for each planned joint, and `objects` that are not
            empty. Names in `user_link_names` are checked when an object is held.
    """

    def __init__(
        self,
        urdf: str | Path,
        move_group: str,
        srdf: str | Path | None = "",
        package_keyword_replacement: str = "",
        user_link_names: Sequence[str] = (),
        user_joint_names: Sequence[str] = (),
        joint_vel_limits: ArrayLike | None = None,
        joint_acc_limits: ArrayLike | None = None,
        new_package_keyword: str = "",
        objects: Sequence | None = (),
        use_convex: bool = False,
        verbose: bool = False,
    ) -> None:
        if objects is not None and len(objects):
            raise InputError("objects must be empty; add obstacles with `planner.workspace.add(rd.Box(...))`")
        check_list("user_joint_names", user_joint_names, str, "names of joints")
        check_list("user_link_names", user_link_names, str, "names of links")
        robot = _robot(urdf, move_group, srdf, package_keyword_replacement or new_package_keyword)
        joints = [joint.name for joint in robot.joints]
        movable = (joint.name for joint in robot.joints if joint.movable)
        self.joint_names = tuple(user_joint_names or movable)
        for name in self.joint_names:
            check_name("joint in user_joint_names", name, joints)
        self._places = [i for i, name in enumerate(self.joint_names) if name in robot.joint_names]
        if [self.joint_names[i] for i in self._places] != [*robot.joint_names]:
            raise InputError(
                f"user_joint_names is {shown(user_joint_names)}; it must name each joint that moves "
                f"{move_group} once, in the order {', '.join(robot.joint_names)}"
            )
        self._links = {-1: move_group, **dict(enumerate(user_link_names))}
        self.workspace = Workspace(_limited(robot, joint_vel_limits, joint_acc_limits), move_group)
        """The robot and its obstacles. Add obstacles other than point clouds with `planner.workspace.add`."""

    @property
    def robot(self) -> Robot:
        """The robot, with the object that it holds."""
        return self.workspace.robot

    @property
    def joint_vel_limits(self) -> ndarray:
        """Velocity limits of the planned joints [rad/s]."""
        return self.robot.velocity

    @joint_vel_limits.setter
    def joint_vel_limits(self, values: ArrayLike) -> None:
        self.workspace.robot = _limited(self.robot, values, self.robot.acceleration)

    @property
    def joint_acc_limits(self) -> ndarray:
        """Acceleration limits of the planned joints [rad/s²]."""
        return self.robot.acceleration

    @joint_acc_limits.setter
    def joint_acc_limits(self, values: ArrayLike) -> None:
        self.workspace.robot = _limited(self.robot, self.robot.velocity, values)

    def set_base_pose(self, pose: Any) -> None:
        """Place the base in the world. Obstacles stay where they are in the world.

        Args:
            pose: T_world_base.
        """
        self.workspace.T_world_base = matrix(pose)

    def update_point_cloud(
        self,
        points: Any = None,
        resolution: Any = 1e-3,
        name: str = CLOUD,
        pc: Any = None,
        radius: Any = None,
    ) -> None:
        """Replace the point cloud.

        Args:
            points: Points [n, 3] in the frame of the world [m].
            resolution: Radius of the sphere around each point [m]; at least 1 mm is used.
            name: Name of the cloud.
            pc: MPlib 0.1's name of `points`.
            radius: MPlib 0.1's name of `resolution`.
        """
        radius = positive(CLOUD, "radius", resolution if radius is None else radius)
        self.workspace.add(PointCloud(points if pc is None else pc, max(radius, 1e-3), name=name))

    def remove_point_cloud(self, name: str = CLOUD) -> bool:
        """Remove a point cloud; returns whether there was one."""
        present = name in self.workspace.obstacles
        if present:
            self.workspace.remove(name)
        return present

    def update_attached_box(self, size: ArrayLike, pose: Any, *link: Any, **named: Any) -> None:
        """Hold a box instead of the object that was held before.

        Args:
            size: Edge lengths of the box [m].
            pose: Pose of the box in the frame of the link.
            link: `link_id` (MPlib 0.1), or `art_name` and `link_id` (0.2): the place of the link in
                `user_link_names`; -1 or omitted: the move group. `art_name` is ignored.
            named: The same by name.
        """
        self._hold(Box(np.zeros(3), size, name=HELD).moved(matrix(pose)), *link, **named)

    def update_attached_sphere(self, radius: float, pose: Any, *link: Any, **named: Any) -> None:
        """Hold a sphere; see `update_attached_box`."""
        self._hold(Sphere(matrix(pose)[:3, 3], radius, name=HELD), *link, **named)

    def update_attached_mesh(self, mesh_path: str | Path, pose: Any, *link: Any, **named: Any) -> None:
        """Hold a mesh; see `update_attached_box`."""
        mesh = Mesh(*read_triangles(mesh_path, turn=False), name=HELD)  # as in MPlib
        self._hold(mesh.moved(matrix(pose)), *link, **named)

    def detach_object(self, name: str = HELD, also_remove: bool = True) -> bool:
        """Release the held object, without adding it to the obstacles (`also_remove` is ignored). Returns
        whether an object was held."""
        present = self._holds(name)
        if present:
            self.workspace.robot = self.robot.detach(name)
            self.workspace.scene = without_link(self.workspace.scene, name)
        return present

    def _holds(self, name: str) -> bool:
        return any(body.name == name for body in self.robot.attached)

    def IK(
        self,
        goal_pose: Any,
        start_qpos: ArrayLike,
        mask: Any = None,
        n_init_qpos: int = 20,
        threshold: float = 1e-3,
        *,
        return_closest: bool = False,
        verbose: bool = False,
    ) -> tuple[str, list[ndarray] | ndarray | None]:
        """Collision-free configurations that reach a pose in the frame of the base, the nearest to the start
        first. `threshold` and `verbose` are ignored.

        Returns:
            "Success" and the configurations (with `return_closest`, the first one), or the reason and None.
        """
        self._check_mask(mask)
        start = self._start(start_qpos)
        T_world_tip = self.workspace.T_world_base @ matrix(goal_pose)
        with located("n_init_qpos"):
            solutions = self.workspace.ik(T_world_tip, near=start, count=n_init_qpos)
        states = [self.workspace.is_free(q) for q in solutions]
        free = [self._qpos(q, start_qpos) for q, state in zip(solutions, states, strict=True) if state]
        if free:
            return SUCCESS, free[0] if return_closest else free
        why = f"collides: {states[0].reason}" if states else "is out of reach"
        return f"IK Failed! The pose of {self.workspace.tip} {why}", None

    def plan_pose(
        self,
        goal_pose: Any,
        current_qpos: ArrayLike,
        mask: Any = None,
        time_step: float = 0.1,
        rrt_range: float = 0.1,
        planning_time: float = 1.0,
        **options: Any,
    ) -> dict[str, Any]:
        """Plan to a pose of the move group.

        Args:
            goal_pose: The pose, in the frame of the world, or of the base if `wrt_world` is False.
            current_qpos: The present joint values, in the order of `user_joint_names`; or only those of the
                planned joints.
            mask: True for joints that are held; these must not be planned joints.
            time_step: Time between rows [s].
            rrt_range: Ignored.
            planning_time: Time limit [s].
            options: `wrt_world`; other options of MPlib are ignored, and constraints are refused.

        Returns:
            A dictionary with `status`: "Success", or the reason for the failure. If the plan succeeded, also
            with `time`, `position`, `velocity`, `acceleration`, `duration` and `note`.
        """
        self._check_mask(mask)
        plan = partial(self.workspace.plan, self._in_world(goal_pose, options))
        return self._planned("planning failed", plan, current_qpos, time_step, planning_time, options)

    def plan_qpos(
        self,
        goal_qposes: Any,
        current_qpos: ArrayLike,
        time_step: float = 0.1,
        rrt_range: float = 0.1,
        planning_time: float = 1.0,
        **options: Any,
    ) -> dict[str, Any]:
        """Plan to any of several configurations; see `plan_pose`."""
        goals = np.atleast_2d(_array(goal_qposes))
        if goals.ndim > 2 or goals.shape[1] not in (self.robot.dof, len(self.joint_names)):
            raise InputError(f"goal_qposes is {shown(goal_qposes)}; it must be rows of {self._expected()}")
        ends = goals if goals.shape[1] == self.robot.dof else goals[:, self._places]
        plan = partial(self.workspace.plan, JointGoal(ends))
        return self._planned("planning failed", plan, current_qpos, time_step, planning_time, options)

    def plan_screw(
        self,
        goal_pose: Any = None,
        current_qpos: ArrayLike = (),
        qpos_step: float = 0.1,
        time_step: float = 0.1,
        *,
        planning_time: float = 1.0,
        **options: Any,
    ) -> dict[str, Any]:
        """Move along a straight line while turning at a constant rate; see `plan_pose`.

        `target_pose` and `qpos` are MPlib 0.1's names of the first two arguments; `qpos_step` is ignored.

        If there is no such motion, a motion along the line that turns unevenly is tried. If the pose is out
        of reach, but the arm can reach its position when tilted by at most 12 degrees, the motion ends
        there, tilted by TILT_MARGIN times as much. In both cases `note` says so.
        """
        T = self._in_world(options.pop("target_pose", goal_pose), options)
        qpos = options.pop("qpos", current_qpos)

        def plan(start: ndarray, **request: Any) -> PlanResult:
            result = self.workspace.plan_line(T, start, **request)
            if result.solved:
                return result

            def noted(other: PlanResult, note: str) -> PlanResult:
                return replace(other, notes=(*other.notes, note)) if other.solved else result

            if len(self.workspace.ik(T, near=start, count=1)):
                uneven = self.workspace.plan_line(T, start, LOOSE_TOLERANCE, None, **request)
                return noted(uneven, "this motion turns unevenly; none along the line turns evenly")
            tilt = self._tilt(T, start)
            angle = np.linalg.norm(tilt)
            if angle > DEFAULT.goal_angle:
                return result
            turned = transform(T[:3, 3], Rotation.from_rotvec(tilt).as_matrix() @ T[:3, :3])
            tilted = self.workspace.plan_line(turned, start, **request)
            degrees = np.degrees(angle)
            return noted(tilted, f"the pose is out of reach; the motion ends tilted by {degrees:.1f} degrees")

        return self._planned("screw plan failed", plan, qpos, time_step, planning_time, options)

    plan_qpos_to_pose = plan_pose
    plan_qpos_to_qpos = plan_qpos

    def check_for_self_collision(self, *state: Any, **options: Any) -> list[str]:
        """A list with the reason why a configuration is refused even if all obstacles are ignored; empty if
        it is free. The configuration is the first argument (MPlib 0.1: the second, after the robot), `qpos`
        or `state`."""
        q = self._state(state, options)  # locks joints of the robot, such as fingers
        return _reasons(Workspace(self.robot), q)

    def check_for_env_collision(self, *state: Any, **options: Any) -> list[str]:
        """A list with the reason why a configuration is refused among the obstacles; empty if it is free. See
        `check_for_self_collision`; MPlib 0.1's further arguments are ignored."""
        return _reasons(self.workspace, self._state(state, options))

    def _state(self, arguments: Sequence[Any], options: dict[str, Any]) -> ndarray:
        """The planned joints of the configuration among the arguments of a check."""
        unnamed = arguments[:2][-1] if arguments else ()
        return self._start(options.get("qpos", options.get("state", unnamed)))

    def _planned(
        self,
        failed: str,
        plan: Callable[..., PlanResult],
        qpos: ArrayLike,
        time_step: float,
        planning_time: float,
        options: dict[str, Any],
    ) -> dict[str, Any]:
        """A planned motion as MPlib returns it, with a row every `time_step`. The first row is one step after
        the start. The last row is repeated for SETTLING_TIME, since scripts grasp and release right after
        the motion."""
        for name, value in options.items():
            if value is not None and np.size(value):  # MPlib 0.1: fixed_joint_indices=[]
                check_name("option", name, OPTIONS)
        start = self._start(qpos)
        step = positive("options", "time_step", time_step)
        if step < MIN_TIME_STEP:
            raise InputError(f"time_step is {step}; it must be at least {MIN_TIME_STEP} s")
        time_limit = positive("options", "planning_time", planning_time)
        try:
            result = plan(start, time_limit=time_limit)
        except InputError as error:
            return {"status": f"{failed}: {error}"}
        trajectory = result.trajectory
        if trajectory is None:
            return {"status": f"{failed}: {result.reason}"}
        times = step * np.arange(1, np.ceil((trajectory.duration + SETTLING_TIME) / step) + 1)
        state = trajectory.at(np.minimum(times, trajectory.duration))
        return {
            "status": SUCCESS,
            "time": times,
            "position": state.positions,
            "velocity": state.velocities,
            "acceleration": state.accelerations,
            "duration": trajectory.duration,
            "note": "\n".join(result.notes),
        }

    def _tilt(self, T_world_tip: ndarray, start: ndarray) -> ndarray:
        """The rotation, as a rotation vector, by which the pose must be tilted so that the arm reaches its
        position, times TILT_MARGIN. Infinite if the arm cannot reach the position with any tilt."""

        def errors(q: ndarray) -> ndarray:
            displacement, turn = pose_difference(T_world_tip, self.workspace.pose(q))
            return np.append(displacement, TILT_WEIGHT * turn)

        robot = self.robot
        upper = np.maximum(robot.upper, robot.lower + 1e-6)  # SciPy refuses equal limits
        solution = least_squares(errors, np.clip(start, robot.lower, upper), bounds=(robot.lower, upper))
        in_reach = np.linalg.norm(solution.fun[:3]) < 1e-3
        return TILT_MARGIN * solution.fun[3:] / TILT_WEIGHT if in_reach else np.full(3, np.inf)

    def _in_world(self, pose: Any, options: dict[str, Any]) -> ndarray:
        T = matrix(pose)
        return T if options.get("wrt_world", True) else self.workspace.T_world_base @ T

    def _expected(self) -> str:
        """What joint values must be, for messages."""
        return f"{len(self.joint_names)} numbers, the values of {', '.join(self.joint_names)}"

    def _start(self, qpos: Any) -> ndarray:
        """The planned joints of `qpos`. Its other joints, such as fingers, are locked at their values in
        `qpos`, rounded to multiples of HELD_JOINT_STEP."""
        q = np.ravel(_array(qpos))
        if len(q) not in (self.robot.dof, len(self.joint_names)) or not np.isfinite(q).all():
            raise InputError(f"qpos is {shown(qpos)}; it must be {self._expected()}")
        if len(q) == self.robot.dof:
            return q
        values = dict(zip(self.joint_names, q.tolist(), strict=True))
        robot = self.robot
        locked = {
            joint.name: round(values[joint.name] / HELD_JOINT_STEP) * HELD_JOINT_STEP
            for joint in robot.joints
            if joint.name in robot.locked and joint.name in values and joint.mimic is None
        }
        with located("qpos"):
            self.workspace.robot = robot.with_locked(locked)
        return q[self._places]

    def _qpos(self, q: ndarray, start_qpos: ArrayLike) -> ndarray:
        """`q` as a `qpos`; other joints as in `start_qpos`."""
        qpos = np.ravel(_array(start_qpos))
        if len(qpos) == len(q):
            return q
        qpos[self._places] = q
        return qpos

    def _check_mask(self, mask: Any) -> None:
        flags = np.ravel(() if mask is None else mask)
        masked_joints = [name for name, flag in zip(self.joint_names, flags, strict=False) if flag]
        planned = [name for name in masked_joints if name in self.robot.joint_names]
        if planned:
            raise InputError(f"mask holds {', '.join(planned)}; planned joints cannot be held")

    def _hold(self, shape: RigidShape, art_name: Any = None, link_id: Any = -1) -> None:
        # the third argument of MPlib 0.1 is link_id
        link = art_name if isinstance(art_name, int | np.integer) else link_id
        check_name("link_id", link, self._links)
        empty_handed = self.robot.detach(HELD) if self._holds(HELD) else self.robot
        self.workspace.robot = empty_handed.attach(shape, self._links[int(link)])


def _reasons(workspace: Workspace, q: ndarray) -> list[str]:
    state = workspace.is_free(q)
    return [] if state else [state.reason]


def matrix(value: Any) -> ndarray:
    """The homogeneous transform of a pose: an object with `p` and `q`, seven numbers, or 4 x 4 numbers."""
    if hasattr(value, "p") and hasattr(value, "q"):
        value = np.append(_array(value.p), _array(value.q))
    array = _array(value)
    if array.shape == (4, 4):
        return rigid_transform("pose", array)
    if array.size != 7:
        raise InputError(
            f"pose is {shown(value)}; it must be x, y, z and a quaternion w, x, y, z, or 4 x 4 numbers"
        )
    flat = array.ravel()
    return pose(flat[:3], wxyz=flat[3:])


def _robot(urdf: str | Path, tip: str, srdf: str | Path | None, package: str) -> Robot:
    """The prepared robot. A URDF with new content, or with new meshes, is prepared first. It is stored where
    `load_robot` does not look, which may want another tip of the same URDF."""
    if str(urdf) in known_robots():
        return load_robot(str(urdf))
    packages: dict[str, str | Path] = {}
    if package:
        if not Path(package).is_dir():
            raise InputError(f"package_keyword_replacement is {shown(package)}; it must be a folder")
        packages = {entry.name: entry for entry in Path(package).iterdir() if entry.is_dir()}
    tree = UrdfTree(file_name(urdf, "urdf"), packages)  # refuses xacro, which can run code
    semantics = srdf or tree.srdf
    content = read_bytes(semantics, "srdf") if semantics else b""
    content += f"{tree.digest} {tip} {bool(srdf)}".encode()
    folder = user_robots() / "mplib" / f"{Path(urdf).stem}-{hashlib.sha256(content).hexdigest()[:8]}"
    if not (folder / ROBOT_FILE).is_file():
        add_robot(urdf, tip=tip, srdf=srdf or None, packages=packages, out=folder)
    return load_robot(folder)


def _limited(robot: Robot, velocity: ArrayLike | None, acceleration: ArrayLike | None) -> Robot:
    """The robot with these limits of its planned joints, and the jerk limits that follow from RAMP_TIME.
    Without limits, velocities are limited to 1, and accelerations as before."""
    rows = []
    for field, argument, usual in (
        ("velocity", velocity, np.ones(robot.dof)),
        ("acceleration", acceleration, robot.acceleration),
    ):
        values = np.ravel(_array(usual if argument is None or not np.size(argument) else argument))
        if len(values) != robot.dof or not ((values > 0) & (values < inf)).all():
            raise InputError(
                f"{field} limits are {shown(argument)}; they must be {robot.dof} positive numbers, one for "
                "each planned joint"
            )
        rows.append(tuple(values.tolist()))
    # held objects are attached again, so that the limits remain when they are released
    return reduce(Robot.with_body, robot.attached, _with_limits(robot.arm, *rows))


@lru_cache(maxsize=64)
def _with_limits(robot: Robot, velocity: tuple[float, ...], acceleration: tuple[float, ...]) -> Robot:
    """The same object for equal limits, since arrays for collision checks are computed once for each robot:
    ManiSkill makes a planner for each episode."""
    limits = {
        name: {"velocity": v, "acceleration": a, "jerk": a / RAMP_TIME}
        for name, v, a in zip(robot.joint_names, velocity, acceleration, strict=True)
    }
    return with_limits(robot, limits)


def _array(value: object) -> ndarray:
    """The value as an array of numbers; empty if it holds anything else."""
    array = numbers(value)
    return np.zeros(0) if array is None else array
