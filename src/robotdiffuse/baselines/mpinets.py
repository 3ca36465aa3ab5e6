"""MPiNets: rolls out a policy, step by step (A. Fishman et al., "Motion Policy Networks", CoRL 2022).

The policy is a network (`learning.mpinets`). Its inputs are points of the scene, of the arm and of the arm at
the goal. It is rolled out from the start for at most 150 steps, as in the paper. The first roll-out is the
paper's planner: one point cloud, no noise, no repetition. Until time runs out, further roll-outs follow with
new point clouds and noise.

Differences from the paper, in addition to those of the network:

- The paper ends a roll-out within 1 cm and 15 degrees of the target pose. Here, a goal is a configuration
  that must be reached exactly. Near the goal, the motion continues on the straight line to it if that line is
  free; else the policy goes on. For a goal pose, the goals are configurations from inverse kinematics.
- The paper has one roll-out. The repetitions cannot lower the success rate, and they use the time that all
  planners get. They are distributed over the goals, the nearest first, and end where the arm collides.
- Motions are not repaired or shortened, and a motion that the validator refuses is not a result. If there is
  no valid motion, the best one is validated at the end, so that `refused` of the result says what is wrong
  with it.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from robotdiffuse.collision.kernels.motions import Space, motions_free
from robotdiffuse.collision.motions import search_space
from robotdiffuse.core.settings import Count, NotNegative, Positive
from robotdiffuse.core.types import Configuration, Configurations, PlanResult, nearest_first
from robotdiffuse.planning.context import PlanningContext
from robotdiffuse.planning.learned import LearnedPlanner, LearnedSettings, scene_clouds
from robotdiffuse.planning.start_goal import StartGoal

if TYPE_CHECKING:
    from robotdiffuse.learning.mpinets import MPiNetsNetwork

STANDSTILL = 1e-4
"""A roll-out ends when no joint moves further than this in a step [rad]: the policy would not move again."""


@dataclass(frozen=True)
class MPiNetsSettings(LearnedSettings, name="mpinets"):
    steps: Count = 150
    """Largest number of steps of a roll-out (the paper's)."""
    near: NotNegative = 0.3
    """The straight line to the goal is tried if no joint is further from the goal than this [rad]."""
    batch: Count = 8
    """Number of roll-outs that run at once; the very first one runs alone."""
    noise: NotNegative = 0.015
    """Standard deviation of the noise on the arm's configuration in the network inputs, as in training [rad].
    The very first roll-out has no noise."""
    resolution: Positive = 0.02
    """No point of the arm moves further than this between neighboring checked configurations [m]."""


class MPiNets(LearnedPlanner[MPiNetsSettings]):
    """The policy's roll-outs as a planner; see the head of this file."""

    name = network_name = "mpinets"
    settings_class = MPiNetsSettings

    def solve(self, context: PlanningContext, start_goal: StartGoal) -> PlanResult:
        """See `planning.planner.Planner`."""
        network = self.network(context.problem.robot)
        best: _Motion | None = None
        roll_outs = 0
        while best is None or context.remaining > 0:
            motions = self._roll_outs(context, network, start_goal, roll_outs)
            roll_outs += len(motions)
            for motion in motions:
                if motion.free:
                    result = context.finish(motion.path(start_goal), "policy")
                    if result is not None:
                        return result
                if best is None or motion.arrived > best.arrived:
                    best = motion
        # the validator checks the meshes, which are smaller than the covering spheres: the best motion may be
        # valid after all
        outcome = "reached the goal, but is not valid" if best.arrived else "did not reach the goal"
        return context.finish(best.path(start_goal), "policy") or context.unsolved(
            f"{roll_outs} roll-outs of the policy, the best of which {outcome}"
        )

    def _roll_outs(
        self,
        context: PlanningContext,
        network: "MPiNetsNetwork",
        start_goal: StartGoal,
        tried: int,
    ) -> "list[_Motion]":
        """Runs a batch of roll-outs until all have ended, one has reached the goal without a collision, or
        time runs out.

        `tried` is the number of earlier roll-outs. The very first roll-out goes on even if it collides.
        """
        settings = self.settings
        rng = context.rng
        first = tried == 0
        count = 1 if first else settings.batch
        space = search_space(start_goal.checker, settings.resolution)
        start, goals = start_goal.leads()
        goal = nearest_first(goals, start)[np.arange(tried, tried + count) % len(goals)]
        cloud = network.settings.region, network.settings.scene_points
        clouds = scene_clouds(start_goal.checker, *cloud, count, rng)
        motions = [_Motion(start, end) for end in goal]
        for step in range(settings.steps + 1):
            for motion in motions:
                motion.try_to_arrive(space, settings.near)
            if any(motion.free for motion in motions):
                break
            rows = [
                i
                for i, candidate in enumerate(motions)
                if candidate.moving and (first or not candidate.collided)
            ]
            if step == settings.steps or not rows or context.remaining <= 0:
                break
            q = np.stack([motions[i].waypoints[-1] for i in rows])
            noise = settings.noise * rng.standard_normal(goal.shape, dtype=np.float32)
            moved = network.moved(clouds[rows], q if first else q + noise[rows], goal[rows])
            for i, state in zip(rows, moved, strict=True):
                motions[i].go(space, state)
        return motions


class _Motion:
    """The motion of a roll-out up to its current step."""

    def __init__(self, start: Configuration, goal: Configuration) -> None:
        self.waypoints = [start]
        self.goal = goal
        self.collided = self.arrived = False
        self.moving = True
        """Whether the roll-out has neither arrived nor come to a standstill."""

    @property
    def free(self) -> bool:
        """Whether the motion reaches the goal without a collision of the covering spheres."""
        return self.arrived and not self.collided

    def go(self, space: Space, q: Configuration) -> None:
        """Adds the policy's next configuration."""
        step = np.stack([self.waypoints[-1], q])
        self.collided |= not motions_free(space, step)[0]
        self.moving = np.ptp(step, axis=0).max() >= STANDSTILL
        self.waypoints.append(q)

    def try_to_arrive(self, space: Space, near: float) -> None:
        """Adds the straight line to the goal if no joint is farther from the goal than `near` [rad], and the
        line is free."""
        edge = np.stack([self.waypoints[-1], self.goal])
        if self.moving and np.ptp(edge, axis=0).max() < near and motions_free(space, edge)[0]:
            self.waypoints.append(self.goal)
            self.arrived = True
            self.moving = False

    def path(self, start_goal: StartGoal) -> Configurations:
        """The waypoints of the motion in float64, with the exact start, and the exact goal if it was
        reached."""
        if self.arrived:
            return start_goal.complete(np.stack(self.waypoints))
        return np.vstack([start_goal.start, *(self.waypoints[1:] or self.waypoints)])
