"""Checks of a data set: every shard is complete, and motions pass the validator and PyBullet on meshes.

Problems are rebuilt from their rows alone; results of the generation are not trusted.
"""

import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path as FilePath

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.core.errors import InputError, distinct
from robotdiffuse.core.processes import Workers, in_order
from robotdiffuse.core.types import Path
from robotdiffuse.datasets.manifest import Manifest, read_manifest
from robotdiffuse.datasets.motion_rows import path_of, problem_of, scenes_of
from robotdiffuse.datasets.shards import Shard, check_shard, existing_shards, pick_rows, read_shard
from robotdiffuse.evaluation.tables import Column, Table
from robotdiffuse.robots import load_robot
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.validation.validator import Verifier, VerifySettings

KINDS: dict[str, str] = {
    "damaged": "shards damaged",
    "ends": "start or goal not exact",
    "limits": "joint limits exceeded",
    "collision": "collisions found by the validator",
    "pybullet": "collisions found by PyBullet",
    "motion": "refused by the validator for other reasons",
    "cost": "length or detour not as recorded",
    "clearance": "clearance not as recorded",
}
"""Kinds of findings, with their titles."""
EXAMPLES_PER_KIND = 5
"""Findings of each kind that are listed."""

LIMIT_SLACK = 1e-6
"""Tolerance of limits [rad], as waypoints are in single precision."""
CLEARANCE_TOLERANCE = 1e-4
"""Largest difference of the recorded clearance from the least one of the waypoints by covering spheres
[m]."""
COST_TOLERANCE = 0.05
"""Largest share by which waypoints, which cut corners, may be shorter than the recorded length."""
ROUNDING = 1e-4
"""Largest share by which waypoints may be longer than the recorded length; also the tolerance of the
detour."""
PYBULLET_STEP = 0.01
"""PyBullet checks every waypoint, and configurations between them at most this far apart [rad, joint-space
L2]."""
PYBULLET_TOLERANCE = 0.001
"""Contacts of less depth are rounding errors of Bullet [m]."""
MOTIONS_PER_TASK = 100
"""Motions of a shard that a process checks in one task."""


@dataclass(frozen=True)
class Finding:
    """A defect."""

    kind: str
    """One of KINDS."""
    shard: int
    row: int | None
    """None for the whole shard."""
    message: str

    @property
    def where(self) -> str:
        return f"shard {self.shard}" + ("" if self.row is None else f", row {self.row}")


@dataclass(frozen=True)
class DataCheck:
    """The result of a check."""

    robot: str
    shards: int
    """Shards, complete or damaged."""
    motions: int
    """Motions in complete shards."""
    planned: int
    """Motions according to the manifest."""
    checked: int
    """Motions that were validated."""
    pybullet: bool
    """Whether PyBullet checked too."""
    counts: dict[str, int]
    """Findings by kind, for all of KINDS."""
    examples: tuple[Finding, ...]
    """The first few of each kind, by shard and row."""
    least_clearance: float
    """Least recorded distance between arm and obstacles of the validated motions [m]; NaN without any."""
    seconds: float
    """Wall time."""

    @property
    def clean(self) -> bool:
        return not any(self.counts.values())

    @property
    def tables(self) -> list[Table]:
        """A table of the result, and one of the first examples of each kind."""
        planned = f" of {self.planned:,} planned" if self.motions < self.planned else ""
        rate = self.checked / max(self.seconds, 1e-9)
        checked = {kind: kind != "pybullet" or self.pybullet for kind in KINDS}
        rows = [
            ("shards, motions", f"{self.shards:,}, {self.motions:,}{planned}"),
            ("validated", f"{self.checked:,} in {self.seconds:.1f} s ({rate:.0f}/s)"),
            *(
                (name, f"{self.counts[kind]:,}" if checked[kind] else "not checked")
                for kind, name in KINDS.items()
            ),
            ("least clearance recorded", f"{1e3 * self.least_clearance + 0.0:.3f} mm"),
        ]
        found = [Table.pairs(f"{self.robot}: {'clean' if self.clean else 'violations found'}", rows)]
        if self.examples:
            columns = "first examples", Column("where", left=True), Column("what", left=True)
            found.append(Table.of("", columns, [(f.kind, f.where, f.message) for f in self.examples]))
        return found


def check_data(
    folder: str | FilePath,
    robot: Robot | None = None,
    count: int | None = None,
    seed: int = 0,
    workers: int = 1,
    pybullet: bool = True,
    progress: Callable[[int, int], None] | None = None,
) -> DataCheck:
    """Check the structure of every shard, and `count` random motions (all by default).

    The problem of each motion is rebuilt from its row. The validator checks ends, limits and collisions;
    PyBullet checks collisions on meshes at and between the waypoints. Recorded values are compared with
    measured ones.

    robot: that of the data; None: found by the name in the manifest.
    workers: processes; the motions and findings do not depend on them.
    progress: called with the numbers of motions done and in all, first with 0.

    Raises InputError if there is no data set, for another robot than that of the data, and if PyBullet is
    asked for but not installed.
    """
    began = time.perf_counter()
    manifest = read_manifest(folder)
    robot = load_robot(manifest.robot) if robot is None else robot
    manifest.check_robot(robot)
    if pybullet:
        _need_pybullet()
    indices = existing_shards(folder)
    task = _Task(str(folder), manifest, robot, pybullet)
    motions = min(manifest.trajectories, sys.maxsize if count is None else count)
    workers = min(workers, max(len(indices), -(-motions // MOTIONS_PER_TASK)))
    with Workers(workers if workers > 1 else 0) as processes:
        sizes = dict(zip(indices, in_order(processes.each(task.size, [(i,) for i in indices])), strict=True))
        found = [Finding("damaged", i, None, size) for i, size in sizes.items() if isinstance(size, str)]
        rows = {i: size for i, size in sizes.items() if isinstance(size, int)}
        chosen = [
            (index, picked[i : i + MOTIONS_PER_TASK])
            for index, picked in pick_rows(rows, count, seed).items()
            for i in range(0, len(picked), MOTIONS_PER_TASK)
        ]
        total, done, least = sum(len(part) for _, part in chosen), 0, np.inf
        if progress is not None:
            progress(done, total)
        for part in in_order(processes.each(task.validate, [(some,) for some in chosen])):
            found += part.findings
            done, least = done + part.motions, min(least, part.least_clearance)
            if progress is not None:
                progress(done, total)
    return DataCheck(
        robot=robot.name,
        shards=len(indices),
        motions=sum(rows.values()),
        planned=manifest.trajectories,
        checked=done,
        pybullet=pybullet,
        counts={kind: sum(f.kind == kind for f in found) for kind in KINDS},
        examples=tuple(f for kind in KINDS for f in [f for f in found if f.kind == kind][:EXAMPLES_PER_KIND]),
        least_clearance=least if done else float("nan"),
        seconds=time.perf_counter() - began,
    )


def _need_pybullet() -> None:
    try:
        import robotdiffuse.simulation.validator  # noqa: F401
    except ModuleNotFoundError as error:
        if error.name != "pybullet":
            raise
        raise InputError(
            "the second validator needs PyBullet, whose wheels stop at Python 3.11: pip install "
            "'robotdiffuse[sim]', or leave it out by --no-pybullet (pybullet=False)"
        ) from None


@dataclass(frozen=True)
class _PartResult:
    """The result of some rows of a shard."""

    motions: int
    findings: list[Finding]
    least_clearance: float


@dataclass(frozen=True, eq=False)
class _Task:
    """The work of a process; it is pickled."""

    folder: str
    manifest: Manifest
    robot: Robot
    pybullet: bool

    def size(self, index: int) -> int | str:
        """Number of rows of a shard, or the defect of the shard."""
        try:
            return len(check_shard(self.folder, index, self.manifest))
        except InputError as error:
            return str(error)

    def validate(self, part: tuple[int, Int[ndarray, "n"]]) -> _PartResult:
        """Validate some rows of a shard."""
        index, rows = part
        shard = read_shard(self.folder, index)
        findings: list[Finding] = []
        for row in rows.tolist():
            findings += [Finding(kind, index, row, text) for kind, text in _defects(self, shard, row)]
        if self.pybullet:
            findings += self._pybullet_findings(shard, rows)
        least = float(shard["clearance"][rows].min(initial=np.inf))
        return _PartResult(len(rows), sorted(findings, key=lambda f: f.row or 0), least)

    def _pybullet_findings(self, shard: Shard, rows: Int[ndarray, "n"]) -> Iterator[Finding]:
        from robotdiffuse.simulation.validator import PyBulletOracle

        with PyBulletOracle(self.robot, Scene([])) as oracle:
            for row in rows.tolist():
                try:
                    oracle.set_scene(scenes_of(self.manifest, shard, slice(row, row + 1)).scene(0))
                except InputError:
                    continue  # already a finding
                path = path_of(self.robot, shard, row)
                contact = oracle.check_path(path, PYBULLET_STEP, PYBULLET_TOLERANCE)
                if contact is not None:
                    depth, at = -1e3 * contact.distance, contact.at
                    text = f"{contact.link} is {depth:.1f} mm inside {contact.other} at waypoint {at:.2f}"
                    yield Finding("pybullet", shard.index, row, text)


def _defects(task: _Task, shard: Shard, row: int) -> Iterator[tuple[str, str]]:
    """Kind and message of each defect of a motion, without PyBullet."""
    robot, path = task.robot, path_of(task.robot, shard, row)
    yield from _ends(shard, row)
    yield from _limits(robot, path.positions)
    yield from _lengths(shard, row, path)
    try:
        problem = problem_of(task.manifest, robot, shard, row)
    except InputError as error:
        yield "motion", f"makes no problem: {error}"
        return
    violation = Verifier(problem, VerifySettings()).path(path).violation
    if violation is not None and violation.kind.endswith("collision"):
        yield "collision", f"{violation.message} at waypoint {violation.time:.2f}"
    elif violation is not None and violation.kind not in ("limits", "start"):
        yield "motion", violation.message
    checker = CollisionChecker(robot, problem.scene)
    clearances = checker.link_clearances(path.positions).min(axis=1, initial=1.0)
    measured = float(clearances.min())
    recorded = float(shard["clearance"][row])
    if abs(measured - recorded) > CLEARANCE_TOLERANCE:
        yield "clearance", f"clearance is {1e3 * recorded:.2f} mm; measured: {1e3 * measured:.2f} mm"
    worst = int(np.abs(shard["end_clearance"][row] - clearances[[0, -1]]).argmax())
    end, at_end = float(shard["end_clearance"][row, worst]), float(clearances[[0, -1]][worst])
    if abs(end - at_end) > CLEARANCE_TOLERANCE:
        yield "clearance", f"end_clearance is {1e3 * end:.2f} mm; measured: {1e3 * at_end:.2f} mm"


def _ends(shard: Shard, row: int) -> Iterator[tuple[str, str]]:
    q, goals, goal = shard["trajectories"][row], shard["goals"][row], int(shard["goal_index"][row])
    if not np.array_equal(q[0], shard["start"][row]):
        off = np.abs(q[0] - shard["start"][row]).max()
        yield "ends", f"the first waypoint differs from the start by {off:.3g}"
    if not 0 <= goal < len(goals) or np.isnan(goals[goal]).any():
        yield "ends", f"goal_index is {goal}; there is no such goal"
    elif not np.array_equal(q[-1], goals[goal]):
        off = np.abs(q[-1] - goals[goal]).max()
        yield "ends", f"the last waypoint differs from goal {goal} by {off:.3g}"


def _limits(robot: Robot, q: Float[ndarray, "n dof"]) -> Iterator[tuple[str, str]]:
    excess = np.maximum(robot.lower - q, q - robot.upper)
    excess[:, robot.continuous] = 0.0
    if excess.max() > LIMIT_SLACK:
        i, j = np.unravel_index(excess.argmax(), excess.shape)
        value, low, high = distinct(q[i, j], robot.lower[j], robot.upper[j])
        yield (
            "limits",
            f"{robot.joint_names[j]} is {value} at waypoint {i}; its limits are {low} to {high}",
        )


def _lengths(shard: Shard, row: int, path: Path) -> Iterator[tuple[str, str]]:
    cost, detour = float(shard["cost"][row]), float(shard["detour"][row])
    if not cost * (1 - COST_TOLERANCE) - ROUNDING <= path.length <= cost * (1 + ROUNDING) + ROUNDING:
        yield "cost", f"cost is {cost:.4f} rad; the waypoints are {path.length:.4f} rad long"
    straight = float(np.linalg.norm(path.positions[-1] - path.positions[0]))
    if abs(detour * straight - cost) > ROUNDING * max(cost, 1.0):
        yield (
            "cost",
            f"detour is {detour:.4f}; cost over the straight distance is {cost / max(straight, 1e-9):.4f}",
        )
