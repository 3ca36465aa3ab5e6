"""Motion radii: never below the true maxima, and close to them."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from helpers.example_robots import TIPS, example_robot
from robotdiffuse.learning.training.losses import ForwardKinematics
from robotdiffuse.robots.motion_bounds import motion_radii
from robotdiffuse.robots.robot import Robot


def with_spheres(robot: Robot) -> Robot:
    """The robot with three random spheres on each link but the second, which has none."""
    rng = np.random.default_rng(5)
    links = [link for link in robot.link_names if link != robot.link_names[1]]
    spheres = {
        link: np.hstack([rng.uniform(-0.1, 0.1, (3, 3)), rng.uniform(0, 0.05, (3, 1))]) for link in links
    }
    return replace(robot, spheres=spheres)


def sampled_radii(robot: Robot, count: int) -> np.ndarray:
    """Largest distances over random configurations, many of them with joints at a limit."""
    rng = np.random.default_rng(1)
    q = rng.uniform(robot.lower, robot.upper, (count, robot.dof))
    q = np.where(rng.random(q.shape) < 0.3, np.where(rng.random(q.shape) < 0.5, robot.lower, robot.upper), q)
    frames = ForwardKinematics(robot, torch.float64)(torch.tensor(q)).numpy()
    out = np.zeros((len(robot.spheres), robot.dof))
    for i, link in enumerate(link for link in robot.link_names if link in robot.spheres):
        last = robot.link_frame(link)
        T_base_link = frames[:, last] @ robot.T_frame_link(link)
        spheres = robot.spheres[link]
        points = (
            np.einsum("nik,sk->nsi", T_base_link[:, :3, :3], spheres[:, :3]) + T_base_link[:, None, :3, 3]
        )
        for j in robot.chain(link):
            axis = frames[:, j + 1, :3, 2]
            origin = frames[:, j + 1, :3, 3]
            lever = np.linalg.norm(np.cross(axis[:, None], points - origin[:, None]), axis=-1)
            out[i, j] = 1.0 if robot.prismatic[j] else (lever + spheres[:, 3]).max()
    return out


@pytest.mark.parametrize("name", TIPS)
def test_never_below_and_close_to_sampled_maxima(name: str) -> None:
    robot = with_spheres(example_robot(name))
    radii = motion_radii(robot)
    sampled = sampled_radii(robot, 20_000)
    assert (radii >= sampled).all()
    assert ((radii > 0) == (sampled > 0)).all()
    # the bound itself is within 1 %; the rest is the gap between sampled and true maxima
    assert (radii <= 1.04 * sampled + 1e-3).all()
