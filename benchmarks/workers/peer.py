"""Runs another planner on the problems of benchmarks/peers.py, in the environment of that planner.

    python benchmarks/workers/peer.py NAME TASK.json ANSWERS.json

NAME is a key of PEERS. Each planner has its own environment, because they need different versions of NumPy;
this file imports nothing of RobotDiffuse. TASK.json holds the robot, the limits, and the problems, as
`benchmarks/peers.py` writes them. The answers in ANSWERS.json have, for each problem, the CPU time, and the
duration and rows of the timed motion or the reason why there is no motion.

Each planner is used as its documentation shows: its own inverse kinematics for poses, its search until the
first path, its simplification, its timing. CPU time includes these steps, but not building the scene.
"""

# The libraries have no types, or are installed elsewhere:
# pyright: reportAttributeAccessIssue=false, reportIndexIssue=false, reportMissingImports=false

import json
import sys
import tempfile
import time
from importlib.metadata import version
from pathlib import Path

import numpy as np

ROW = 0.004
"""Time between the rows of a motion [s]."""
IK_TRIES = 100
"""Number of random starts of inverse kinematics, for planners that leave this to the user or use few."""
IK_STEPS = 200
"""Number of iterations from each start."""


class UnsolvedError(Exception):
    """The planner found no motion; the message is its reason."""


class MPlib:
    """MPlib's `Planner`: its inverse kinematics, OMPL's RRT-Connect, TOPP-RA."""

    packages = ("mplib", "toppra", "numpy")

    def __init__(self, robot, limit):
        import mplib
        from mplib.collision_detection import fcl

        self.pose = mplib.Pose
        self.fcl = fcl
        self.robot = robot
        self.limit = limit
        absolute = Path(robot["urdf"])
        urdf = absolute.with_name("relative.urdf")  # MPlib looks for meshes below the folder of the URDF
        urdf.write_text(absolute.read_text().replace(f"{absolute.parent}/", ""))
        self.planner = mplib.Planner(
            urdf,
            robot["tip"],
            srdf=robot["srdf"],
            use_convex=True,
            joint_vel_limits=robot["velocity"],
            joint_acc_limits=robot["acceleration"],
        )
        self.obstacles = []

    def place(self, shapes):
        world = self.planner.planning_world
        for name in self.obstacles:
            world.remove_object(name)
        self.obstacles = [shape["name"] for shape in shapes]
        for shape in shapes:
            if shape["kind"] == "box":
                solid = self.fcl.Box(shape["size"])
            else:
                solid = self.fcl.Cylinder(shape["radius"], shape["height"])
            at = self.pose(np.array(shape["xyz"]), np.array(shape["wxyz"]))
            world.add_object(shape["name"], self.fcl.CollisionObject(solid, at))
            for link in self.robot["fixed_links"]:
                world.get_allowed_collision_matrix().set_entry(link, shape["name"], True)

    def plan(self, start, goal):
        options = {"time_step": ROW, "planning_time": self.limit}
        if "positions" in goal:
            result = self.planner.plan_qpos([np.array(goal["positions"])], np.array(start), **options)
        else:
            pose = self.pose(np.array(goal["xyz"]), np.array(goal["wxyz"]))
            result = self.planner.plan_pose(pose, np.array(start), **options)
        if result["status"] != "Success":
            raise UnsolvedError(result["status"])
        return float(result["duration"]), result["position"]


class Roboplan:
    """roboplan's RRT with two trees, its shortcuts, its inverse kinematics and TOPP-RA."""

    packages = ("roboplan", "numpy")

    def __init__(self, robot, limit):
        from roboplan import core, rrt, simple_ik, toppra

        self.core = core
        self.robot = robot
        self.scene = core.Scene("scene", core.loadUrdfSceneDescription(robot["urdf"]))
        self.scene.importSrdf(Path(robot["srdf"]).read_text())
        self.scene.addGroup("arm", robot["joints"])
        rows = "".join(
            f"  {name}:\n    max_acceleration: [{limit}]\n"
            for name, limit in zip(robot["joints"], robot["acceleration"], strict=True)
        )
        with tempfile.NamedTemporaryFile("w", suffix=".yaml") as file:
            file.write(f"joint_limits:\n{rows}")
            file.flush()
            self.scene.importJointLimitsFromConfig(core.loadJointLimitsConfig(file.name))
        self.rrt = rrt
        self.options = rrt.RRTOptions(
            group_name="arm", max_nodes=1_000_000, max_planning_time=limit, rrt_connect=True
        )
        self.ik = simple_ik.SimpleIk(
            self.scene,
            simple_ik.SimpleIkOptions(
                group_name="arm", max_iters=IK_STEPS, max_restarts=IK_TRIES, max_time=limit
            ),
        )
        self.timing = toppra.TOPPRAOptions(dt=ROW, mode=toppra.SplineFittingMode.Adaptive)
        self.toppra = toppra
        self.obstacles = []

    def place(self, shapes):
        scene = self.scene
        core = self.core
        for name in self.obstacles:
            scene.removeGeometry(name)
        self.obstacles = [shape["name"] for shape in shapes]
        static = list(self.robot["fixed_links"])
        gray = np.full(4, 0.5)
        for shape in shapes:
            T = np.asfortranarray(matrix(shape))
            name = shape["name"]
            if shape["kind"] == "box":
                scene.addBoxGeometry(name, "universe", core.Box(*shape["size"]), T, gray)
            else:
                solid = core.Cylinder(shape["radius"], shape["height"])
                scene.addCylinderGeometry(name, "universe", solid, T, gray)
            for other in static:
                scene.setCollisions(other, name, False)
            static.append(name)

    def plan(self, start, goal):
        core = self.core
        names = self.robot["joints"]
        begin = core.JointConfiguration(names, np.array(start))
        end = core.JointConfiguration(names, np.array(goal.get("positions", start)))
        if "xyz" in goal:
            T = np.asfortranarray(matrix(goal))
            wanted = core.CartesianConfiguration(self.robot["base"], self.robot["tip"], T)
            if not self.ik.solveIk(wanted, begin, end):
                raise UnsolvedError("no inverse kinematics")
        path = self.rrt.RRT(self.scene, self.options).plan(begin, end)
        path = core.PathShortcutter(self.scene, core.PathShortcuttingOptions(group_name="arm")).shortcut(path)
        motion = self.toppra.PathParameterizerTOPPRA(self.scene, "arm").generate(path, self.timing)
        return float(motion.times[-1]), np.array(motion.positions)


class Sscbirrt:
    """sscbirrt's `plan` in a MuJoCo model of the robot and the scene, with SSIK, and its own timing."""

    packages = ("sscbirrt", "ssik", "mujoco", "numpy")

    def __init__(self, robot, limit):
        import mujoco
        import sscbirrt.mujoco

        self.mujoco = mujoco
        self.sscbirrt = sscbirrt
        self.robot = robot
        self.limit = limit

    def place(self, shapes):
        mujoco = self.mujoco
        spec = mujoco.MjSpec.from_file(self.robot["urdf"])
        spec.compiler.fusestatic = False
        names = {body.name for body in spec.bodies}
        for a, b in self.robot["unchecked"]:
            if a in names and b in names:  # the link of the base is MuJoCo's world
                spec.add_exclude(bodyname1=a, bodyname2=b)
        spec.body(self.robot["tip"]).add_site(name="tip")
        alone = Path(self.robot["urdf"]).with_name("arm.xml")
        if not alone.exists():
            spec.compile()
            alone.write_text(spec.to_xml())
        for shape in shapes:
            kind = shape["kind"]
            size = shape["size"] if kind == "box" else [shape["radius"], shape["height"], 0]
            spec.worldbody.add_geom(
                name=shape["name"],
                type=mujoco.mjtGeom.mjGEOM_BOX if kind == "box" else mujoco.mjtGeom.mjGEOM_CYLINDER,
                size=np.array(size) / 2 if kind == "box" else [size[0], size[1] / 2, 0],
                pos=shape["xyz"],
                quat=shape["wxyz"],
            )
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        mujoco.mj_forward(self.model, self.data)
        self.arm = self.sscbirrt.mujoco.Arm(self.model, self.robot["joints"], ee_site="tip", mjcf=str(alone))
        self.sscbirrt.backends.native_mujoco.NativeScene.from_model(self.model, self.arm.joints, ())

    def plan(self, start, goal):
        from tsr import TSR

        wanted = goal.get("positions")
        wanted = np.array(wanted) if wanted else TSR(T0_w=matrix(goal), Bw=np.zeros((6, 2)))
        limits = self.sscbirrt.TrajectoryOptions(
            velocity_limits=self.robot["velocity"], acceleration_limits=self.robot["acceleration"]
        )
        result = self.sscbirrt.mujoco.plan(
            self.model,
            self.data,
            self.arm,
            start=np.array(start),
            goal=wanted,
            config=self.sscbirrt.CBiRRTConfig(timeout=self.limit),
            seed=0,
            trajectory=limits,
        )
        if not result.success or result.trajectory is None:
            raise UnsolvedError(str(result.failure_reason))
        motion = result.trajectory
        return float(motion.duration), motion.sample(round(1e9 * ROW))[1]


class OmplPinocchio:
    """OMPL's RRT-Connect and simplification with Pinocchio's kinematics and collision check; timing by
    toppra."""

    packages = ("ompl", "pin", "toppra", "numpy")

    def __init__(self, robot, limit):
        import coal
        import pinocchio
        import toppra
        from ompl import base, geometric
        from toppra import algorithm, constraint

        toppra.setup_logging("ERROR")
        self.coal = coal
        self.pin = pinocchio
        self.base = base
        self.geometric = geometric
        self.robot = robot
        self.limit = limit
        self.model = pinocchio.buildModelFromUrdf(robot["urdf"])
        self.data = self.model.createData()
        self.tip = self.model.getFrameId(robot["tip"])
        self.rng = np.random.default_rng(0)
        self.toppra = toppra
        self.algorithm = algorithm
        limits = (robot["velocity"], robot["acceleration"])
        self.limits = [
            constraint.JointVelocityConstraint(np.array(limits[0])),
            constraint.JointAccelerationConstraint(np.array(limits[1])),
        ]

    def place(self, shapes):
        pin = self.pin
        geometry = pin.buildGeomFromUrdf(self.model, self.robot["urdf"], pin.GeometryType.COLLISION)
        for solid in geometry.geometryObjects:  # the meshes are convex
            solid.geometry.buildConvexHull(True, "Qt")
            solid.geometry = solid.geometry.convex
        links = [self.model.frames[solid.parentFrame].name for solid in geometry.geometryObjects]
        unchecked = {frozenset(pair) for pair in self.robot["unchecked"]}
        count = len(links)
        for i in range(count):
            for j in range(i):
                if links[i] != links[j] and frozenset((links[i], links[j])) not in unchecked:
                    geometry.addCollisionPair(pin.CollisionPair(j, i))
        for shape in shapes:
            if shape["kind"] == "box":
                solid = self.coal.Box(*shape["size"])
            else:
                solid = self.coal.Cylinder(shape["radius"], shape["height"])
            T = matrix(shape)
            at = pin.SE3(T[:3, :3], T[:3, 3])
            k = geometry.addGeometryObject(pin.GeometryObject(shape["name"], 0, at, solid))
            for i in range(count):
                if links[i] not in self.robot["fixed_links"]:
                    geometry.addCollisionPair(pin.CollisionPair(i, k))
        self.geometry = geometry
        self.geometry_data = geometry.createData()

    def free(self, q):
        arguments = (self.model, self.data, self.geometry, self.geometry_data, q, True)
        return not self.pin.computeCollisions(*arguments)

    def configurations(self, T, start):
        """A free configuration that brings the tip to a pose; inverse kinematics begins at the start, then at
        random configurations."""
        pin = self.pin
        lower = self.model.lowerPositionLimit
        upper = self.model.upperPositionLimit
        target = pin.SE3(T[:3, :3], T[:3, 3])
        q = start.copy()
        for _ in range(IK_TRIES):
            for _ in range(IK_STEPS):
                pin.forwardKinematics(self.model, self.data, q)
                error = self.pin.log6(
                    pin.updateFramePlacement(self.model, self.data, self.tip).actInv(target)
                ).vector
                if np.linalg.norm(error) < 1e-4:
                    break
                J = pin.computeFrameJacobian(self.model, self.data, q, self.tip)
                q = np.clip(q + J.T @ np.linalg.solve(J @ J.T + 1e-6 * np.eye(6), error), lower, upper)
            else:
                q = self.rng.uniform(lower, upper)
                continue
            if self.free(q):
                return q
            q = self.rng.uniform(lower, upper)
        raise UnsolvedError("no inverse kinematics")

    def plan(self, start, goal):
        base = self.base
        start = np.array(start)
        dof = len(start)
        wanted = goal.get("positions")
        end = np.array(wanted) if wanted else self.configurations(matrix(goal), start)
        space = base.RealVectorStateSpace(dof)
        bounds = base.RealVectorBounds(dof)
        for i in range(dof):
            bounds.setLow(i, float(self.robot["lower"][i]))
            bounds.setHigh(i, float(self.robot["upper"][i]))
        space.setBounds(bounds)
        setup = self.geometric.SimpleSetup(space)
        setup.setStateValidityChecker(lambda state: self.free(np.array(state[0:dof])))
        begin = space.allocState()
        finish = space.allocState()
        begin[0:dof] = start.tolist()
        finish[0:dof] = end.tolist()
        setup.setStartAndGoalStates(begin, finish)
        setup.setPlanner(self.geometric.RRTConnect(setup.getSpaceInformation()))
        if setup.solve(self.limit).getStatus() != base.PlannerStatus.EXACT_SOLUTION:
            raise UnsolvedError("RRT-Connect found no path")
        setup.simplifySolution(self.limit)
        path = setup.getSolutionPath()
        path.interpolate()
        rows = np.array([state[0:dof] for state in path.getStates()])
        rows = rows[np.append(True, np.linalg.norm(np.diff(rows, axis=0), axis=1) > 1e-9)]
        at = np.append(0, np.cumsum(np.linalg.norm(np.diff(rows, axis=0), axis=1)))
        spline = self.toppra.SplineInterpolator(at / at[-1], rows)
        motion = self.algorithm.TOPPRA(
            self.limits, spline, parametrizer="ParametrizeConstAccel"
        ).compute_trajectory()
        if motion is None:
            raise UnsolvedError("toppra cannot time the path")
        times = np.linspace(0, motion.duration, max(int(motion.duration / ROW), 2))
        return float(motion.duration), motion(times)


PEERS = {"mplib": MPlib, "roboplan": Roboplan, "sscbirrt": Sscbirrt, "ompl": OmplPinocchio}


def matrix(pose):
    """The 4 x 4 matrix of a position and a quaternion wxyz."""
    w, x, y, z = pose["wxyz"]
    T = np.eye(4)
    T[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    T[:3, 3] = pose["xyz"]
    return T


def main():
    name, task_file, answers_file = sys.argv[1:]
    task = json.loads(Path(task_file).read_text())
    kind = PEERS[name]
    peer = kind(task["robot"], task["wall_limit"])
    answers = []
    for i, problem in enumerate([task["problems"][0], *task["problems"]]):  # the first warms up
        peer.place(problem["shapes"])
        answer = {"name": problem["name"], "duration": None, "rows": None, "reason": ""}
        began = time.process_time()
        try:
            duration, rows = peer.plan(problem["start"], problem["goal"])
            answer |= {"duration": duration, "rows": np.asarray(rows).tolist()}
        except Exception as error:  # planners raise several kinds of errors: there is no motion
            answer["reason"] = (
                f"{error}" if isinstance(error, UnsolvedError) else f"{type(error).__name__}: {error}"
            )
        answer["cpu"] = time.process_time() - began
        if i:
            answers.append(answer)
    versions = {package: version(package) for package in kind.packages}
    Path(answers_file).write_text(json.dumps({"versions": versions, "answers": answers}))


if __name__ == "__main__":
    main()
