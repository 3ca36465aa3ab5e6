"""The networks of the learned baselines by name. A new one is one file and one line in NETWORKS."""

from importlib import import_module
from typing import TYPE_CHECKING, NamedTuple

from robotdiffuse.errors import unknown_name

if TYPE_CHECKING:
    from robotdiffuse.learning.networks.base import BaselineNetwork


class Entry(NamedTuple):
    location: str
    """module:class of the network."""
    description: str


_ROOM = "robotdiffuse.learning.networks."
NETWORKS = {
    "mpnet": Entry(_ROOM + "mpnet:MPNetNetwork", "MPNet: the next configuration on the way to the goal"),
    "mpinets": Entry(
        _ROOM + "mpinets:MPiNetsNetwork", "MPiNets: a policy that sees points of scene, arm and target"
    ),
    "trajectory_prior": Entry(
        _ROOM + "trajectory_prior:TrajectoryPrior",
        "unconditional diffusion of trajectories, for MPD and EDMP",
    ),
}


def check_network(name: str) -> None:
    """Raises InputError, listing the known networks, for an unknown name."""
    if name not in NETWORKS:
        raise unknown_name("baseline", name, NETWORKS)


def network_class(name: str) -> "type[BaselineNetwork]":
    """The class of a network."""
    check_network(name)
    module, _, found = NETWORKS[name].location.partition(":")
    return getattr(import_module(module), found)
