"""Make motions, train the diffusion model on them, and plan with the new network under guidance.

So few motions and samples do not make a good network: the bundled network was trained on 31,000 motions.
"""

import robotdiffuse as rd
from robotdiffuse.cli import main
from robotdiffuse.visualization.picture import write_picture

if __name__ == "__main__":  # worker processes import this file again
    data = ["--out", "own/data", "--trajectories", "64", "--shard", "32", "--mix", "rop=0.5,shelf=0.5"]
    assert main(["data", "generate", *data, "--planner", "aorrtc", "--workers", "1"]) == 0

    network = ["--data", "own/data", "--encoder", "pointnet", "--samples", "2000"]
    assert main(["train", "planner", *network, "--out", "own/network"]) == 0

    problem = rd.Problem(
        robot=rd.load_robot("panda"),
        scene=rd.Scene([rd.Sphere([0.5, 0.0, 0.5], 0.1)]),
        start=[-1.0, 0.3, 0.0, -1.8, 0.0, 2.1, 0.8],
        goal=[1.0, 0.3, 0.0, -1.8, 0.0, 2.1, 0.8],
    )
    planner = rd.load_planner("diffusion", weights="own/network")
    result = planner.plan(problem, time_limit=10.0)
    print(result.status.value, result.reason)
    write_picture(problem.robot, problem.scene, result.trajectory, "12_train_on_own_data.png")
