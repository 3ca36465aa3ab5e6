"""The inputs of a network trained for the bare arm, when the arm holds something."""

import numpy as np
import pytest

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.core.transforms import transform
from robotdiffuse.learning.motion_model import MAX_CLEARANCE, MotionModelSettings, link_clearances
from robotdiffuse.learning.weight_files import RobotIdentity
from robotdiffuse.robots import load_robot
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import Box, Sphere

PANDA = load_robot("panda")
ROD = Box([0, 0, 0.3], [0.05, 0.05, 0.4], name="rod")
HELD = {
    "panda_hand": PANDA.attach(ROD, "panda_hand"),
    "panda_rightfinger": PANDA.with_tool("panda_link8", transform(np.zeros(3))).attach(ROD, "tool"),
    "panda_link4": PANDA.attach(ROD, "panda_link4"),
}
"""By the link that counts as carrying it: without geometry of its own, the last that moves as it does."""


@pytest.mark.parametrize("carrier", HELD)
@pytest.mark.parametrize("clearance_gradients", [False, True])
def test_a_held_object_counts_as_a_part_of_what_carries_it(carrier: str, clearance_gradients: bool) -> None:
    held = HELD[carrier]
    settings = MotionModelSettings(clearance_gradients=clearance_gradients)
    scene = Scene([Sphere([0.5, 0.0, 0.1], 0.1)])
    q = np.random.default_rng(0).uniform(PANDA.lower, PANDA.upper, (4, 5, 7)).astype(np.float32)
    checkers = CollisionChecker(PANDA, scene), CollisionChecker(held, scene)
    bare, carrying = (link_clearances(checker, settings)(q) for checker in checkers)
    assert bare.shape == carrying.shape, "the network was trained for the bare arm"
    links = checkers[0].links
    own = checkers[1]
    rod = own.link_clearances(q.reshape(-1, 7), MAX_CLEARANCE)[:, own.links.index("rod")]
    at = links.index(carrier)
    expected = bare[..., : len(links)].copy()
    expected[..., at] = np.minimum(expected[..., at], rod.reshape(4, 5))
    np.testing.assert_allclose(carrying[..., : len(links)], expected, atol=1e-6)
    assert (expected[..., at] < bare[..., at]).any(), "the rod is nearer somewhere"
    assert not RobotIdentity.of(PANDA).difference(held)
