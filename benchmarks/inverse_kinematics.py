"""Inverse kinematics of the Panda: share solved, exactness and time, on one core.

    python benchmarks/inverse_kinematics.py [--poses 1000]

Prints the report that is kept in benchmarks/results/inverse_kinematics.txt. Poses are those of panda_hand
at configurations drawn uniformly within the limits. Errors are measured by NumPy kinematics.
"""

import argparse
import time

import numpy as np
from report import header

from robotdiffuse.core.transforms import rotation_angle, transform
from robotdiffuse.robots import load_robot
from robotdiffuse.robots.inverse_kinematics import InverseKinematicsSettings, inverse_kinematics
from robotdiffuse.robots.kinematics import link_pose

FRAME = "panda_hand"


def main() -> None:
    parser = argparse.ArgumentParser(description="Share solved, exactness and time of inverse kinematics.")
    parser.add_argument("--poses", type=int, default=1000)
    poses = parser.parse_args().poses
    robot, rng = load_robot("panda"), np.random.default_rng(0)
    print(header("numpy", "numba"))

    start = time.perf_counter()
    inverse_kinematics(robot, FRAME, transform(np.array([0.4, 0.0, 0.4])), rng=rng)
    print(f"first call (compiled, or read from the cache): {time.perf_counter() - start:.2f} s")

    targets = [link_pose(robot, rng.uniform(robot.lower, robot.upper), FRAME) for _ in range(poses)]
    for what, count, settings in (
        ("pose, 1 solution", 1, InverseKinematicsSettings()),
        ("pose, 10 distinct solutions", 10, InverseKinematicsSettings()),
        ("position only, 10 distinct solutions", 10, InverseKinematicsSettings(position_only=True)),
    ):
        milliseconds, found, position, rotation, gap = [], [], 0.0, 0.0, np.inf
        for T in targets:
            start = time.perf_counter()
            solutions = inverse_kinematics(robot, FRAME, T, count, rng=rng, settings=settings)
            milliseconds.append(1e3 * (time.perf_counter() - start))
            found.append(len(solutions))
            assert ((solutions > robot.lower) & (solutions < robot.upper)).all()
            for i, q in enumerate(solutions):
                reached = link_pose(robot, q, FRAME)
                position = max(position, float(np.linalg.norm(reached[:3, 3] - T[:3, 3])))
                rotation = max(rotation, rotation_angle(reached[:3, :3] @ T[:3, :3].T))
                gap = min(gap, np.abs(solutions[:i] - q).max(-1).min(initial=np.inf))
        counts, times = np.array(found), np.array(milliseconds)
        print(
            f"{what}: {(counts > 0).mean():.2%} of {poses} solved, all {count} found for"
            f" {(counts == count).mean():.1%}; median {np.median(times):.3f} ms, p95"
            f" {np.percentile(times, 95):.3f} ms, max {times.max():.2f} ms; largest error {position:.1e} m"
            + ("" if settings.position_only else f", {rotation:.1e} rad")
            + (f"; least difference {gap:.3f} rad" if count > 1 else "")
        )
    for what, xyz in (("far", (2.0, 0.0, 0.5)), ("just out of reach", (0.9, 0.0, 0.6))):
        start = time.perf_counter()
        found = len(inverse_kinematics(robot, FRAME, transform(np.array(xyz)), rng=rng))
        print(
            f"unreachable ({what}): {found} found, given up in {1e3 * (time.perf_counter() - start):.1f} ms"
        )


if __name__ == "__main__":
    main()
