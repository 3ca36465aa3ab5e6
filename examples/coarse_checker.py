"""Motions of a planner that checks waypoints and little between them, validated; what passes is certified."""

import numpy as np
from ompl import base as ob
from ompl import geometric as og
from ompl import util as ou

import robotdiffuse as rd
from robotdiffuse.collision.exact_meshes import ExactCollision

ou.setLogLevel(ou.LOG_NONE)
problem = rd.Problem(
    robot=rd.load_robot("panda"),
    scene=rd.Scene([rd.Box([0.55, 0.0, 0.55], [0.5, 0.01, 0.5], name="sheet")]),
    start=[-1.0, 0.3, 0.0, -1.8, 0.0, 2.1, 0.8],
    goal=[1.0, 0.3, 0.0, -1.8, 0.0, 2.1, 0.8],
)
robot, exact = problem.robot, ExactCollision(problem.robot, problem.scene)


def plan(seed: int) -> rd.Path:
    """By RRT-Connect of OMPL; motions are checked every 3 % of the space's extent (by default 1 %)."""
    ou.RNG.setSeed(seed + 1)
    space = ob.RealVectorStateSpace(robot.dof)
    bounds = ob.RealVectorBounds(robot.dof)
    for j in range(robot.dof):
        bounds.setLow(j, robot.lower[j])
        bounds.setHigh(j, robot.upper[j])
    space.setBounds(bounds)
    setup = og.SimpleSetup(space)
    free = lambda state: not exact.collides(np.array([[state[j] for j in range(robot.dof)]]))[0]  # noqa: E731
    setup.setStateValidityChecker(free)
    setup.getSpaceInformation().setStateValidityCheckingResolution(0.03)
    start, goal = space.allocState(), space.allocState()
    assert isinstance(problem.goal, rd.JointGoal)
    for state, q in ((start, problem.start), (goal, problem.goal.positions[0])):
        for j in range(robot.dof):
            state[j] = q[j]  # pyright: ignore[reportIndexIssue]
    setup.setStartAndGoalStates(start, goal)
    setup.setPlanner(og.RRTConnect(setup.getSpaceInformation()))
    assert setup.solve(5.0)
    states = setup.getSolutionPath().getStates()
    return rd.Path(robot.joint_names, np.array([[s[j] for j in range(robot.dof)] for s in states]))  # pyright: ignore


for seed in range(10):
    path = plan(seed)
    report = rd.verify(problem, path)
    if report.violation is not None:
        waypoints = "no waypoint" if not exact.collides(path.positions).any() else "a waypoint"
        print(f"{seed}: {waypoints} collides, but {report.violation.message} at {report.violation.time:.2f}")
    else:
        certificate = rd.certify(problem, path)
        print(f"{seed}: valid; the certificate holds: {certificate.check().valid}")
