"""MPiNets: a policy from a labeled point cloud to the arm's next step.

A. Fishman et al., "Motion Policy Networks", CoRL 2022. PointNet++ encodes one cloud of points of the scene,
of the robot at its current configuration q_t and of the target; a few layers encode q_t; both together are
decoded to a displacement, q_{t+1} = clamp(q_t + dq). Trained by behavior cloning on the steps of planned
motions, with the paper's two losses: the mean L1 and squared distances between points of the arm at the
predicted and at the expert's next configuration, and a hinge on the signed distance to the scene.

Settings as in the paper: configurations scaled by the joint ranges, and clamped at the limits; weights 1 and
5 of point match and collision; hinge at 3 cm; noise of 0.015 rad on the input; LeakyReLU in encoder and
decoder, group normalization in the layers after PointNet++ and none within it; layers 32, 64, 128, 128, 64
for the configuration and 512, 256, 128 for the decoder.

Differences from the paper:

- *Size*, for training on one core (the paper's numbers in brackets): a cloud of 256 points of the scene, and
  for each link 12 points of the robot and 6 of the target, 120 and 60 for a Panda (4,096, 2,048 and 128); two
  set abstractions with 96 and 24 centers (512 and 128), 16 neighbors (128), and balls of 0.2 and 0.6 m (0.05
  and 0.3 m), since the cloud is sparser; narrower layers (1,024 features in the last one of PointNet++, and
  4,096, 2,048 and 2,048 after it); batches of 128 at a learning rate of 2e-3 (10 at 1e-4); losses on the
  robot's points of the cloud (1,024 points).
- *Target*: a configuration, to be reached within 1e-4 rad; the paper's target is a pose of the hand. So the
  target's points are those of the whole arm at the goal, the direction to the goal configuration is a further
  input of the configuration encoder, and points are labeled by link, not only as scene, robot or target.
- The floor, which is part of every scene, is in the collision loss but not in the cloud.
- The collision loss is on the arm's covering spheres, which protrude a little, not on points.
- The expert's motions come from our data and have 48 waypoints (paper: 50), forwards or backwards, with one
  step at rest at the end.
- The decoder outputs displacements in units of the experts' root mean square step, and weights are
  initialized as in K. He et al. (ICCV 2015): with PyTorch's defaults, activations fade over the many layers,
  and training takes many times as long.
"""

from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Float32, Int64
from numpy import ndarray
from numpy.random import Generator
from torch import Tensor, nn

from robotdiffuse.core.errors import InputError
from robotdiffuse.core.settings import Count, NotNegative, Settings, Sizes
from robotdiffuse.datasets.surface_clouds import surface_clouds
from robotdiffuse.learning.encoders.networks import perceptron
from robotdiffuse.learning.network import Scalar
from robotdiffuse.learning.training.batches import TrajectoryData, fast_autocast, torch_generator
from robotdiffuse.learning.training.losses import ArmDistance, ForwardKinematics, SurfacePoints, hinge
from robotdiffuse.learning.training.tasks import BaselineNetwork
from robotdiffuse.learning.weight_files import RobotIdentity
from robotdiffuse.robots import load_robot
from robotdiffuse.scenes.packed_scenes import PackedScenes
from robotdiffuse.scenes.surface_points import VisibleRegion

Configurations = Float32[Tensor, "n dof"]
Clouds = Float32[Tensor, "n points 3"]
Joints = Float32[ndarray, "n dof"]
DIRECTION_OFFSET = 0.1
"""The direction to the goal is twice the vector to the goal, divided by the vector's length plus this [half
joint ranges], so that the direction fades near the goal."""
LOSS_UNIT = 0.01
"""Losses are divided by this [m], so that they are near 1."""
RADII = (0.2, 0.6)
"""Radii of the balls around centers [m] (paper: 0.05, 0.3)."""
JOINT_WIDTHS = (32, 64, 128, 128, 64)
"""Widths of the configuration encoder (the paper's)."""
DECODER_WIDTHS = (512, 256, 128)
"""Widths of the decoder (the paper's)."""
COLLISION_WEIGHT = 5.0
"""Weight of the loss on the distance to the scene, relative to that on points of the arm (the paper's)."""
MARGIN = 0.03
"""Distance to the scene below which the collision loss acts [m] (the paper's)."""
TRIVIAL_SHARE = 0.3
"""Share of the training samples from trivial motions: those with a free straight line from start to goal."""


@dataclass(frozen=True)
class MPiNetsNetworkSettings(Settings, name="mpinets"):
    scene_points: Count = 256
    """Number of points of the scene (paper: 4,096)."""
    robot_points: Count = 12
    """Number of points of each moving link at the current configuration (paper: 2,048 in all)."""
    target_points: Count = 6
    """How many of a link's `robot_points` are also given at the goal configuration (paper: 128 in all, of the
    gripper)."""
    region: VisibleRegion = field(default_factory=VisibleRegion)
    """The region in which points of the scene count."""
    centers: tuple[Count, Count] = (96, 24)
    """Number of centers of each of the two set abstractions (paper: 512, 128)."""
    neighbors: tuple[Count, Count] = (16, 16)
    """Number of points around each center (paper: 128, 128)."""
    first_widths: Sizes = (32, 32, 64)
    """Widths of the layers of the first set abstraction (paper: 64, 64, 64)."""
    second_widths: Sizes = (96, 128, 192)
    """Widths of the layers of the second set abstraction (paper: 128, 128, 256)."""
    all_widths: Sizes = (256, 512)
    """Widths of the layers on all points together (paper: 512, 512, 1,024)."""
    cloud_widths: tuple[Count, Count] = (512, 256)
    """Widths of the layers after PointNet++; the last one is the size of the embedding (paper: 4,096, 2,048,
    2,048)."""
    noise: NotNegative = 0.015
    """Standard deviation of the noise on the input configuration [rad] (the paper's)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.target_points > self.robot_points:
            raise InputError(
                f"mpinets.target_points is {self.target_points}; it must be at most robot_points, "
                f"{self.robot_points}"
            )
        if self.centers[0] > self.scene_points or self.centers[1] > self.centers[0]:
            raise InputError(
                f"mpinets.centers is {self.centers}; the first must be at most scene_points "
                f"({self.scene_points}), and the second at most the first"
            )
        if self.cloud_widths[0] % GROUPS:
            raise InputError(
                f"mpinets.cloud_widths is {self.cloud_widths}; the first must be a multiple of {GROUPS}"
            )


GROUPS = 16
"""Number of groups of the group normalization (the paper's)."""


class PooledLayers(nn.Module):
    """Linear layers with ReLUs, applied to each point separately; then the maximum over a group's points."""

    def __init__(self, channels: int, widths: tuple[int, ...]) -> None:
        super().__init__()
        *first, last = pairwise((channels, *widths))
        self.layers = nn.ModuleList(nn.Linear(*sizes) for sizes in first)
        self.last = nn.Linear(*last)

    def forward(self, x: Float[Tensor, "*groups points channels"]) -> Float[Tensor, "*groups width"]:
        for layer in self.layers:
            x = layer(x).relu()
        return self.last(x).amax(-2).relu()


class SetAbstraction(nn.Module):
    """A layer of PointNet++ without normalization (C. Qi et al., "PointNet++: Deep hierarchical feature
    learning on point sets in a metric space", NeurIPS 2017).

    It selects some of the points as centers, and computes features of each center from the nearest points in
    a ball around it. The authors take those points of the ball that are first in the cloud's order.
    """

    def __init__(
        self, channels: int, widths: tuple[int, ...], centers: int, neighbors: int, radius: float
    ) -> None:
        """channels: number of features of a point. widths: of the layers. radius: of the balls [m]."""
        super().__init__()
        self.centers = centers
        self.neighbors = neighbors
        self.radius = radius
        self.layers = PooledLayers(3 + channels, widths)

    def forward(
        self, points: Float[Tensor, "b n 3"], features: Float[Tensor, "b n channels"]
    ) -> tuple[Float[Tensor, "b m 3"], Float[Tensor, "b m width"]]:
        """The centers and their features; points and centers in [m]."""
        centers, around = group_points(points.detach(), self.centers, self.neighbors, self.radius)
        at = _rows(points, centers)
        offsets = (_rows(points, around) - at[:, :, None]) / self.radius
        return at, self.layers(torch.cat([offsets, _rows(features, around)], -1))


def group_points(
    points: Float[Tensor, "b n 3"], count: int, neighbors: int, radius: float
) -> tuple[Int64[Tensor, "b m"], Int64[Tensor, "b m k"]]:
    """Indices of centers, by furthest point sampling, and of the points around each.

    The first center is the point farthest from the mean; each further center is the point farthest from the
    centers so far. The points around a center are the nearest points within the radius, beginning with the
    center itself; if there are too few, the center is repeated. The result does not depend on the order of
    the points.
    """
    distances = torch.cdist(points, points, compute_mode="donot_use_mm_for_euclid_dist")
    clouds = torch.arange(len(points))
    chosen = (points - points.mean(1, keepdim=True)).norm(dim=-1).argmax(1)
    min_distances = torch.full_like(distances[:, 0], torch.inf)
    center_indices = list[Tensor]()
    for _ in range(count):
        center_indices.append(chosen)
        min_distances = torch.minimum(min_distances, distances[clouds, chosen])
        chosen = min_distances.argmax(1)
    centers = torch.stack(center_indices, 1)
    nearest = _rows(distances, centers).topk(min(neighbors, points.shape[1]), largest=False)
    return centers, torch.where(nearest.values < radius, nearest.indices, centers[..., None])


def _rows(values: Float[Tensor, "b n c"], at: Int64[Tensor, "b *m"]) -> Float[Tensor, "b *m c"]:
    """The rows of each cloud with the indices `at`."""
    return values[torch.arange(len(at)).view(-1, *[1] * (at.dim() - 1)), at]


class Steps(NamedTuple):
    """Training samples, each of them one step of a motion."""

    q: Configurations
    """The arm's configuration, with noise [rad]."""
    expert: Configurations
    """The next waypoint of the motion [rad]."""
    goal: Configurations
    clouds: Clouds
    """Clouds of the scenes [m]."""
    scenes: PackedScenes


class MPiNetsNetwork(BaselineNetwork):
    """The policy. It loads the robot, bundled or from its URDF, for the surface points and covering
    spheres."""

    training_defaults: ClassVar[dict[str, Any]] = {"batch": 128, "learning_rate": 2e-3}
    settings: MPiNetsNetworkSettings

    def __init__(self, robot: RobotIdentity, settings: MPiNetsNetworkSettings) -> None:
        super().__init__(robot, settings)
        s = settings
        kinematics = ForwardKinematics(load_robot(robot.source))
        # the same points every time, so that a checkpoint need not store them
        self._surface = SurfacePoints(kinematics, s.robot_points, np.random.default_rng(0))
        self._distance = ArmDistance(kinematics)
        arm_points = self._surface(torch.zeros(self.dof)).shape[0]
        links = arm_points // s.robot_points
        self._target = torch.arange(arm_points).view(links, -1)[:, : s.target_points].flatten()
        link_labels = 1 + torch.arange(links)
        scene = torch.zeros(s.scene_points, dtype=torch.int64)
        arm = link_labels.repeat_interleave(s.robot_points)
        target = links + link_labels.repeat_interleave(s.target_points)
        self._labels = nn.functional.one_hot(torch.cat([scene, arm, target]), 1 + 2 * links).float()
        """One-hot labels: scene, each link of the robot, each link of the target."""
        self.first = SetAbstraction(1 + 2 * links, s.first_widths, s.centers[0], s.neighbors[0], RADII[0])
        self.second = SetAbstraction(
            s.first_widths[-1], s.second_widths, s.centers[1], s.neighbors[1], RADII[1]
        )
        # the layers on all points together; their key `layers` is part of the names in saved weights
        self.together = nn.ModuleDict({"layers": PooledLayers(3 + s.second_widths[-1], s.all_widths)})
        cloud_width, code = s.cloud_widths
        self.cloud_code = nn.Sequential(
            nn.Linear(s.all_widths[-1], cloud_width),
            nn.GroupNorm(GROUPS, cloud_width),
            nn.LeakyReLU(),
            nn.Linear(cloud_width, code),
        )
        self.joint_code = perceptron(2 * self.dof, *JOINT_WIDTHS, activation=nn.LeakyReLU)
        last = nn.Linear(DECODER_WIDTHS[-1], self.dof)
        hidden = perceptron(code + JOINT_WIDTHS[-1], *DECODER_WIDTHS, activation=nn.LeakyReLU)
        self.decoder = nn.Sequential(hidden, nn.LeakyReLU(), last)
        for layer in self.modules():
            if isinstance(layer, nn.Linear):
                nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")
                nn.init.zeros_(layer.bias)
        nn.init.normal_(last.weight, std=0.01)
        self.register_buffer("step", torch.full((self.dof,), 0.02))
        self.step: Tensor
        """Root mean square step of the experts, in units of half the joint ranges."""

    def fit_statistics(self, data: TrajectoryData) -> None:
        """Set the size of the experts' steps."""
        steps = np.diff(self.normalizer.to_unit(data.q[:20_000]), axis=1)
        size = np.sqrt(np.square(steps).mean((0, 1)))
        self.step.copy_(torch.from_numpy(np.maximum(size, 1e-4)))

    def forward(
        self,
        clouds: Clouds,
        q: Configurations,
        goal: Configurations,
    ) -> Configurations:
        """The next configurations, within limits [rad]; clouds of the scenes [m], q and goal in [rad]."""
        points = torch.cat([clouds, self._surface(q), self._surface(goal)[:, self._target]], 1).detach()
        with fast_autocast():
            groups = self.first(points, self._labels.expand(len(q), -1, -1))
            together = self.together["layers"](torch.cat(self.second(*groups), -1))
            cloud_code = self.cloud_code(together)
        # in fp32, since bf16 would round configurations to a hundredth of a radian
        x = self.to_unit(q)
        to_goal = self.to_unit(goal) - x
        direction = 2 * to_goal / (to_goal.norm(dim=-1, keepdim=True) + DIRECTION_OFFSET)
        code = torch.cat([cloud_code.float(), self.joint_code(torch.cat([x, direction], -1))], -1)
        return self.from_unit((x + self.step * self.decoder(code)).clamp(-1, 1))

    def moved(self, clouds: Float32[ndarray, "n points 3"], q: Joints, goal: Joints) -> Joints:
        """`forward` for arrays, in planning; q is clipped to the limits [rad]."""
        within = self.normalizer.from_unit(self.normalizer.to_unit(q).clip(-1, 1))
        with torch.inference_mode():
            return self(*map(torch.from_numpy, (clouds, within, goal))).numpy()

    def loss(self, data: TrajectoryData, count: int, fraction: float, rng: Generator) -> Scalar:
        """The losses of point match and collision on one step of each of `count` motions, in units of
        `LOSS_UNIT`."""
        steps = self.draw(data, count, rng)
        q = self(steps.clouds, steps.q, steps.goal)
        error = self._surface(q) - self._surface(steps.expert)
        match = error.square().mean() + error.abs().mean()
        close = hinge(self._distance(q[:, None], steps.scenes), MARGIN).mean()
        return (match + COLLISION_WEIGHT * close) / LOSS_UNIT

    def draw(self, data: TrajectoryData, count: int, rng: Generator) -> Steps:
        """Random waypoints of random motions, forwards or backwards, and the waypoints that follow them."""
        rows = data.draw(count, TRIVIAL_SHARE, rng)
        last = data.q.shape[1] - 1
        direction = np.where(rng.random(count) < 0.5, 1, -1)
        waypoint = rng.integers(0, last + 1, count)
        waypoints = np.stack([waypoint, np.minimum(waypoint + 1, last), np.full(count, last)])
        q, expert, goal = data.q[rows, np.where(direction > 0, waypoints, last - waypoints)]
        q = q + self.settings.noise * rng.standard_normal(q.shape, dtype=np.float32)
        q = self.normalizer.from_unit(np.clip(self.normalizer.to_unit(q), -1, 1))
        scenes = data.scenes[rows]
        clouds = self.clouds(scenes, rng)
        current, after, end = map(torch.from_numpy, (q, expert, goal))
        return Steps(current, after, end, clouds, scenes)

    def clouds(self, scenes: PackedScenes, rng: Generator) -> Clouds:
        """Random clouds of scenes for the network's input [m]; zeros where nothing is in reach."""
        settings = self.settings
        return surface_clouds(scenes, settings.scene_points, torch_generator(rng), region=settings.region)
