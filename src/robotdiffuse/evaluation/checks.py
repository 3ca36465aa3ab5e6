"""Checks the motions of data sets and benches.

In a data set, every shard must be complete, and motions must pass the validator and PyBullet's collision
check of meshes. Problems are rebuilt from the stored rows; the lengths and clearances that were stored when
the data were generated are measured again. In a bench, motions must pass PyBullet, a second validator with
its own kinematics.
"""

import sys
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path as FilePath
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Int
from numpy import ndarray

from robotdiffuse.collision import CollisionChecker
from robotdiffuse.core.errors import InputError
from robotdiffuse.core.settings import Natural, converted
from robotdiffuse.core.tables import Column, Table
from robotdiffuse.core.types import Done, Path, frozen_dataclass, unreported
from robotdiffuse.datasets.shards import (
    Manifest,
    Shard,
    check_shard,
    existing_shards,
    path_of,
    pick_rows,
    problem_of,
    read_manifest,
    read_shard,
    scenes_of,
)
from robotdiffuse.evaluation.runs import Record, read_cases, read_records
from robotdiffuse.processes.workers import Workers, in_order
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.validation.validator import Verifier

if TYPE_CHECKING:
    from robotdiffuse.simulation.validator import OracleContact

KINDS = {
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
"""Number of findings of each kind that are listed."""

CLEARANCE_TOLERANCE = 1e-4
"""Largest difference between the recorded and the measured clearance of a motion [m]. The clearance
of a motion is the smallest distance between covering spheres and obstacles at any of its waypoints."""
COST_TOLERANCE = 0.05
"""Largest fraction by which the path through the stored waypoints, which cuts corners, may be shorter than
the recorded length."""
ROUNDING = 1e-4
"""Allowance for rounding. The path through the stored waypoints may be longer than the recorded length by
this fraction of that length plus this value in [rad]. The recorded detour times the straight distance may
differ from the recorded length by this fraction of it, or by this value in [rad] if that is more."""
PYBULLET_STEP = 0.01
"""PyBullet checks the waypoints, and configurations between them that are at most this far apart [rad,
joint-space L2]."""
PYBULLET_TOLERANCE = 0.001
"""Contacts that are less deep than this count as rounding errors of Bullet [m]."""
MOTIONS_PER_TASK = 100
"""Largest number of motions that a process checks in one task; all are of the same shard."""


Defects = Iterator[tuple[str, str]]
"""Defects of a motion, each as kind and message."""


@dataclass(frozen=True)
class Finding:
    """A defect of a data set."""

    kind: str
    """One of KINDS."""
    shard: int
    row: int | None
    """Row in the shard; None if the finding is about the whole shard."""
    message: str

    @property
    def where(self) -> str:
        return f"shard {self.shard}" + ("" if self.row is None else f", row {self.row}")


@dataclass(frozen=True)
class DataCheck:
    """The result of checking a data set."""

    robot: str
    shards: int
    """Number of shards, complete or damaged."""
    motions: int
    """Number of motions in complete shards."""
    planned: int
    """Number of motions according to the manifest."""
    checked: int
    """Number of motions that were validated."""
    pybullet: bool
    """Whether PyBullet checked the motions too."""
    findings: tuple[Finding, ...]
    """Damaged shards first, then findings by shard and row."""
    least_clearance: float
    """Smallest recorded distance between arm and obstacles over all validated motions [m]; NaN without
    motions."""
    seconds: float
    """Wall time of the check [s]."""

    @property
    def counts(self) -> Counter[str]:
        """Number of findings by kind."""
        return Counter(finding.kind for finding in self.findings)

    @property
    def tables(self) -> list[Table]:
        """A table of the result and, if there are findings, a table with the first findings of each kind."""
        planned = f" of {self.planned:,} planned" if self.motions < self.planned else ""
        rate = self.checked / max(self.seconds, 1e-9)
        counts = {kind: f"{self.counts[kind]:,}" for kind in KINDS if self.pybullet or kind != "pybullet"}
        rows = [
            ("shards, motions", f"{self.shards:,}, {self.motions:,}{planned}"),
            ("validated", f"{self.checked:,} in {self.seconds:.1f} s ({rate:.0f}/s)"),
            *((name, counts.get(kind, "not checked")) for kind, name in KINDS.items()),
            ("least clearance recorded", f"{1e3 * self.least_clearance + 0.0:.3f} mm"),
        ]
        tables = [Table.pairs(f"{self.robot}: {'violations found' if self.findings else 'clean'}", rows)]
        if self.findings:
            examples = [
                (finding.kind, finding.where, finding.message)
                for kind in KINDS
                for finding in [f for f in self.findings if f.kind == kind][:EXAMPLES_PER_KIND]
            ]
            columns = ("first examples", Column("where", left=True), Column("what", left=True))
            tables.append(Table.of("", columns, examples))
        return tables


def check_data(
    folder: str | FilePath,
    robot: Robot | None = None,
    count: int | None = None,
    seed: int = 0,
    workers: int = 1,
    pybullet: bool = True,
    progress: Done = unreported,
) -> DataCheck:
    """Check the structure of every shard, and `count` random motions (all by default).

    The problem of each motion is rebuilt from its row. The validator checks start, goal, limits and
    collisions. PyBullet checks the meshes for collisions at and between the waypoints. Recorded values are
    compared with measured values.

    Args:
        folder: Folder of the data set.
        robot: The robot of the data; None: the robot with the name in the manifest.
        count: Number of motions to check.
        seed: Seed for choosing the motions.
        workers: Number of processes. Motions and findings do not depend on it.
        pybullet: Whether PyBullet checks the motions.
        progress: Called with the number of checked motions and the total number, first with 0.

    Raises:
        InputError: If the manifest is missing or damaged, if there are no shards, for another robot than that
            of the data, and if PyBullet is required but not installed.
    """
    began = time.perf_counter()
    count = converted("count", Natural | None, count)
    manifest = read_manifest(folder)
    robot = manifest.check_robot(robot)
    if pybullet:
        import robotdiffuse.simulation  # noqa: F401  (fails at once if PyBullet is not installed)
    indices = existing_shards(folder)
    task = _Task(str(folder), manifest, robot, pybullet)
    motions_to_check = min(manifest.trajectories, sys.maxsize if count is None else count)
    workers = min(workers, max(len(indices), -(-motions_to_check // MOTIONS_PER_TASK)))
    checked = 0
    least_clearance = np.inf
    with Workers(workers if workers > 1 else 0) as processes:
        answers = in_order(processes.each(task.row_count_or_defect, [(i,) for i in indices]))
        shards = dict(zip(indices, answers, strict=True))
        findings = [Finding("damaged", i, None, text) for i, text in shards.items() if isinstance(text, str)]
        row_counts = {i: rows for i, rows in shards.items() if isinstance(rows, int)}
        parts = [
            (index, chosen[i : i + MOTIONS_PER_TASK])
            for index, chosen in pick_rows(row_counts, count, seed).items()
            for i in range(0, len(chosen), MOTIONS_PER_TASK)
        ]
        total = sum(len(chosen) for _, chosen in parts)
        progress(checked, total)
        results = in_order(processes.each(task.validate, parts))
        for (_, chosen), (part_findings, clearance) in zip(parts, results, strict=True):
            findings += part_findings
            least_clearance = min(least_clearance, clearance)
            checked += len(chosen)
            progress(checked, total)
    return DataCheck(
        robot=robot.name,
        shards=len(indices),
        motions=sum(row_counts.values()),
        planned=manifest.trajectories,
        checked=checked,
        pybullet=pybullet,
        findings=tuple(findings),
        least_clearance=least_clearance if checked else float("nan"),
        seconds=time.perf_counter() - began,
    )


@frozen_dataclass
class _Task:
    """The work of a process. Objects are pickled to be sent to processes."""

    folder: str
    manifest: Manifest
    robot: Robot
    pybullet: bool

    def row_count_or_defect(self, index: int) -> int | str:
        """Number of rows of a shard, or a message about its defect."""
        try:
            return len(check_shard(self.folder, index, self.manifest))
        except InputError as error:
            return str(error)

    def validate(self, index: int, rows: Int[ndarray, "n"]) -> tuple[list[Finding], float]:
        """Findings in some rows of a shard, and the smallest clearance that these rows record [m]."""
        shard = read_shard(self.folder, index)
        findings = [
            Finding(kind, index, row, text)
            for row in rows.tolist()
            for kind, text in _defects(self, shard, row)
        ]
        if self.pybullet:
            findings += self._pybullet_findings(shard, rows)
        least_clearance = float(shard["clearance"][rows].min(initial=np.inf))
        return sorted(findings, key=lambda finding: finding.row or 0), least_clearance

    def _pybullet_findings(self, shard: Shard, rows: Int[ndarray, "n"]) -> Iterator[Finding]:
        from robotdiffuse.simulation.validator import PyBulletOracle

        with PyBulletOracle(self.robot, Scene([])) as oracle:
            for row in rows.tolist():
                try:
                    oracle.set_scene(scenes_of(self.manifest, shard, slice(row, row + 1)).scene(0))
                except InputError:
                    continue  # `_defects` reports a scene that cannot be built
                contact = oracle.check_path(
                    path_of(self.robot, shard, row), PYBULLET_STEP, PYBULLET_TOLERANCE
                )
                if contact is not None:
                    depth = -1e3 * contact.distance
                    at = contact.at
                    text = f"{contact.link} is {depth:.1f} mm inside {contact.other} at waypoint {at:.2f}"
                    yield Finding("pybullet", shard.index, row, text)


def _defects(task: _Task, shard: Shard, row: int) -> Defects:
    """The defects of a motion, without those that PyBullet finds."""
    robot = task.robot
    path = path_of(robot, shard, row)
    yield from _ends(shard, row)
    yield from _lengths(shard, row, path)
    try:
        problem = problem_of(task.manifest, robot, shard, row)
    except InputError as error:
        yield "motion", f"no problem can be built from this row: {error}"
        return
    for violation in Verifier(problem).path(path).found:
        kind = "collision" if violation.kind.endswith("collision") else violation.kind
        if kind != "start":  # `_ends` compares exactly
            yield kind if kind in KINDS else "motion", violation.line
    clearances = CollisionChecker(robot, problem.scene).link_clearances(path.positions)
    clearances = clearances.min(axis=1, initial=1.0)
    recorded = {"clearance": shard["clearance"][row, None], "end_clearance": shard["end_clearance"][row]}
    measured = {"clearance": clearances.min(keepdims=True), "end_clearance": clearances[[0, -1]]}
    for name, values in recorded.items():
        max_error_row = int(np.abs(values - measured[name]).argmax())
        stated = float(values[max_error_row])
        value = float(measured[name][max_error_row])
        if abs(stated - value) > CLEARANCE_TOLERANCE:
            yield "clearance", f"{name} is {1e3 * stated:.2f} mm; measured: {1e3 * value:.2f} mm"


def _ends(shard: Shard, row: int) -> Defects:
    q = shard["trajectories"][row]
    goals = shard["goals"][row]
    goal = int(shard["goal_index"][row])
    difference = np.abs(q[0] - shard["start"][row]).max()
    if difference:
        yield "ends", f"the first waypoint differs from the start by {difference:.3g}"
    if not 0 <= goal < len(goals) or np.isnan(goals[goal]).any():
        yield "ends", f"goal_index is {goal}; there is no such goal"
        return
    difference = np.abs(q[-1] - goals[goal]).max()
    if difference:
        yield "ends", f"the last waypoint differs from goal {goal} by {difference:.3g}"


def _lengths(shard: Shard, row: int, path: Path) -> Defects:
    cost = float(shard["cost"][row])
    detour = float(shard["detour"][row])
    if not cost * (1 - COST_TOLERANCE) - ROUNDING <= path.length <= cost * (1 + ROUNDING) + ROUNDING:
        yield "cost", f"cost is {cost:.4f} rad; the path through the waypoints has {path.length:.4f} rad"
    straight = max(float(np.linalg.norm(path.positions[-1] - path.positions[0])), 1e-9)
    if abs(detour * straight - cost) > ROUNDING * max(cost, 1.0):
        yield "cost", f"detour is {detour:.4f}; cost over the straight distance is {cost / straight:.4f}"


# Motions of a bench

CONFIRM_STEP = 0.02
"""Largest distance between successive checked configurations [rad, joint-space L2]."""


def confirm(
    out: FilePath, count: int | None, progress: Done
) -> "tuple[dict[str, int], list[tuple[Record, OracleContact]]]":
    """Check the returned motions in a folder of `bench run` with PyBullet.

    Args:
        out: The folder.
        count: Number of problems of each set to check, from the first on; None: all.
        progress: Called with the number of checked problems and the total number.

    Returns:
        The number of checked motions by planner; and the records of motions that planners returned as solved
        but that collide according to PyBullet, each with the first contact.

    Raises:
        InputError: If the folder has no records or is damaged, or PyBullet is not installed.
    """
    from robotdiffuse.simulation.validator import PyBulletOracle

    records = [record for planner_records in read_records(out).values() for record in planner_records]
    solved = dict[tuple[str, str], list[Record]]()
    for record in records:
        if record.solved:
            solved.setdefault((record.problem_set, record.name), []).append(record)
    sets = {name: read_cases(out, name) for name in sorted({record.problem_set for record in records})}
    missing_problems = solved.keys() - {case.key for cases in sets.values() for case in cases}
    if missing_problems:
        problem_set, name = min(missing_problems)
        raise InputError(f"{out}/problems lacks {name} of {problem_set}, which has results")
    chosen = [
        case
        for cases in sets.values()
        for case in cases[:count]
        if case.key in solved and not case.problem.moving  # records keep no times
    ]
    checked = {record.planner: 0 for record in records}
    refuted = []
    for number, case in enumerate(chosen, start=1):
        robot = case.problem.robot
        with PyBulletOracle(robot, case.problem.scene) as validator:
            for record in solved[case.key]:
                contact = validator.check_path(Path(robot.joint_names, record.waypoints), CONFIRM_STEP)
                checked[record.planner] += 1
                if contact is not None:
                    refuted.append((record, contact))
        progress(number, len(chosen))
    return checked, refuted
