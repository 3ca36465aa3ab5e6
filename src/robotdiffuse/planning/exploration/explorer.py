"""Explorer: takes an arm to goals through space that cameras see on the way.

An Explorer returns steps. Steps of the kind `look` move the arm to a viewpoint, where the caller takes
an image. Motions follow one of two policies, or the first and then the second.

**Strict.** The arm enters only voxels that were seen free: the validator accepts each motion among obstacles
that cover all other space (`viewpoints.py`). Besides `free_zone`, there are two exceptions: voxels with
centers within 3 cm of the arm at the start of the motion, and, for motions to the goal or back along the
latest motion, the space within 2 cm of the arm at their end. Seen points are obstacles even there. With
`see_goal`, the arm's surface at the goal must also have been seen free (`viewpoints.GoalSeen`). The promise
is as good as the map: if the scene does not change, and the camera's poses and errors are as stated, such a
motion does not collide. Seen points may be displaced by the error of their camera's pose, and an obstacle may
be anywhere within this error of a seen point. This space counts as free only if some view shows it free for
every camera pose within the error of that view's pose. Views from nearby can show this.

**Probabilistic.** The arm executes a motion whose stated `confidence` is high enough, and otherwise looks
first. The confidence follows from the predicted occupancy probabilities of the unknown voxels that the motion
sweeps, except voxels that the arm fills at the start or at the goal.

To choose a viewpoint, the Explorer plans a tentative motion to the goal among only the seen obstacles. Views
should show the unseen space that this motion would sweep. The motion to a viewpoint is subject to the policy
as well. Under the probabilistic policy, a strict motion to the viewpoint is tried first.

A motion under way is stopped before an obstacle that appears in its way. The stop follows the path of the
motion, slower and slower until the arm rests. So it passes only configurations that were validated when the
motion was planned; they are validated again among the obstacles that were seen since then.
"""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import lru_cache
from itertools import islice, product

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import BSpline

from robotdiffuse.collision.kernel_arrays import compile_scene_for
from robotdiffuse.core.errors import InputError, check_type, counted, joined, shown, vector
from robotdiffuse.core.locked import locked
from robotdiffuse.core.settings import Natural, Number, converted
from robotdiffuse.core.types import (
    FIRST,
    Configuration,
    Configurations,
    Path,
    PlanResult,
    Status,
    Trajectory,
    frozen_dataclass,
)
from robotdiffuse.perception.camera_check import contradiction, implausible
from robotdiffuse.perception.depth_view import DepthView
from robotdiffuse.perception.occupancy_map import (
    APPEARED_PADDING,
    EXPLORED,
    Corners,
    OccupancyMap,
    UnknownSpace,
    ViewMemory,
    lost_regions,
    probability_free,
)
from robotdiffuse.perception.pose_refinement import PoseRefinement
from robotdiffuse.perception.seen_points import point_shapes, seen_shapes
from robotdiffuse.perception.voxel_grid import LAYERS_BELOW, MAP, Probabilities, Voxels, surface
from robotdiffuse.planning import load_planner
from robotdiffuse.planning.context import PlanningContext, PlanRequest
from robotdiffuse.planning.exploration.steps import (
    DONE,
    GO,
    LOOK,
    PROBABILISTIC,
    STRICT,
    STRICT_THEN_PROBABILISTIC,
    STUCK,
    ArmCamera,
    ExplorerSettings,
    Step,
)
from robotdiffuse.planning.exploration.viewpoints import (
    CONFINED,
    GoalSeen,
    ReachableTree,
    best_viewpoints,
    cover,
    first_parts,
    hardly_seen,
    least_unknown,
    moved,
    near_ends,
    not_seen_free,
    reaches_outside,
    swept_unseen,
)
from robotdiffuse.planning.pipeline.unknown_space import plan_with_unknown_space
from robotdiffuse.planning.start_goal import usable_start_goal
from robotdiffuse.problems.problem import PADDED, PREDICTED, Goal, JointGoal, Problem
from robotdiffuse.robots.robot import Robot, check_robot
from robotdiffuse.scenes.scene import Scene, added
from robotdiffuse.scenes.shapes import PointCloud
from robotdiffuse.trajectories.speed_limits import jerk_limits
from robotdiffuse.validation.tolerances import VerifySettings, goal_error
from robotdiffuse.validation.validator import verifier

ROW_TIME = 0.004
"""Largest time between the rows while a stop brakes [s]."""
LEAST_STEP = 1e-3
"""Smallest time between the rows of a stop [s]; a stop takes at least this long."""
DELAY_STEP = 0.02
"""Step between the times at which braking may begin [s]."""
BRAKING_TIMES = 0.05 * 1.12 ** np.arange(35)
"""Durations of braking that are tried, the shortest first [s]."""
RAMPS = (0.1, 0.25, 0.5)
"""Fractions of the braking time that are tried for the rise of the deceleration, and for its fall."""
LIMIT_TOLERANCE = 1e-3
"""Accelerations and jerks may exceed their limits by this fraction of the limit."""


@frozen_dataclass
class Stop:
    """How a motion ends early."""

    begins: float
    """When the stop replaces the motion, in time of the motion [s]."""
    motion: Trajectory
    """The stop, from this time on; it ends at rest on the path of the motion."""
    reason: str
    """The violation that the motion would have: what is in the way."""
    certified: bool
    """Whether the validator accepts the stop among what was seen since `next`; if not, it comes too late."""


def braked(robot: Robot, motion: Trajectory, time: float) -> Trajectory:
    """The motion from `time` on, slowed to rest after as little of the path as the limits allow. It stays on
    the path. If no braking that was tried keeps the limits, the remaining motion is returned unchanged. While
    the arm brakes for b seconds, the clock of the motion advances by b / 2."""
    used = motion.duration - time
    best = _rows(motion, time, max(used, LEAST_STEP), 0.0, RAMPS[0])
    for delay in np.arange(0.0, used, DELAY_STEP):
        for braking, ramp in product(BRAKING_TIMES, RAMPS):
            if delay + braking / 2 >= used:
                break
            candidate = _rows(motion, time, float(delay), float(braking), ramp)
            if _within_limits(robot, candidate):
                best = candidate
                used = delay + braking / 2
                break
    return best


def _rows(motion: Trajectory, time: float, delay: float, braking: float, ramp: float) -> Trajectory:
    """The motion from `time` on: unchanged for `delay` [s], then slowed to rest in `braking` [s].

    While braking, the motion's time passes with a speed that falls from 1 to 0. The deceleration of this
    speed is a trapezoid: it rises for `ramp` of the braking time, is constant, and falls for `ramp`.
    """
    # before braking, the motion's own rows are kept: with other rows, its cubics would differ
    after = motion.times - time
    unchanged = after[(after > LEAST_STEP) & (after < delay - LEAST_STEP)]
    slowed = np.linspace(delay, delay + braking, int(braking / ROW_TIME) + 2)
    times = np.unique([0.0, *unchanged, *slowed])
    scale = max(braking, ROW_TIME)  # `braking` is 0 if the motion does not brake
    u = np.maximum(times - delay, 0.0) / scale
    slowing, loss, lost_time = _braking(ramp)
    passed = times + braking * lost_time(u)  # time of the motion
    q, v, a, _ = motion.at(np.minimum(time + passed, motion.duration))
    speed = 1 + loss(u)[:, None]
    return Trajectory(motion.joint_names, times, q, v * speed, a * speed**2 + v * slowing(u)[:, None] / scale)


@lru_cache
def _braking(ramp: float) -> tuple[BSpline, BSpline, BSpline]:
    """Three functions of the passed fraction of the braking time, all negative: the derivative of the speed
    of the motion's clock, the change of this speed, and the integral of this change."""
    peak = 1 / (1 - ramp)
    slowing = BSpline([0, 0, ramp, 1 - ramp, 1, 1], np.array([0, -peak, -peak, 0]), 1)
    loss = slowing.antiderivative()
    return slowing, loss, loss.antiderivative()


def _within_limits(robot: Robot, motion: Trajectory) -> bool:
    start, end = motion.cubic_accelerations
    jerks = (end - start) / np.diff(motion.times)[:, None]
    limits = np.array([robot.acceleration, robot.acceleration, jerk_limits(robot)])
    return bool((np.abs([start, end, jerks]) <= (1 + LIMIT_TOLERANCE) * limits[:, None]).all())


PROBABILITY_BELOW = np.float32(0.1)
"""Assumed probability that an unknown voxel below the network's volume is occupied. About this share of the
unknown voxels within reach is occupied."""
NOTHING = Scene(())
DEFAULTS = ExplorerSettings()
QUICK_FRACTION = 0.2
"""Fraction of the time limit that a search gets if a view or another search may follow. For searches within
space seen free, it doubles with each view: the more space was seen, the likelier is a motion."""
TENTATIVE_MOTIONS = 2
"""Number of tentative motions among seen obstacles; views are planned for the motion that sweeps the least
unseen space."""
AT_GOAL = 1e-3
"""The arm is at a goal if every joint is within this of the goal [rad], [m] for prismatic joints."""
ARRIVED = VerifySettings(goal_tolerance=AT_GOAL)


class Explorer:
    """Takes an arm to goals through space that cameras see on the way; see the head of this file.

    Threads may share an Explorer: one call waits for another.
    """

    def __init__(
        self,
        robot: Robot,
        cameras: Sequence[ArmCamera] = (),
        scene: Scene = NOTHING,
        free_zone: Corners | None = None,
        settings: ExplorerSettings = DEFAULTS,
        seed: int = 0,
    ) -> None:
        """Begin with an empty map; `set_goal` and `observe` come next.

        Args:
            robot: The robot.
            cameras: The cameras on the arm, for which motions to viewpoints are planned. Views of other
                cameras can be observed as well.
            scene: Shapes that are known without views, such as the floor, in the frame of the base.
            free_zone: Low and high corner [2, 3] of a box in the frame of the base [m], such as the space
                around the arm's base. It counts as free unless a view finds something there; None: no box.
            settings: The policy for unseen space, and limits of time and views.
            seed: Seed of all random numbers, at least 0.

        Raises:
            InputError: For arguments of the wrong type or out of bounds.
        """
        check_robot(robot)
        check_type("cameras", cameras, (list, tuple), "a list of ArmCamera")
        for i, camera in enumerate(cameras):
            check_type(f"cameras[{i}]", camera, ArmCamera, "an ArmCamera")
            robot.link_frame(camera.link)  # raises InputError for a link that the robot lacks
        check_type("scene", scene, Scene, "a Scene")
        check_type("settings", settings, ExplorerSettings, "ExplorerSettings")
        self.robot = robot
        self.cameras = tuple(cameras)
        self.scene = scene
        self.settings = settings
        self.map = OccupancyMap(robot, settings.max_age)
        if free_zone is not None:
            self.map.declare_free(free_zone)
        self._planner = load_planner("robotdiffuse")
        self._seed = converted("seed", Natural, seed)
        self._rng = np.random.default_rng(seed)
        on_arm = [(camera.link, camera.T_link_camera) for camera in cameras]
        self._poses = PoseRefinement(robot, scene, on_arm)
        self._views = ViewMemory(robot)
        self._goal_seen = GoalSeen(robot, self.map, self._views, settings.see_goal)
        self._goal: Goal | None = None
        self._views_taken = 0
        self._looked_for = np.zeros(MAP.shape, np.bool_)
        """The voxels that views since `set_goal` should have shown."""
        self._way_in: Configurations | None = None
        """Waypoints of the latest motion that was returned."""
        self._news = list[DepthView]()
        """Views since the latest step."""
        self._fixed_view: DepthView | None = None
        """The latest view of a camera that is not on the arm, if one came since the last call of `next`."""
        self._free = self.map.free
        """Voxels that were free at the latest step."""

    @locked
    def set_goal(self, goal: ArrayLike | Goal) -> None:
        """Set the next goal. The map and the views are kept.

        Args:
            goal: Configurations or poses, as `rd.Problem` accepts them.

        Raises:
            InputError: For a goal that does not fit the robot.
        """
        self._goal = Problem(self.robot, NOTHING, self.robot.middle, goal).goal
        self._views_taken = 0
        self._looked_for[:] = False
        self._goal_seen.forget()

    @locked
    def observe(self, view: DepthView, stamp: float = 0.0) -> None:
        """Take a view into account.

        Args:
            view: A depth image, with the pose of its camera and the configuration of the arm at the exposure.
            stamp: Time of the exposure [s]. What a view showed is forgotten once it is older than the latest
                view by more than `max_age`.

        Raises:
            InputError: For a view that does not fit the robot, whose depths are not in meters, whose
                intrinsics do not fit its image, or that sees through the arm, and for a stamp that is no
                finite number.
        """
        check_type("view", view, DepthView, "an rd.DepthView")
        stamp = converted("stamp", Number, stamp)
        q = self.map.configuration_of(view)
        wrong = implausible(view)
        if not wrong and self._camera_of(view) is None:
            wrong = contradiction(view, self.robot, q)
        if wrong:
            raise InputError(f"check the camera of the view: {wrong}")
        stated = view
        view = self._poses.observe(view)
        new_voxels = self.map.add(view, stamp)
        self._views.add(view, new_voxels, stated, stamp, self.map.oldest)
        self._goal_seen.observe(view)
        self._news.append(view)

    @locked
    def next(self, configuration: ArrayLike) -> Step:
        """Choose the next step of the arm, which must be at rest.

        Args:
            configuration: The arm's present configuration [dof].

        Returns:
            A step of the kind `go`, `look`, `done` or `stuck`, with its motion and the reason.

        Raises:
            InputError: Before `set_goal`, and for values that are no configuration of the robot.
        """
        if self._goal is None:
            raise InputError("there is no goal; call set_goal first")
        q = vector("explorer", "configuration", configuration, self.robot.dof)
        fixed_views = [view for view in self._news if self._camera_of(view) is None]
        self._fixed_view = fixed_views[-1] if fixed_views else None
        self._news = []
        if goal_error(self.robot, self._goal, q, ARRIVED) is None:
            return Step(DONE, "the arm is at the goal")
        if not len(self._views):
            return Step(LOOK, "nothing was seen yet: observe a view from here")
        goals = self._goal.positions if isinstance(self._goal, JointGoal) else q[None]
        self._views.refine(self._poses.refined)
        points, errors = self._views.points(self.map.free)
        # free voxels within the error of a seen point count as unknown
        self.map.doubt(points, errors.sum(axis=1))
        self._free = self.map.free
        self._seed += TENTATIVE_MOTIONS  # so that the searches of each step differ
        policies = (
            (STRICT, PROBABILISTIC)
            if self.settings.policy == STRICT_THEN_PROBABILISTIC
            else (self.settings.policy,)
        )
        step = Step(STUCK, "")
        for policy in policies:
            # the strict policy need not enlarge points: in the map, space within their error is not free
            enlarged = policy != STRICT
            shapes = point_shapes(points, self.robot, self.scene, q, goals, errors, enlarged)
            problem = Problem(self.robot, added(self.scene, shapes), q, self._goal)
            step = replace(self._step(problem, policy), seen=problem.scene)
            if step.kind != STUCK:
                break
        self._views_taken += step.kind == LOOK
        if step.motion is not None:
            self._way_in = step.motion.path.positions
        return step

    @locked
    def wanted(self, path: Path) -> Voxels:
        """Mark the voxels that views should show.

        Args:
            path: A tentative motion.

        Returns:
            True [nx, ny, nz] for the unknown voxels that the motion sweeps and, if the goal must be seen, for
            the unseen voxels at the arm's surface at the goal.
        """
        return swept_unseen(self.map, path) | self._goal_seen.wanted(path)

    @locked
    def stop(self, motion: Trajectory, time: float) -> Stop | None:
        """End a motion under way early, if an obstacle in its way was seen since `next` returned the motion.
        After the stop, call `next` again.

        The stop is within the robot's limits of velocity, acceleration and jerk.

        Args:
            motion: The motion under way.
            time: When a new command takes effect: time since the start of the motion [s].

        Returns:
            The earliest stop on the same path; None if nothing is in the way.

        Raises:
            InputError: For a time outside of the motion, and for anything but a motion of the robot.
        """
        check_type("motion", motion, Trajectory, "a Trajectory, such as step.motion.trajectory")
        if motion.joint_names != self.robot.joint_names:
            raise InputError(
                f"motion has the joints {joined(motion.joint_names)}; {self.robot.name}'s are"
                f" {joined(self.robot.joint_names)}"
            )
        time = converted("time", Number, time)
        if not 0 <= time <= motion.duration:
            raise InputError(
                f"time is {shown(time)}; it must be in [0, {motion.duration:.4g}] s of the motion"
            )
        robot = self.robot
        current = motion.at(time).positions
        end = motion.positions[-1]
        seen = seen_shapes(self._news, robot, self.scene, current, end[None])
        # points in space that was free before belong to an object that appeared; they are padded, since only
        # the object's front is seen
        points = np.concatenate([np.zeros((0, 3)), *(shape.points for shape in seen)])
        new = points[MAP.enclose(self._free, points, MAP.edge)]
        appeared = PointCloud(new, APPEARED_PADDING, name="appeared")
        validator = verifier(Problem(robot, added(self.scene, [*seen, appeared]), current, end))
        remaining = np.vstack([current, motion.positions[motion.times > time]])
        violation = validator.path(Path(robot.joint_names, remaining)).violation
        if violation is None:
            return None
        stop = braked(robot, motion, time)
        return Stop(time, stop, violation.message, validator.collision_free(stop))

    def _step(self, problem: Problem, policy: str) -> Step:
        if policy == STRICT and isinstance(problem.goal, JointGoal):
            goals = [q for q in problem.goal.positions if not reaches_outside(self.robot, q)]
            if not goals:
                return Step(STUCK, "at the goal the arm reaches out of the map", policy)
            problem = replace(problem, goal=JointGoal(np.stack(goals)))
        if self.settings.see_goal:
            joint_goals = self._goals(problem)
            if isinstance(joint_goals, PlanResult):
                return Step(STUCK, joint_goals.reason, policy)
            problem = replace(problem, goal=JointGoal(self._goal_seen.best(problem.start, joint_goals)[None]))
        predicted = self.predicted() if policy == PROBABILISTIC else None
        may_look = bool(self.cameras) and self._views_taken < self.settings.max_views
        limit = quick = self.settings.time_limit
        if may_look and policy == STRICT:  # a short search; a view may show more free space
            quick = min(QUICK_FRACTION * limit * 2**self._views_taken, limit)
        motion = self._motion(problem, policy, predicted, quick, may_look)
        go = self._go(motion, policy)
        if go is not None:
            return go
        look = self._look(problem, policy, predicted, motion)
        skipped = may_look and policy == STRICT and motion.status is Status.NO_PATH
        # if no view can be taken, search for the whole time limit, even if too little was seen free
        if look.kind == STUCK and (quick < limit or skipped):
            return self._go(self._motion(problem, policy, predicted, limit), policy) or look
        return look

    def _keeps(self, motion: PlanResult, policy: str) -> bool:
        if not motion.solved or policy == STRICT:
            return motion.solved
        return motion.confidence is not None and motion.confidence >= self.settings.confidence

    def _go(self, motion: PlanResult, policy: str) -> Step | None:
        """The step that executes a motion; None if the motion does not keep to the policy, or if its goal
        must be seen first."""
        if not self._keeps(motion, policy) or self._goal_seen.missing(motion):
            return None
        stated = motion.confidence  # None for strict motions
        free = "that stays in space seen free"
        if stated is not None:
            free = f"that is free with a probability of {stated:.3f}"
        return Step(GO, f"a motion {free}", policy, motion, stated)

    def _look(
        self,
        problem: Problem,
        policy: str,
        predicted: Probabilities | None,
        motion: PlanResult,
    ) -> Step:
        """The step if `_go` refused the result of the search for a motion under the policy.

        GO if a tentative motion keeps to the policy. If not, LOOK: at the unseen space that this motion
        sweeps, or from farther back on the way in. STUCK, with the reason, if no such view can be taken.

        motion: this result: a failed one, or a motion to the goal that does not keep to the policy or whose
        goal must be seen first.
        """
        why = self._goal_seen.missing(motion) or motion.reason
        if motion.solved and policy == PROBABILISTIC:
            why = "the motion has no confidence, since nothing was measured"
            if motion.confidence is not None:
                why = (
                    f"the motion's confidence is {motion.confidence:.2f}, below {self.settings.confidence:g}"
                )
        if not self.cameras:
            return Step(STUCK, f"{why}; no camera is on the arm to look with", policy)
        if self._views_taken >= self.settings.max_views:
            return Step(STUCK, f"{why}, after {counted(self._views_taken, 'view')}", policy)
        path = motion.path
        tentative, to_view = self._least_unseen(problem) if path is None else (motion, self.wanted(path))
        if tentative.path is None:
            return Step(STUCK, f"no motion among what was seen: {tentative.reason}", policy)
        safe_motion = None
        safe_policy = policy
        if policy == PROBABILISTIC and predicted is not None:
            safe_motion = self._with_confidence(tentative, predicted)
        elif not to_view.any():
            safe_motion = self._within_seen_free(problem, tentative.path.positions, "as seen")
            safe_policy = STRICT
        go = None if safe_motion is None else self._go(safe_motion, safe_policy)
        if go is not None:
            return go
        predicted = self.predicted() if predicted is None else predicted
        # The motion to a viewpoint is through space seen free if possible, under all policies. With
        # strict_then_probabilistic, the strict policy has tried this before the probabilistic one.
        policies = (STRICT, PROBABILISTIC) if self.settings.policy == PROBABILISTIC else (policy,)
        for look_policy in policies:
            look = self._way_to_look(problem, look_policy, to_view, predicted)
            if look is not None:
                self._looked_for |= to_view
                why += "; look at unseen space on the way"
                return Step(LOOK, why, look_policy, look, look.confidence, wanted=to_view)
        back = self._way_back(problem) if STRICT in policies else None
        if back is not None:
            return Step(LOOK, f"{why}; go back on the way in and look from there", STRICT, back)
        return Step(STUCK, f"{why}; no viewpoint that would help can be reached", policy)

    def _way_to_look(
        self,
        problem: Problem,
        policy: str,
        wanted: Voxels,
        predicted: Probabilities | None,
    ) -> PlanResult | None:
        """A motion under a policy to one of the viewpoints from which a camera sees the most wanted voxels;
        None if no motion was found."""
        allowed = self._seen_free(problem) if policy == STRICT else problem
        tree = ReachableTree(self.robot, allowed.scene, problem.start)
        way_in = self._way_in_to(problem.start)
        # the arm cannot go back far along its latest motion: there is none, or it was short
        hemmed_in = way_in is None or bool(moved(self.robot, way_in[:1], [problem.start])[0] < CONFINED)
        goal_views = self._goal_seen.taken
        arguments = wanted, predicted, self._rng, goal_views, hemmed_in, self._fixed_view
        paths = best_viewpoints(self.map, tree, self.cameras, *arguments)
        for waypoints in islice(paths, len(self.cameras) * self.settings.look_attempts):
            if policy == STRICT:
                motion = self._along(allowed, waypoints, "look")
            else:
                look = replace(problem, goal=JointGoal(waypoints[-1:]))
                motion = self._probabilistic(look, predicted, self.settings.time_limit, to_goal=False)
            if motion is not None and self._keeps(motion, policy):
                return motion
        return None

    def _camera_of(self, view: DepthView) -> int | None:
        """The index of the arm's camera that took a view; None for a camera that is not on the arm."""
        q = view.configuration
        assert q is not None  # the map takes no other views
        return self._poses.mount(view.T_base_camera, q)

    def _way_in_to(self, q: Configuration) -> Configurations | None:
        """Waypoints of the latest motion that was returned, if it ended at this configuration."""
        path = self._way_in
        return path if path is not None and np.abs(path[-1] - q).max() <= AT_GOAL else None

    def _way_back(self, problem: Problem) -> PlanResult | None:
        """A motion back along the latest motion, on the shortest part that is accepted; None without one."""
        way_in = self._way_in_to(problem.start)
        if way_in is None:
            return None
        for waypoints in first_parts(way_in[::-1]):
            motion = self._within_seen_free(problem, waypoints, "back on the way in")
            if motion is not None:
                return motion
        return None

    def _within_seen_free(self, problem: Problem, waypoints: Configurations, name: str) -> PlanResult | None:
        """The motion along waypoints, if the validator accepts it within space seen free; else None."""
        return self._along(self._seen_free(problem, waypoints[-1]), waypoints, name)

    def _seen_free(self, problem: Problem, *goals: Configuration) -> Problem:
        """The problem with obstacles that cover all space not seen free, except near the start and the
        goals."""
        obstacles = not_seen_free(self.map, self.scene, problem.start, goals)
        return replace(problem, scene=added(problem.scene, obstacles))

    def _along(self, problem: Problem, waypoints: Configurations, name: str) -> PlanResult | None:
        """The motion along waypoints, if the validator accepts it in the problem's scene; else None."""
        problem = replace(problem, goal=JointGoal(waypoints[-1:]))
        result = self._context(problem).finish(waypoints, name, name)
        return None if result is None else replace(result, problem=problem)

    def _context(self, problem: Problem, seed: int = 0) -> PlanningContext:
        request = PlanRequest(self.settings.time_limit, seed, FIRST)
        return PlanningContext(self._planner.name, problem, request)

    def _least_unseen(self, as_seen: Problem) -> tuple[PlanResult, Voxels]:
        """A motion among seen obstacles, and the unseen voxels on it that views should show.

        Several motions are planned; the one that sweeps the least unseen space is returned, or a failed
        result if none was found. If possible, motions avoid occupied voxels, and voxels that earlier views
        failed to show.
        """
        goals = as_seen.goal.positions if isinstance(as_seen.goal, JointGoal) else ()
        ends = near_ends(self.map, (as_seen.start, *goals))
        not_shown = self._looked_for & self.map.unknown
        blocked = surface((self.map.occupied | not_shown) & ~ends)
        name = "occupied, or looked for in vain"
        avoided = cover(self.map, self.scene, MAP.centers(blocked), MAP.edge, name)
        avoiding = replace(as_seen, scene=added(as_seen.scene, [avoided]))
        results = list[tuple[PlanResult, Voxels]]()
        for attempt in range(TENTATIVE_MOTIONS):
            result = self._planned(avoiding, QUICK_FRACTION * self.settings.time_limit, attempt)
            if result.path is None and not any(earlier.solved for earlier, _ in results):
                avoiding = as_seen
                result = self._planned(as_seen, self.settings.time_limit, attempt)
            # without a path, the voxels are not used
            unseen = ends if result.path is None else self.wanted(result.path)
            results.append((result, unseen))
            if result.path is not None and not unseen.any():
                break
        solved = [(result, unseen) for result, unseen in results if result.path is not None]
        return min(solved, key=lambda pair: int(pair[1].sum()), default=results[-1])

    def _motion(
        self,
        problem: Problem,
        policy: str,
        predicted: Probabilities | None,
        limit: float,
        may_look: bool = False,
    ) -> PlanResult:
        """A motion to the problem's goal under a policy, found within a time limit [s].

        may_look: whether the arm may look first. A strict motion is then not searched for if too little of
        the space at the goal was seen free.
        """
        if policy == PROBABILISTIC:
            return self._probabilistic(problem, predicted, limit)
        goals = self._goals(problem)
        if isinstance(goals, PlanResult):
            return goals
        goal = least_unknown(self.map, goals)
        if may_look and hardly_seen(self.map, problem.start, goal):
            why = "too little of the space around the goal was seen free"
            return self._context(problem).fail(Status.NO_PATH, why)
        result = self._planned(replace(self._seen_free(problem, goal), goal=JointGoal(goal[None])), limit)
        if result.solved:
            return result
        why = "" if result.status is Status.TIMEOUT else f": {result.reason}"
        return replace(result, reason=f"no motion that stays in space seen free was found{why}")

    def _probabilistic(
        self, problem: Problem, predicted: Probabilities | None, limit: float, to_goal: bool = True
    ) -> PlanResult:
        """A motion among seen and predicted obstacles, with its confidence.

        to_goal: whether the problem's goal is that of the Explorer; otherwise it is a viewpoint.
        """
        assumed_problem = replace(problem, unknown=PADDED if predicted is None else PREDICTED)
        goals = problem.goal.positions if to_goal and isinstance(problem.goal, JointGoal) else ()
        unknown = self._unknown((problem.start, *goals), predicted)
        above = None if predicted is None else predicted[:, :, LAYERS_BELOW:]
        request = PlanRequest(limit, self._seed, FIRST)
        result = plan_with_unknown_space(self._planner, assumed_problem, request, above, unknown)
        return replace(self._with_confidence(result, predicted, to_goal), problem=assumed_problem)

    def _with_confidence(
        self, motion: PlanResult, predicted: Probabilities | None, to_goal: bool = True
    ) -> PlanResult:
        """The motion with its confidence, from the summed probability of the voxels that it sweeps. The
        confidence is None if the map holds no measurement. Without a path or a prediction, the motion is
        returned unchanged.

        The arm counts as free of collision at the start of a motion and at the goal, but not at a viewpoint.
        """
        if motion.path is None or predicted is None:
            return motion
        ends = motion.path.positions[[0, -1] if to_goal else [0]]
        swept = self._unknown(ends, predicted).crossed(motion.path).risk
        stated = None if swept is None or self.map.is_blind else probability_free(swept, EXPLORED)
        return replace(motion, swept_probability=swept, confidence=stated)

    def _unknown(self, ends: Iterable[Configuration], predicted: Probabilities | None) -> UnknownSpace:
        """The unknown voxels of the map, except voxels that the arm fills at the configurations `ends`."""
        lost = None
        if predicted is None:
            # regions on rays without a return; without a prediction, the planner's confidence depends on them
            lost = np.pad(lost_regions(self._views.volume()), ((0, 0), (0, 0), (LAYERS_BELOW, 0)))
        return UnknownSpace(self.robot, ends, self.map.unknown, predicted, 0.0, MAP, lost)

    def _planned(self, problem: Problem, limit: float, attempt: int = 0) -> PlanResult:
        compile_scene_for(self.robot, problem.scene)  # compile now, outside the time limit
        return self._planner.plan(problem, limit, self._seed + attempt, FIRST)

    def _goals(self, problem: Problem) -> Configurations | PlanResult:
        """The goal configurations, or the result that says why there is none."""
        if isinstance(problem.goal, JointGoal):
            return problem.goal.positions
        # with see_goal, a constant seed gives the same goals at each step, so that views add up
        seed = 0 if self.settings.see_goal else self._seed
        usable = usable_start_goal(self._context(problem, seed))
        return usable if isinstance(usable, PlanResult) else np.stack(usable.goals)

    @locked
    def predicted(self) -> Probabilities | None:
        """Predict occupancy by the completion network.

        Returns:
            The probability [nx, ny, nz] that each voxel is occupied. It is 0 in voxels that the map knows to
            be free, and 1 near an object that appeared, until a view shows the voxel again. None if the
            settings exclude the network, if the network does not cover the arm's reach, and before the first
            view.
        """
        if not (len(self._views) and self.settings.predict):
            return None
        from robotdiffuse.learning.completion import covers, predict

        if not covers(self.robot):
            return None
        below = ((0, 0), (0, 0), (LAYERS_BELOW, 0))
        probability = np.pad(predict(self._views.volume()), below, constant_values=PROBABILITY_BELOW)
        return np.where(self.map.free, np.float32(0), np.maximum(probability, self.map.stale))
