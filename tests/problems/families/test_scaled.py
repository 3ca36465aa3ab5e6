"""Families in the size of an arm: as they are for arms like a Panda, stretched for others."""

import numpy as np
import pytest

from robotdiffuse import Scene, load_robot
from robotdiffuse.collision import CollisionChecker
from robotdiffuse.problems.families import FAMILIES, load_family
from robotdiffuse.problems.families.family import POSE
from robotdiffuse.problems.families.scaled import ScaledFamily, family_for, scale_for
from robotdiffuse.robots.kinematics import link_pose, reach
from robotdiffuse.robots.robot import scaled
from robotdiffuse.scenes.scene_arrays import PackedScenes

SMALL, EMPTY = load_robot("so101"), Scene([])


@pytest.mark.parametrize("name", ["panda", "ur5e", "xarm7"])
def test_arms_like_a_panda_get_families_as_they_are(name: str) -> None:
    robot = load_robot(name)
    assert scale_for(robot) == 1.0 and family_for("shelf", robot) is load_family("shelf")


def test_a_scaled_arm_reaches_so_many_times_as_far_and_touches_itself_at_the_same_angles() -> None:
    robot = load_robot("ur5e")
    large = scaled(robot, 1.5)
    assert reach(large) == pytest.approx(1.5 * reach(robot), rel=1e-9)
    q = np.random.default_rng(0).uniform(robot.lower, robot.upper, (200, robot.dof))
    one, other = (CollisionChecker(arm, scene) for arm, scene in ((robot, EMPTY), (large, EMPTY)))
    expected = np.minimum(1.5 * one.pair_clearances(q), 1.0)  # distances are capped at a meter
    np.testing.assert_allclose(other.pair_clearances(q), expected, atol=1e-5)


@pytest.mark.parametrize("name", FAMILIES)
def test_problems_of_an_arm_of_five_joints_and_a_third_of_the_reach(name: str) -> None:
    """Only ROP left it problems once: furniture was out of reach, and of poses it reaches few."""
    family = family_for(name, SMALL)
    assert isinstance(family, ScaledFamily) and family.scale == 0.4
    drawn = family.draw(SMALL, np.random.default_rng(3), 2, POSE)
    q = np.concatenate([drawn.start[None], drawn.goals]).astype(np.float64)
    assert CollisionChecker(SMALL, drawn.scene).free(q).all()
    tips = np.array([link_pose(SMALL, row, SMALL.tip)[:3, 3] for row in q])
    assert ((tips >= family.region[0]) & (tips <= family.region[1])).all()
    np.testing.assert_allclose(tips[1:], [drawn.T_base_tip[:3, 3]] * len(drawn.goals), atol=1e-5)
    floor = family.floor
    theirs = load_family(name).floor
    assert floor is not None and theirs is not None
    np.testing.assert_array_equal(floor.size, 0.4 * theirs.size)
    np.testing.assert_array_equal(drawn.scene.shapes[0].bounds, floor.bounds)
    PackedScenes.pack([drawn.scene], family.max_obstacles, floor=True)
