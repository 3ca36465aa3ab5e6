"""What a data set is made of."""

from dataclasses import dataclass, field

from robotdiffuse.errors import InputError, unknown_name
from robotdiffuse.planners.shared_tree.planner import SharedTreeSettings
from robotdiffuse.problems.families import FAMILIES, Family, load_family
from robotdiffuse.problems.families.family import POSE, POSITION

TARGETS = (POSITION, POSE)
TIMINGS = ("arc", "time")


@dataclass(frozen=True)
class GenerationSettings:
    """The same settings give the same data, whatever the number of workers and of interruptions."""

    robot: str = "panda"
    """Bundled name, or path to a URDF."""
    trajectories: int = 140_000
    """Solved and verified motions to make, each in a scene of its own (the paper: 0.14 million)."""
    seed: int = 0
    mix: dict[str, float] = field(default_factory=lambda: {"rop": 1.0})
    """Shares of problems by family of scenes, in any unit; the default is the paper's. Rows of the data hold
    the number of their family in this order."""
    trivial_share: float = 1.0
    """Share that is kept of the problems that the straight line solves; 1 is the paper's distribution."""
    target: str = POSITION
    """What is given of the tip's goal: its position alone, as in the paper, or the whole pose. Among
    furniture it is always the pose, with the fingers in a compartment, say."""
    goals: int = 10
    """Most goal configurations of a target, found by inverse kinematics (the paper's k)."""
    frames: int = 254
    """Frames of a trajectory (the authors' number)."""
    timing: str = "arc"
    """How frames are spaced: evenly in joint-space length (arc), or in time by toppra (time)."""
    shard: int = 500
    """Trajectories in a shard: what an interruption may lose."""
    search: SharedTreeSettings = field(
        default=SharedTreeSettings(
            resolution=0.02, improvement=0.01, patience=6, step_rounds=5, connect_iterations=800
        )
    )
    """How problems are solved: quicker than a user's default, at 1 % more length."""

    def __post_init__(self) -> None:
        for name, least in (("trajectories", 1), ("seed", 0), ("goals", 1), ("frames", 2), ("shard", 1)):
            if getattr(self, name) < least:
                raise InputError(f"{name} is {getattr(self, name)}; it must be at least {least}")
        for name, share in self.mix.items():
            if name not in FAMILIES:
                raise unknown_name("family of scenes in mix", name, FAMILIES)
            if not 0 < share < float("inf"):
                raise InputError(f"mix: the share of {name} is {share}; it must be positive")
        if not self.mix:
            raise InputError(f"mix is empty; it must name a family: {', '.join(FAMILIES)}")
        if not 0 <= self.trivial_share <= 1:
            raise InputError(f"trivial_share is {self.trivial_share}; it must be between 0 and 1")
        if self.target not in TARGETS:
            raise unknown_name("target", self.target, TARGETS)
        if self.timing not in TIMINGS:
            raise unknown_name("timing", self.timing, TIMINGS)
        if self.goals > 127:
            raise InputError(f"goals is {self.goals}; it must be at most 127")

    @property
    def families(self) -> dict[str, Family]:
        """Those of the mix, in its order."""
        return {name: load_family(name) for name in self.mix}

    @property
    def slots(self) -> int:
        """Most obstacles of a scene, the floor left out."""
        return max(family.most_obstacles for family in self.families.values())

    @property
    def shards(self) -> int:
        return -(-self.trajectories // self.shard)

    def rows(self, index: int) -> int:
        """Trajectories of a shard: all have as many, but the last may have fewer."""
        return min(self.shard, self.trajectories - index * self.shard)
