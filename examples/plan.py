"""Plan around a ball and save the motion."""

import robotdiffuse as rd

problem = rd.Problem(
    robot=rd.load_robot("panda"),
    scene=rd.Scene([rd.Sphere([0.5, 0.0, 0.5], 0.2)]),
    start=[-1.0, 0.3, 0.0, -1.8, 0.0, 2.1, 0.8],
    goal=[1.0, 0.3, 0.0, -1.8, 0.0, 2.1, 0.8],
)
result = rd.plan(problem, time_limit=10.0)
print(result.status.value, result.reason)
if result.solved:
    result.trajectory.save("motion.csv")
