"""Settings of data generation."""

from dataclasses import dataclass, field
from typing import Annotated

from robotdiffuse.core.errors import InputError, unknown_name
from robotdiffuse.core.settings import Bound, Count, Natural, OneOf, Settings, SettingsOf, Share
from robotdiffuse.generation.aorrtc_solver import AORRTCSearchSettings
from robotdiffuse.generation.solvers import SEARCHES
from robotdiffuse.planning.search.shared_tree import SharedTreeSettings
from robotdiffuse.problems.families import FAMILIES
from robotdiffuse.problems.families.family import POSE, POSITION, Family
from robotdiffuse.problems.families.scaled import family_for
from robotdiffuse.robots import load_robot

TARGETS = (POSITION, POSE)
TIMINGS = ("arc", "time")


@dataclass(frozen=True)
class GenerationSettings(Settings):
    """Settings of a data set. The same settings give the same data, for any number of workers and
    interruptions."""

    robot: str = "panda"
    """Bundled name, or path to a URDF."""
    trajectories: Count = 140_000
    """Solved and verified motions to make, each in a scene of its own (the paper: 0.14 million)."""
    seed: Natural = 0
    mix: dict[str, float] = field(default_factory=lambda: {"rop": 1.0})
    """Relative shares of problems by family of scenes; the default is the paper's. Rows of the data hold the
    number of their family in this order."""
    trivial_share: Share = 1.0
    """Share of the problems solved by the straight line that is kept; 1 is the paper's distribution."""
    target: Annotated[str, OneOf(TARGETS)] = POSITION
    """Goal of the tip: its position alone, as in the paper, or its pose. Among furniture it is always the
    pose, such as with the fingers in a compartment."""
    goals: Annotated[int, Bound(least=1.0, most=127.0)] = 10
    """Most goal configurations of a target, found by inverse kinematics (the paper's k)."""
    waypoints: Annotated[int, Bound(least=2.0)] = 254
    """Waypoints of a trajectory (the authors' number)."""
    timing: Annotated[str, OneOf(TIMINGS)] = "arc"
    """Spacing of waypoints: evenly in joint-space length (arc), or in time by time parameterization
    (time)."""
    shard: Count = 500
    """Trajectories in a shard, the most that an interruption loses."""
    planner: Annotated[str, OneOf(SEARCHES)] = "shared_tree_rrt_star"
    """Planner that solves the problems; the default is the paper's."""
    search: Annotated[SharedTreeSettings | AORRTCSearchSettings, SettingsOf("planner", SEARCHES)] = field(
        default=SharedTreeSettings(
            resolution=0.02, improvement=0.01, patience=6, step_rounds=5, connect_iterations=800
        )
    )
    """Settings of that planner; for the paper's planner faster than its defaults, at 1 % more length."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, share in self.mix.items():
            if name not in FAMILIES:
                raise unknown_name("family of scenes in mix", name, FAMILIES)
            if not 0 < share < float("inf"):
                raise InputError(f"mix: the share of {name} is {share}; it must be positive")
        if not self.mix:
            raise InputError(f"mix is empty; it must name a family: {', '.join(FAMILIES)}")

    @property
    def families(self) -> dict[str, Family]:
        """The families of the mix, in its order and scaled to the robot."""
        robot = load_robot(self.robot)
        return {name: family_for(name, robot) for name in self.mix}

    @property
    def slots(self) -> int:
        """Most obstacles of a scene, without the floor."""
        return max(family.max_obstacles for family in self.families.values())

    @property
    def shards(self) -> int:
        return -(-self.trajectories // self.shard)

    def rows(self, index: int) -> int:
        """Trajectories of a shard; the last shard may have fewer."""
        return min(self.shard, self.trajectories - index * self.shard)
