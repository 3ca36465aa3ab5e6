"""Data generation into a folder of shards: draws random problems, solves and validates them, on this machine
or on a Ray cluster.

The content of a shard depends only on the settings and on the shard's number.
"""

import json
import platform
from contextlib import closing
from dataclasses import asdict, dataclass, field, replace
from importlib.metadata import version
from pathlib import Path as FilePath
from typing import Annotated, Any

import numpy as np
from numpy import ndarray

from robotdiffuse import __version__
from robotdiffuse.collision import CollisionChecker
from robotdiffuse.collision.kernels.motions import motions_free
from robotdiffuse.collision.kernels.random import random_state
from robotdiffuse.collision.motions import search_space
from robotdiffuse.core.errors import InputError, check_name, needs
from robotdiffuse.core.files import lock_folder
from robotdiffuse.core.registry import Entry, Registry
from robotdiffuse.core.settings import (
    AtLeastTwo,
    Bound,
    Count,
    Natural,
    OneOf,
    Settings,
    SettingsOf,
    Share,
)
from robotdiffuse.core.types import Configurations, Done, Path, interpolated, unreported
from robotdiffuse.datasets.shards import (
    MANIFEST,
    Arrays,
    Counts,
    Manifest,
    Row,
    read_manifest,
    remove_leftovers,
    resample,
    row_of,
    shard_indices,
    write_manifest,
    write_shard,
)
from robotdiffuse.generation.aorrtc_solver import AORRTCSearch, AORRTCSearchSettings
from robotdiffuse.planning.search.shared_tree import SharedTreeSearch, SharedTreeSettings
from robotdiffuse.problems.families import FAMILIES
from robotdiffuse.problems.families.family import POSE, POSITION, Family, SampledProblem
from robotdiffuse.problems.families.scaled import family_for
from robotdiffuse.processes.workers import CLUSTERS, Results, on_this_machine
from robotdiffuse.robots import load_robot, names_a_file
from robotdiffuse.robots.robot import Robot, robot_fingerprint
from robotdiffuse.scenes.packed_scenes import PackedScenes
from robotdiffuse.trajectories.timing import time_parameterize
from robotdiffuse.validation.validator import Verifier, VerifySettings

PACKAGES = ("numpy", "numba", "zarr")
"""Names of the packages on whose versions the data depend."""
SEARCHES = Registry(
    "planner of data",
    {
        "shared_tree_rrt_star": Entry(
            "robotdiffuse.planning.search.shared_tree:SharedTreeSearch",
            "the paper's: one tree towards all goals of a target; stores the cost of each goal",
            "SharedTreeSettings",
        ),
        "aorrtc": Entry(
            "robotdiffuse.generation.aorrtc_solver:AORRTCSearch",
            "equally short paths in less time; stores the cost of one goal",
            "AORRTCSearchSettings",
        ),
    },
)
"""Searches that solve the problems of data sets, by name."""
TARGETS = (POSITION, POSE)
TIMINGS = ("arc", "time")


@dataclass(frozen=True)
class GenerationSettings(Settings):
    """Settings of a data set. The same settings give the same data, for any number of workers and
    interruptions."""

    robot: str = "panda"
    """Name of a bundled robot, or path to a URDF."""
    trajectories: Count = 140_000
    """Number of solved and validated motions, each in its own scene (the paper: 0.14 million)."""
    seed: Natural = 0
    mix: dict[str, float] = field(default_factory=lambda: {"rop": 1.0})
    """Relative number of problems of each family of scenes; the default is the paper's. A row of the data
    contains the index of its family in this mapping."""
    trivial_share: Share = 1.0
    """Probability that a trivial problem, which a straight line solves, is used; 1 is the paper's
    distribution."""
    target: Annotated[str, OneOf(TARGETS)] = POSITION
    """Whether a target is a position of the tip, as in the paper, or a pose. Families of furniture always use
    the pose. Arms with fewer than six joints always reach the position only."""
    goals: Annotated[int, Bound(least=1.0, most=127.0)] = 10
    """Largest number of goal configurations of a target, found by inverse kinematics (the paper's k)."""
    waypoints: AtLeastTwo = 254
    """Number of waypoints of a trajectory (the authors' number)."""
    timing: Annotated[str, OneOf(TIMINGS)] = "arc"
    """Spacing of waypoints: evenly in joint-space length (arc), or in time by time parameterization
    (time)."""
    shard: Count = 500
    """Number of trajectories in a shard. An interruption loses only the shards that are being made."""
    planner: Annotated[str, OneOf(SEARCHES)] = "shared_tree_rrt_star"
    """Planner that solves the problems; the default is the paper's."""
    search: Annotated[SharedTreeSettings | AORRTCSearchSettings, SettingsOf("planner", SEARCHES)] = field(
        default=SharedTreeSettings(
            resolution=0.02, improvement=0.01, patience=6, step_rounds=5, connect_iterations=800
        )
    )
    """Settings of the planner. The default of this field makes the paper's planner faster than the planner's
    own defaults do, at the cost of paths that are 1 % longer."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, share in self.mix.items():
            check_name("family of scenes in mix", name, FAMILIES)
            if not 0 < share <= 1e9:
                raise InputError(f"mix: the share of {name} is {share}; it must be above 0, at most 1e9")
        if not self.mix:
            raise InputError(f"mix is empty; it must name a family: {', '.join(FAMILIES)}")

    @property
    def families(self) -> dict[str, Family]:
        """The families of the mix, in its order and scaled to the robot."""
        robot = load_robot(self.robot)
        return {name: family_for(name, robot) for name in self.mix}

    @property
    def slots(self) -> int:
        """Largest number of obstacles of a scene, without the floor."""
        return max(family.max_obstacles for family in self.families.values())

    @property
    def shards(self) -> int:
        return -(-self.trajectories // self.shard)

    def rows(self, index: int) -> int:
        """Number of trajectories in a shard; the last shard may have fewer than `shard`."""
        return min(self.shard, self.trajectories - index * self.shard)


# One shard

MAX_PROBLEMS_PER_ROW = 50
EXTRA_PROBLEMS = 1_000
"""A shard with n rows fails after MAX_PROBLEMS_PER_ROW * n + EXTRA_PROBLEMS problems."""
PROBLEMS_PER_SHARD = 2**32
"""Problem numbers reserved for each shard, so that no two shards contain the same problem."""


def make_shard(settings: GenerationSettings, index: int) -> tuple[Arrays, Counts]:
    """Arrays and counts of a shard in the form of `datasets.shards`.

    The counts are numbers of problems: `tried`: all; `solved`: those in the shard; `thinned`: trivial ones
    that were left out; `unsolved`: those without a path; `refused`: those whose motions the validator
    rejected. Raises InputError if hardly any problem can be used.
    """
    robot = load_robot(settings.robot)
    rows = settings.rows(index)
    solved_rows = list[Row]()
    counts: Counts = dict.fromkeys(("tried", "solved", "thinned", "unsolved", "refused"), 0)
    while len(solved_rows) < rows:
        if counts["tried"] >= MAX_PROBLEMS_PER_ROW * rows + EXTRA_PROBLEMS:
            raise InputError(
                f"only {len(solved_rows)} of {counts['tried']} problems gave a motion for {robot.name}; try "
                f"trivial_share 1, other scenes or safety_distance below {settings.search.safety_distance} m"
            )
        number = index * PROBLEMS_PER_SHARD + counts["tried"]
        counts["tried"] += 1
        row = solve(settings, robot, number)
        if isinstance(row, str):
            counts[row] += 1
        else:
            solved_rows.append(row)
            counts["solved"] += 1
    return {name: np.stack([row[name] for row in solved_rows]) for name in solved_rows[0]}, counts


def solve(settings: GenerationSettings, robot: Robot, number: int) -> Row | str:
    """Solve the problem with a number. Returns its row, or "thinned", "unsolved" or "refused"."""
    rng = np.random.default_rng([settings.seed, number])
    family, sample = draw(settings, robot, rng)
    # joints that can turn by more than one turn are turned as near to the start as possible
    goals = robot.nearest_turns(sample.goals, sample.start)
    sample = replace(sample, goals=goals)
    checker = CollisionChecker(robot, sample.scene)
    space = search_space(checker, settings.search.resolution)
    lines_free = [bool(motions_free(space, np.stack([sample.start, goal]))[0]) for goal in goals]
    thin_if_trivial = rng.random() >= settings.trivial_share
    if thin_if_trivial and all(lines_free):
        return "thinned"  # trivial, whichever goal a search would choose
    search: SharedTreeSearch | AORRTCSearch = SEARCHES.load(settings.planner)(
        checker, sample.start, sample.goals, settings.search, random_state(settings.seed, number)
    )
    search.run()
    path = search.path()
    if path is None:
        return "unsolved"
    goal = search.goals[search.best_goal]
    line_free = lines_free[search.best_goal]
    if thin_if_trivial and line_free:
        return "thinned"
    validator = Verifier(sample.problem(robot), VerifySettings())
    motion = _resampled(settings, robot, path, validator)
    if motion is None:
        return "refused"
    times, q = motion
    q[0] = sample.start
    q[-1] = goal
    if not validator.path(Path(robot.joint_names, q.astype(np.float64))).valid:
        return "refused"
    floor = list(settings.families.values())[family].floor
    return row_of(
        PackedScenes.pack([sample.scene], settings.slots, floor is not None),
        q,
        checker.link_clearances(q).min(axis=1),
        search.goals,
        search.goal_costs,
        search.cost,
        sample.T_base_tip,
        settings.goals,
        goal_index=search.best_goal,
        family=family,
        safety_distance=search.safety_distance,
        line_free=line_free,
        seed=number,
        **({"times": times} if settings.timing == "time" else {}),
    )


def draw(settings: GenerationSettings, robot: Robot, rng: np.random.Generator) -> tuple[int, SampledProblem]:
    """The index of a random family in the mix, and a random problem of this family; both depend only on the
    state of `rng`."""
    shares = np.array(list(settings.mix.values()))
    number = int(rng.choice(len(shares), p=shares / shares.sum()))
    family = list(settings.families.values())[number]
    return number, family.draw(robot, rng, settings.goals, settings.target)


def _resampled(
    settings: GenerationSettings, robot: Robot, path: Configurations, validator: Verifier
) -> tuple[ndarray | None, Configurations] | None:
    """Times and joint values of the waypoints. With the timing "arc", the times are None, and nothing is
    validated; with "time", the result is None if the validator rejects the path or the timed motion."""
    if settings.timing == "arc":
        return None, resample(path[None], settings.waypoints)[0]
    waypoints = Path(robot.joint_names, path.astype(np.float64))
    if not validator.path(waypoints).valid:
        return None
    timed = time_parameterize(
        robot, waypoints, lambda motion: validator.trajectory(motion).valid, validator.collision_free
    ).trajectory
    if not validator.trajectory(timed).valid:
        return None
    times = np.linspace(0.0, timed.duration, settings.waypoints)
    return times, interpolated(times, timed.times, timed.positions).astype(np.float32)


# The folder


def generate(
    settings: GenerationSettings,
    out: FilePath,
    workers: int = 1,
    cluster: str | None = None,
    progress: Done = unreported,
) -> int:
    """Make the shards that the folder lacks. Returns the number of trajectories in the whole data set.

    After an interruption at any moment, another call continues. The finished folder is bit for bit that of an
    uninterrupted call with any number of workers. If `cluster` is "ray", the shards are made by the Ray
    cluster that RAY_ADDRESS names, or by a cluster started here. `progress` is called with the number of
    trajectories that are done and the number of all.

    Raises InputError for `workers` below 1 and an unknown cluster, if the folder's data have other settings
    or are of another version or robot, if the folder holds shards without a manifest, cannot be written or is
    being filled by another process, if a node of the cluster has other versions or another robot, and in the
    cases in which `make_shard` raises it.
    """
    if workers < 1:
        raise InputError(f"workers is {workers}; it must be at least 1")
    if cluster is not None:
        check_name("cluster", cluster, CLUSTERS)
    manifest = manifest_of(settings)
    with lock_folder(out):
        try:
            remove_leftovers(out)
            _claim(manifest, out)
            existing = set(shard_indices(out))
            missing = [index for index in range(settings.shards) if index not in existing]
            finished = settings.trajectories - sum(settings.rows(index) for index in missing)
            progress(finished, settings.trajectories)
            # closing the iterator stops the workers at once if the loop is interrupted
            with closing(_shards(settings, missing, workers, cluster)) as shards:
                for number, (arrays, counts) in shards:
                    index = missing[number]
                    write_shard(out, index, arrays, counts)
                    finished += settings.rows(index)
                    progress(finished, settings.trajectories)
        finally:
            remove_leftovers(out)
    return settings.trajectories


def _shards(settings: GenerationSettings, indices: list[int], workers: int, cluster: str | None) -> Results:
    """Yields, for each shard as soon as it is made, the place of its index in `indices` and the shard."""
    if cluster is None or not indices:
        return on_this_machine(make_shard, [(settings, index) for index in indices], workers)
    if names_a_file(settings.robot):  # nodes have other working folders
        settings = replace(settings, robot=str(FilePath(settings.robot).resolve()))
    local_record = _reproducibility_record(settings)
    return CLUSTERS[cluster](_make_on_node, [(settings, index, local_record) for index in indices])


def _make_on_node(settings: GenerationSettings, index: int, wanted: dict[str, str]) -> tuple[Arrays, Counts]:
    for name, actual in _reproducibility_record(settings).items():
        if actual != wanted[name]:
            raise InputError(
                f"a node of the Ray cluster has {name} {actual}, this machine {wanted[name]}; their data may "
                "differ: install the same version on all nodes"
            )
    return make_shard(settings, index)


def _reproducibility_record(settings: GenerationSettings) -> dict[str, str]:
    """Versions and robot fingerprint; machines with equal records generate the same data."""
    return versions() | {f"robot {settings.robot}": robot_fingerprint(load_robot(settings.robot))}


def versions() -> dict[str, str]:
    """Versions of the software that the data depend on."""
    with needs("zarr", "data"):
        packages = {name: version(name) for name in PACKAGES}
    return {"robotdiffuse": __version__, "python": platform.python_version()} | packages


def manifest_of(settings: GenerationSettings) -> Manifest:
    """The manifest of a data set with these settings."""
    return Manifest.of(
        load_robot(settings.robot),
        settings.robot,
        waypoints=settings.waypoints,
        timing=settings.timing,
        families={name: asdict(family) for name, family in settings.families.items()},
        floors={name: family.floor for name, family in settings.families.items()},
        slots=settings.slots,
        goals=settings.goals,
        trajectories=settings.trajectories,
        shard=settings.shard,
        settings=asdict(settings),
        versions=versions(),
    )


def _claim(wanted: Manifest, out: FilePath) -> None:
    """Write the manifest into a new folder. Raise InputError if the folder has a manifest of other data, or
    shards without a manifest."""
    if not (out / MANIFEST).exists():
        if shard_indices(out):
            raise InputError(f"{out} holds shards but no {MANIFEST}; use another folder")
        write_manifest(out, wanted)
        return
    existing = read_manifest(out)
    existing.check_robot(load_robot(wanted.robot))
    begun = _by_name(existing.settings)
    for name, value in _by_name(wanted.settings).items():
        if begun.get(name) != value:
            raise InputError(
                f"{out} was begun with {name} {begun.get(name)}, not {value}; use the same settings, or "
                "another folder"
            )
    for name, value in wanted.versions.items():
        if existing.versions.get(name) != value:
            raise InputError(
                f"{out} was begun with {name} {existing.versions.get(name)}; this is {value}, whose data may "
                "differ: use that version, or another folder"
            )


def _by_name(settings: dict[str, Any]) -> dict[str, str]:
    """Settings by name as JSON texts, which preserve the order of a mix; the search's settings are named
    search.NAME."""
    search = settings.get("search")
    search_settings = search if isinstance(search, dict) else {}
    named = settings | {f"search.{name}": value for name, value in search_settings.items()}
    return {name: json.dumps(value) for name, value in named.items() if name != "search"}
