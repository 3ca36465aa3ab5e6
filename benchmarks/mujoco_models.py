"""Robots from MuJoCo models compared with MuJoCo: frames, contacts, and planned motions that MuJoCo executes.

    python benchmarks/mujoco_models.py MODEL.xml ... [--prepared FOLDER] [--motions 40]

Prints benchmarks/results/mujoco_models.txt. FOLDER keeps the prepared robots. At random configurations, the
frames of all bodies and sites are compared with MuJoCo's, and so are contacts with random boxes, cylinders,
capsules and spheres. In a disagreement, one of the two has a contact deeper than 1 mm and the other no
contact. Then problems are drawn in such scenes and planned, between free configurations that the straight
line does not join. MuJoCo executes each motion with one position actuator for each joint and compensated
gravity. Every contact of the robot during a motion is unexpected, except between links that may touch or do
not move relative to each other.
"""

# MuJoCo has no types for type checkers:
# pyright: reportAttributeAccessIssue=false

import argparse
import sys
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy import ndarray

import robotdiffuse as rd
from common import FIRST, header, parse, print_table, progress, use_processor_time
from robotdiffuse.collision.exact_meshes import ExactCollision
from robotdiffuse.robots.fitting.preparation import add_robot
from robotdiffuse.robots.robot import Robot

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from helpers.quick_preparation import QUICK

DEPTH = 0.001
"""Contacts deeper than this count as disagreements [m]."""
OBSTACLES = 4
CLEAR = 0.02
"""Smallest distance of starts and goals to obstacles [m]."""
TURN = 1.5
"""Largest motion of a joint from the start to the goal [rad]; with larger ones, a problem may have no
solution."""
TIME_LIMIT = 5.0
"""Time limit of planning, in CPU time [s]."""
# Stiffness [Nm/rad] and damping [Nm s/rad] of the position actuators; inertia of the motors [kg m²].
STIFFNESS = 4000.0
DAMPING = 200.0
ARMATURE = 0.1
TIME_STEP = 0.002
"""Time step of the simulation [s]."""
SEED = 20261127
EXAMPLE = Path(__file__).parents[1] / "examples" / "data" / "mujoco_scene.xml"


class World(NamedTuple):
    """A model with obstacles, and its state."""

    model: Any
    data: Any
    scene: rd.Scene
    links: dict[int, str]
    """Name of each of MuJoCo's bodies, by its number."""

    def place(self, robot: Robot, q: ndarray) -> None:
        values = dict(zip(robot.joint_names, q, strict=True)) | robot.locked
        for name, value in values.items():
            self.data.qpos[self.model.joint(name).qposadr] = value
        mujoco.mj_forward(self.model, self.data)

    def contacts(self, robot: Robot) -> Iterator[tuple[str, str, float]]:
        """Contacts of links that may not touch and move relative to each other, with their distances [m]."""
        model = self.model
        for contact in self.data.contact:
            names = [self.links[int(model.geom_bodyid[geom])] for geom in contact.geom]
            frames = {robot.link_frame(name) if name in robot.link_names else 0 for name in names}
            if len(frames) > 1 and frozenset(names) not in robot.allowed_collisions:
                yield names[0], names[1], float(contact.dist)


def world_of(file: Path, robot: Robot, rng: np.random.Generator) -> World:
    """The model with obstacles at random places, and position actuators in place of its own."""
    spec = mujoco.MjSpec.from_file(str(file))
    for actuator in list(spec.actuators):
        spec.delete(actuator)
    for key in list(spec.keys):
        spec.delete(key)
    spec.option.timestep = TIME_STEP
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    for body in spec.bodies:
        body.gravcomp = 1.0
    for first, second in map(sorted, robot.allowed_collisions):
        spec.add_exclude(bodyname1=first, bodyname2=second)  # their contact forces would brake the joints
    for joint in spec.joints:
        joint.armature = ARMATURE
        if joint.name in robot.joint_names or joint.name in robot.locked:
            actuator = spec.add_actuator(name=f"drive {joint.name}", target=joint.name)
            actuator.trntype = mujoco.mjtTrn.mjTRN_JOINT
            actuator.set_to_position(kp=STIFFNESS, kv=DAMPING)
    kinds = ("BOX", "CYLINDER", "CAPSULE", "SPHERE")
    size = min(1.0, float(robot.reach))
    for i in range(OBSTACLES):
        direction = rng.normal(size=3)
        direction[2] = abs(direction[2])
        spec.worldbody.add_geom(
            name=f"obstacle{i}",
            type=getattr(mujoco.mjtGeom, f"mjGEOM_{kinds[i % len(kinds)]}"),
            size=size * rng.uniform(0.03, 0.08, 3),
            pos=direction / np.linalg.norm(direction) * size * rng.uniform(0.5, 0.9),
            quat=rng.normal(size=4),
        )
    model = spec.compile()
    data = mujoco.MjData(model)
    links = {body: model.body(body).name for body in range(model.nbody)}
    return World(model, data, rd.Scene.from_mujoco(model, data), links)


def draw(robot: Robot, rng: np.random.Generator, count: int) -> ndarray:
    """Random configurations within the limits, and within half a turn for joints without limits."""
    return rng.uniform(np.maximum(robot.lower, -np.pi), np.minimum(robot.upper, np.pi), (count, robot.dof))


def frame_error(world: World, robot: Robot, rows: ndarray) -> float:
    """The largest difference of a frame of the robot from MuJoCo's [m], or of an entry of its rotation."""
    model = world.model
    bodies = [name for name in world.links.values() if name in robot.link_names and name != "world"]
    sites = [model.site(k).name for k in range(model.nsite) if model.site(k).name in robot.link_names]
    sites = [name for name in sites if name not in bodies]
    worst = 0.0
    for q in rows:
        world.place(robot, q)
        frames = [world.data.body(name) for name in bodies] + [world.data.site(name) for name in sites]
        for name, frame in zip((*bodies, *sites), frames, strict=True):
            T = robot.fk(q, name)
            worst = max(worst, float(np.abs(T[:3, 3] - frame.xpos).max()))
            worst = max(worst, float(np.abs(T[:3, :3] - frame.xmat.reshape(3, 3)).max()))
    return worst


def disagreements(world: World, robot: Robot, rows: ndarray) -> tuple[int, int, int]:
    """Numbers of configurations: in collision by MuJoCo; deeper than DEPTH by MuJoCo but free by this
    package; deeper than DEPTH by this package but free by MuJoCo."""
    exact = ExactCollision(robot, world.scene)
    hits = missed = extra = 0
    for q in rows:
        world.place(robot, q)
        depths = [distance for *_, distance in world.contacts(robot)]
        least = min(d.distance for d in exact.distances(q))
        hits += any(depth < 0 for depth in depths)
        missed += min(depths, default=1.0) < -DEPTH and least > 0
        extra += least < -DEPTH and not any(depth < 0 for depth in depths)
    return hits, missed, extra


def problems(file: Path, robot: Robot, rng: np.random.Generator) -> Iterator[tuple[World, rd.Problem]]:
    """Problems whose start and goal are clear and not joined by a straight line."""
    while True:
        world = world_of(file, robot, rng)
        exact = ExactCollision(robot, world.scene)

        def clear(q: ndarray, exact: ExactCollision = exact) -> bool:
            wanted = {name: 0.005 for name in robot.link_names}
            return all(d.distance > wanted.get(str(d.other), CLEAR) for d in exact.distances(q))

        for start in draw(robot, rng, 20):
            turned = start + rng.uniform(-TURN, TURN, robot.dof)
            goal = np.clip(turned, robot.lower, robot.upper)
            line = start + np.linspace(0, 1, 100)[:, None] * (goal - start)
            if clear(start) and clear(goal) and exact.collides(line).any():
                yield world, rd.Problem(robot, world.scene, start, goal)
                break


def executed(world: World, robot: Robot, motion: rd.Trajectory) -> tuple[set[tuple[str, str]], float]:
    """The pairs of bodies with unexpected contacts while MuJoCo executes a motion, and the largest error of a
    joint on the way [rad]."""
    model, data = world.model, world.data
    mujoco.mj_resetData(model, data)
    world.place(robot, motion.positions[0])
    drives = [model.actuator(f"drive {name}").id for name in robot.joint_names]
    for name, value in robot.locked.items():
        data.ctrl[model.actuator(f"drive {name}").id] = value
    addresses = [int(model.joint(name).qposadr[0]) for name in robot.joint_names]
    touched: set[tuple[str, str]] = set()
    worst = 0.0
    rows = motion.resample(1 / TIME_STEP)
    for q, v in zip(rows.positions, rows.velocities, strict=True):
        data.ctrl[drives] = q + v * DAMPING / STIFFNESS  # compensates the lag by the actuators' damping
        mujoco.mj_step(model, data)
        touched |= {(a, b) for a, b, distance in world.contacts(robot) if distance < 0}
        worst = max(worst, float(np.abs(data.qpos[addresses] - q).max()))
    return touched, worst


def main() -> None:
    parser = argparse.ArgumentParser(description="Robots from MuJoCo models beside MuJoCo.")
    parser.add_argument("models", nargs="*", type=Path, help="MJCF files (that of the example)")
    parser.add_argument("--prepared", type=Path, help="folder that keeps the prepared robots")
    parser.add_argument(
        "--configurations", type=int, default=1000, help="number of random configurations (1000)"
    )
    parser.add_argument(
        "--motions", type=int, default=40, help="number of problems that are planned and executed (40)"
    )
    arguments = parse(parser, configurations=20, motions=2)
    print(header("mujoco", "coal"))
    use_processor_time()
    rows = []
    notes = []
    with TemporaryDirectory() as scratch:
        folder = arguments.prepared or Path(scratch)
        for file in arguments.models or [EXAMPLE]:
            name = file.parent.name if file.stem in ("robot", "scene") else file.stem
            robot_folder = folder / name
            robot = (
                rd.load_robot(robot_folder)
                if robot_folder.exists()
                else add_robot(file, out=robot_folder, settings=QUICK if arguments.smoke else None).robot
            )
            rng = np.random.default_rng(SEED)
            world = world_of(file, robot, rng)
            configurations = draw(robot, rng, arguments.configurations)
            error = frame_error(world, robot, configurations)
            hits, missed, extra = disagreements(world, robot, configurations)
            solved = unexpected = 0
            lag = 0.0
            times: list[float] = []
            for world, problem in progress(list(islice(problems(file, robot, rng), arguments.motions)), name):
                result = rd.plan(problem, time_limit=TIME_LIMIT, until=FIRST)
                if result.trajectory is None:
                    notes.append(f"{name}: {result.reason}")
                    continue
                solved += 1
                touched, off = executed(world, robot, result.trajectory)
                unexpected += bool(touched)
                notes += [f"{name}: contact of {a} and {b}" for a, b in touched]
                times.append(result.planning_time)
                lag = max(lag, off)
            rows.append(
                [
                    name,
                    str(robot.dof),
                    f"{error:.0e}",
                    str(hits),
                    str(missed),
                    str(extra),
                    f"{solved} of {arguments.motions}",
                    f"{1e3 * np.median(times):.0f}",
                    str(unexpected),
                    f"{1e3 * lag:.1f}",
                ]
            )
    columns = ["model", "joints", "frames", "contacts", "missed", "extra"]
    columns += ["solved", "CPU ms", "touched", "lag mrad"]
    explanation = (
        f"frames: largest difference from MuJoCo's at {arguments.configurations} configurations. contacts: "
        f"configurations in collision by MuJoCo; missed, extra: deeper than {1e3 * DEPTH:g} mm by MuJoCo "
        "alone, by RobotDiffuse alone. CPU: until the first motion, median. touched: motions during which "
        "MuJoCo has an unexpected contact; lag: the largest error of a joint on the way."
    )
    print_table("MuJoCo models", columns, rows, (explanation, *notes))


if __name__ == "__main__":
    main()
