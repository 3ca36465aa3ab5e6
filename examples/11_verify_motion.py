"""Validates a motion of another planner, from CSV, between its waypoints too; certifies a motion of our
own."""

import numpy as np

import robotdiffuse as rd
from robotdiffuse.visualization.picture import write_picture

robot = rd.load_robot("panda")
start = [-1.0, 0.3, 0.0, -1.8, 0.0, 2.1, 0.8]
goal = [1.0, 0.3, 0.0, -1.8, 0.0, 2.1, 0.8]
problem = rd.Problem(
    robot, rd.Scene([rd.Box([0.55, 0.0, 0.55], [0.5, 0.01, 0.5], name="sheet")]), start, goal
)

# In place of the other planner: waypoints on a straight line, none of which is near the thin sheet.
waypoints = np.linspace(start, goal, 4)
np.savetxt("theirs.csv", waypoints, delimiter=",", header=",".join(robot.joint_names), comments="")

theirs = rd.Path(robot.joint_names, np.loadtxt("theirs.csv", delimiter=",", skiprows=1))
report = rd.verify(problem, theirs)
print("theirs:", "valid" if report.valid else report.violation.message if report.violation else "not valid")

ours = rd.plan(problem, time_limit=10.0).trajectory
certificate = rd.certify(problem, ours)
certificate.save("certificate.json")
print("ours: valid; the certificate holds:", certificate.check(problem).valid)
write_picture(robot, problem.scene, theirs, "11_verify_motion.png")
