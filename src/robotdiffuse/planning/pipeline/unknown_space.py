"""Planning in a scene of which cameras saw only a part: assumptions about unknown space, for any planner.

An assumption adds obstacles to the observed scene. "As seen" is the assumption without additional obstacles.
Each policy for unknown space has a list of assumptions, the most cautious first. They are tried in this
order, and the first under which a motion is found gives the result. So every motion avoids the observed
obstacles, and as many assumed obstacles as possible. The policies are:

- padded: observed points, inflated by 9 cm, then by 6 cm, then by 4 cm; then as seen.
- predicted: voxels that the occupancy completion network predicts occupied with a probability above 0.1, 0.2,
  0.35, 0.5; then as seen. Among several motions under an assumption, one is chosen that sweeps voxels of low
  probability.
- occupied: every voxel that no view saw. If no motion is found, planning fails.
- optimistic: as seen.

The default policy is predicted if the network covers the arm's reach, otherwise padded. If a motion is found
under a later assumption than the first, a note names the assumptions that failed.

Start and goal are assumed to be free: the space around them is removed from the assumed obstacles, but not
from observed ones.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from robotdiffuse.collision.kernel_arrays import compile_scene_for
from robotdiffuse.core.types import FIRST, Configurations, PlanResult, Status
from robotdiffuse.perception.camera_check import camera_note
from robotdiffuse.perception.depth_filter import measured_share
from robotdiffuse.perception.depth_view import AssumedPoints, SeenPoints
from robotdiffuse.perception.observed_volume import ObservedVolume, merged, observe, observed_by
from robotdiffuse.perception.occupancy_map import (
    PADDINGS,
    THRESHOLDS,
    UNSEEN_CONFIDENCE,
    Assumption,
    OccupiedVoxels,
    Padded,
    UnknownSpace,
    confidence,
    lost_regions,
)
from robotdiffuse.perception.voxel_grid import Probabilities, refined
from robotdiffuse.planning.context import PlanningContext, PlanRequest, Solver
from robotdiffuse.planning.start_goal import usable_start_goal
from robotdiffuse.problems.problem import OCCUPIED, OPTIMISTIC, PADDED, PREDICTED, JointGoal, Problem
from robotdiffuse.scenes.point_cloud import voxel_thin
from robotdiffuse.scenes.scene import added

# With predicted probabilities, up to MAX_FIRST_MOTIONS motions are planned under an assumption. Each is the
# first motion that a search with another seed finds. The risk of a motion is the sum of the predicted
# probabilities of the unknown voxels that it sweeps. Planning of first motions ends when the lowest risk is
# at most NEGLIGIBLE_RISK, or, after MIN_FIRST_MOTIONS motions, at most ACCEPTABLE_RISK.
MAX_FIRST_MOTIONS = 8
MIN_FIRST_MOTIONS = 4
ACCEPTABLE_RISK = 2.0
NEGLIGIBLE_RISK = 0.1
CONFIDENCE_TOLERANCE = 0.002
"""The shortest motion is chosen among those with a confidence at most this much below the highest."""
AS_SEEN_TIME_FRACTION = 0.3
"""Fraction of the time limit that is reserved for the assumption "as seen", unless the policy excludes it."""
ASSUMPTION_TIME_FRACTION = 0.25
"""Time for each other assumption, as a fraction of the remaining time that is not reserved."""
MIN_TIME_FRACTION = 0.1
"""Smallest fraction of the time limit for an attempt of the planner."""
THINNING_CELL = 1 / 3
"""Thinning keeps one point in each cell of this edge length, as a fraction of the padding."""
PICTURE_THRESHOLD = 0.2
"""`predicted_obstacles` has the voxels with a probability above this."""
FREE_UNKNOWN_SPACE = "unknown space taken as free"
MIN_MEASURED_SHARE = 0.01
"""Planning fails if each view has a `measured_share` below this."""
NOTED_SHARE = 0.8
"""A note names each view with a `measured_share` below this."""
AS_SEEN = "as seen"
"""Name of the assumption without additional obstacles."""


def plan_with_unknown_space(
    planner: Solver,
    problem: Problem,
    request: PlanRequest,
    predicted: Probabilities | None = None,
    unknown: UnknownSpace | None = None,
) -> PlanResult:
    """A motion under the problem's policy for unknown space; see the docstring of the module.

    predicted: the probability that each fine voxel of the observed volume is occupied; None: the occupancy
    completion network predicts it if the policy needs it. unknown: the space that no view saw; None: computed
    from the problem's views. If the scene already contains the observed points, as in `Explorer`, the caller
    may give `unknown`. Then no volume is computed from the views. So the policy predicted also needs the
    argument `predicted`, and the policy occupied is not possible.

    The result states the assumption, the confidence (the probability that the motion is free in the true
    scene), and the unknown space that the motion crosses.
    """
    policy, policy_note = policy_for(problem)
    if policy == PREDICTED and predicted is None:
        from robotdiffuse.learning.completion import exported_completion, predict

        exported_completion()  # loaded before the clock starts
    else:
        predict = None
    context = PlanningContext(planner.name, problem, request)
    volumes = list[ObservedVolume]()
    volume = None
    if unknown is None:
        volumes = [observed_by(view, problem.robot, problem.start) for view in problem.views]
        volume = merged(volumes)
        predicted = predict(volume) if predict is not None else predicted
        unknown = unknown_space_of(problem, volume, predicted)
    cameras = [camera_note(view, problem.robot, problem.start) for view in problem.views]
    prepared = context.elapsed
    shares = [measured_share(view) for view in problem.views]
    if shares and max(shares) < MIN_MEASURED_SHARE:
        why = (
            "the views measured nothing: almost no depth is between 5 cm and 10 km. Is the camera covered, or"
            " is the scale of the depths wrong?"
        )
        return _with_notes(context, context.fail(Status.NO_PATH, why))
    for i, wrong in enumerate(cameras):
        if wrong:
            context.note(f"check the camera of views[{i}]: {wrong}")
    for i, seen in enumerate(volumes):
        if seen.unknown.all():
            context.note(f"views[{i}] shows nothing of the space around the arm: check its T_base_camera")
    for i, share in enumerate(shares):
        if share < NOTED_SHARE:
            remedy = "; if the sensor gives 0 where nothing is in range, state the view's range"
            context.note(
                f"views[{i}]: {100 * (1 - share):.0f} % of the pixels measure nothing, which may lower the"
                f" confidence{remedy if problem.views[i].cloud is None else ''}"
            )
    unsure = any(cameras) or (policy == PREDICTED and policy_note)
    attempts = _Attempts(planner, context, unknown, UNSEEN_CONFIDENCE if unsure else 1.0)
    as_seen = replace(problem, views=())
    limit = request.time_limit
    failed = list[str]()
    if policy != OPTIMISTIC:
        goals = _goals(context, as_seen)
        if isinstance(goals, PlanResult):
            return _with_notes(context, goals)
        occupied_only = policy == OCCUPIED
        for assumption in assumptions_of(problem, volume, predicted):
            search_time = (1 - AS_SEEN_TIME_FRACTION) * limit - context.elapsed
            if not occupied_only and search_time < MIN_TIME_FRACTION * limit:
                break
            assumed = with_assumption(problem, assumption, goals)
            # prepared here, so that it does not count as the assumption's time
            compile_scene_for(problem.robot, assumed.scene)
            search_time = (1 - AS_SEEN_TIME_FRACTION) * limit - context.elapsed
            share = max(ASSUMPTION_TIME_FRACTION * search_time, MIN_TIME_FRACTION * limit)
            until = limit if occupied_only else context.elapsed + share
            result = attempts.best(assumed, assumption.name, until)
            if occupied_only and not result.solved:
                why = "no motion was found that avoids all space that no view saw"
                return _with_notes(context, replace(result, reason=f"{why}: {result.reason}"))
            if occupied_only or result.solved:
                return _with_notes(context, result, policy_note, _failed_note(failed, assumption.name))
            failed.append(assumption.name)
    result = attempts.best(as_seen, AS_SEEN, limit)
    took = f"preparing it took {prepared:.2g} s of the time limit of {limit:g} s"
    late = f"no time for the policy {policy}: {took}"
    if policy == OPTIMISTIC or not result.solved:
        return _with_notes(context, result, "" if policy == OPTIMISTIC or failed else late)
    if failed:
        return _with_notes(context, result, policy_note, _failed_note(failed, FREE_UNKNOWN_SPACE))
    return _with_notes(context, result, policy_note, f"{late}; planned with {FREE_UNKNOWN_SPACE}")


def policy_for(problem: Problem) -> tuple[str, str]:
    """The problem's policy for unknown space, or the default; and a note, which may be "".

    If the arm reaches farther than the network predicts, the default is padded, and the note says so; for the
    policy predicted, the note says that the confidence is limited.
    """
    if problem.unknown not in (None, PREDICTED):
        return problem.unknown, ""
    from robotdiffuse.learning.completion import REACH, covers

    if covers(problem.robot):
        return PREDICTED, ""
    limitation = f"predicts up to {REACH:g} m from a Panda's shoulder; {problem.robot.name} reaches farther"
    if problem.unknown == PREDICTED:
        return PREDICTED, f"confidence is at most {UNSEEN_CONFIDENCE:g}, since the network {limitation}"
    return PADDED, f"unknown space: {PADDED}, since the network {limitation}"


def _failed_note(failed: list[str], used: str) -> str:
    """A note on the assumptions under which no motion was found; "" if there are none."""
    if not failed:
        return ""
    return f"no motion was found in the time given to {'; '.join(failed)}. Planned with {used}"


def _with_notes(context: PlanningContext, result: PlanResult, *notes: str) -> PlanResult:
    """The result with the notes of the call and with further notes; each note once."""
    return replace(result, notes=context.notes_with((*result.notes, *filter(None, notes))))


def assumptions_of(
    problem: Problem, volume: ObservedVolume | None, predicted: Probabilities | None
) -> Iterator[Assumption]:
    """The assumptions of the problem's policy, the most cautious first, without "as seen".

    predicted: the probability that each fine voxel is occupied, for the policy "predicted".
    """
    robot = problem.robot
    known_scene = problem.known_scene
    policy, _ = policy_for(problem)
    if policy == PADDED:
        seen = [shape.points for shape in problem.scene.shapes if isinstance(shape, SeenPoints)]
        points = np.concatenate([np.zeros((0, 3)), *seen])
        for padding in PADDINGS:
            yield Padded(voxel_thin(points, padding * THINNING_CELL), padding)
    elif policy == PREDICTED:
        assert predicted is not None
        for threshold in THRESHOLDS:
            yield OccupiedVoxels(f"predicted, p > {threshold:g}", predicted > threshold, robot, known_scene)
    elif policy == OCCUPIED:
        assert volume is not None
        yield OccupiedVoxels("unknown is occupied", volume.unknown, robot, known_scene)


def unknown_space_of(
    problem: Problem, volume: ObservedVolume, predicted: Probabilities | None
) -> UnknownSpace:
    """The space that no view of the problem saw; the arm's space at the start and at goal configurations
    counts as free."""
    goals = problem.goal.positions if isinstance(problem.goal, JointGoal) else ()
    ends = (problem.start, *goals)
    unknown = refined(volume.unknown)
    lost = lost_regions(volume) if predicted is None else None
    return UnknownSpace(problem.robot, ends, unknown, predicted, lost=lost)


def predicted_obstacles(problem: Problem) -> AssumedPoints:
    """The obstacles that the occupancy completion network predicts for the problem's views, for drawing."""
    from robotdiffuse.learning.completion import predict

    volume = observe(problem.views, problem.robot, problem.start)
    arm = problem.robot.placed_spheres(problem.start).astype(np.float32)
    likely = predict(volume) > PICTURE_THRESHOLD
    return OccupiedVoxels("likely", likely, problem.robot, problem.known_scene).obstacles(arm)


def _goals(context: PlanningContext, as_seen: Problem) -> Configurations | PlanResult:
    """The goal configurations: that of a JointGoal with only one, else those that reach the goal and are
    free of observed obstacles. A failed result if there are none."""
    if isinstance(as_seen.goal, JointGoal) and len(as_seen.goal.positions) == 1:
        return as_seen.goal.positions
    start_goal = usable_start_goal(PlanningContext(context.planner_name, as_seen, context.request))
    return start_goal if isinstance(start_goal, PlanResult) else np.stack(start_goal.goals)


def with_assumption(problem: Problem, assumption: Assumption, goals: Configurations) -> Problem:
    """The problem with an assumption's obstacles added to the observed scene, except those at the start or at
    the goals. Only the goals at which the fewest obstacles have to be removed are kept."""
    start, *at_goals = (problem.robot.placed_spheres(q).astype(np.float32) for q in (problem.start, *goals))
    # a single goal is kept, so its obstacles need not be counted
    several = at_goals if len(at_goals) > 1 else ()
    touched = np.array([assumption.touched(spheres).sum() for spheres in several] or [0])
    easiest = np.flatnonzero(touched == touched.min())
    obstacles = assumption.obstacles(np.concatenate([start, *(at_goals[i] for i in easiest)]))
    scene = added(problem.scene, [obstacles])
    return replace(problem, scene=scene, goal=JointGoal(goals[easiest]), views=())


@dataclass
class _Attempts:
    """Calls a planner for problems under assumptions, within one planning call."""

    planner: Solver
    context: PlanningContext
    unknown: UnknownSpace
    max_confidence: float
    """Upper limit of the confidence, lowered if the arm reaches farther than the network predicts, or if a
    camera seems misplaced, since its images may then show occupied space as free."""

    def best(self, problem: Problem, assumption: str, end: float) -> PlanResult:
        """A motion that is found before `end` [s since the call], or the result that says why there is none.
        Each attempt gets at least MIN_TIME_FRACTION of the time limit, so it may end after `end`.

        With predicted probabilities, several first motions are planned, and then one that is improved for the
        remaining time. Among those with about the highest confidence, the shortest is returned.
        """
        request = self.context.request
        predicted = self.unknown.probability is not None
        motions = list[PlanResult]()
        while len(motions) < MAX_FIRST_MOTIONS:
            quick = replace(request, until=FIRST, seed=request.seed + len(motions)) if predicted else request
            result = self._attempt(problem, assumption, end, quick)
            if not result.solved:
                if motions:
                    break
                return result
            motions.append(result)
            lowest_risk = min(motion.swept_probability or 0.0 for motion in motions)
            acceptable = ACCEPTABLE_RISK if len(motions) >= MIN_FIRST_MOTIONS else NEGLIGIBLE_RISK
            if self.context.elapsed >= end or lowest_risk <= acceptable:
                break
        if predicted and request.until != FIRST and self.context.elapsed < end:
            result = self._attempt(problem, assumption, end, request)
            if result.solved:
                motions.append(result)
        min_confidence = max(motion.confidence or 0.0 for motion in motions) - CONFIDENCE_TOLERANCE
        best = [motion for motion in motions if (motion.confidence or 0.0) >= min_confidence]
        chosen = min(best, key=lambda motion: motion.path_length)
        region = self.unknown.crossed(chosen.path).region
        return replace(chosen, planning_time=self.context.elapsed, unknown_region=region)

    def _attempt(self, problem: Problem, assumption: str, end: float, request: PlanRequest) -> PlanResult:
        """The planner's result; if solved, with its confidence and assumption."""
        context_request = self.context.request
        began = self.context.elapsed
        limit = max(end - began, MIN_TIME_FRACTION * context_request.time_limit)
        result = self.planner.attempt(problem, replace(request, time_limit=limit))
        progress = tuple((began + at, length) for at, length in result.progress)
        result = replace(
            result, planning_time=began + result.planning_time, progress=progress, seed=context_request.seed
        )
        if not result.solved:
            return result
        crossed = self.unknown.crossed(result.path)
        return replace(
            result,
            notes=(*result.notes, *filter(None, [crossed.blind])),
            assumption=assumption,
            confidence=min(confidence(assumption, crossed), self.max_confidence),
            swept_probability=crossed.risk,
        )
