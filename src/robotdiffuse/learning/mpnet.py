"""MPNet's networks: Enet, which encodes the obstacles, and Pnet, which predicts the next step to the goal.

A. Qureshi, Y. Miao, A. Simeonov and M. Yip, "Motion Planning Networks: Bridging the Gap Between
Learning-based and Classical Motion Planners", T-RO 2020. Enet is a contractive auto-encoder of the obstacles'
point cloud; its code is z. Pnet is a perceptron from (z, a configuration, the goal) to the next waypoint,
learned from planned paths in both directions. Pnet's dropout stays on in planning, which makes MPNet's paths
random. The planner that uses these networks is `baselines.mpnet`.

Differences from the paper:

- Enet and Pnet are smaller, so that they train in an hour of one core; the settings name the paper's sizes.
- The paper trains Enet either as an auto-encoder or end to end with Pnet. Here a run begins with the
  auto-encoder and continues end to end: a code z that is trained only for reconstruction loses details that
  decide whether the arm collides, and training end to end is cheap, as the waypoints of a trajectory share
  their z.
- The paper's clouds list the obstacles in a fixed order, which a sensed cloud lacks. So points are sorted
  along a space-filling curve: neighbors in the list are neighbors in space, and a perceptron can average
  them.
- The contractive penalty is that of S. Rifai et al., "Contractive auto-encoders", ICML 2011, as the text of
  MPNet's paper says; the equation in MPNet's paper has a sum of squared weights in place of it.
- Pnet outputs the step to the next waypoint, in units of the data's steps, instead of the waypoint. So
  dropout disturbs only the step, not the arm's current configuration.
- Dropout drops a quarter of the outputs of Pnet's hidden layers, not half, so that these narrower layers keep
  about as many outputs as in the paper. With half dropped, Pnet learns far less in this shorter training.
- A training sample is a random waypoint of a trajectory of the data and the one about 0.7 rad further on
  (the paper: neighboring vertices of optimized RRT* paths). On average, 0.7 rad is a sixth of a path, and a
  path of such straight steps is 0.3 % shorter. The step has the same length everywhere but at the goal; if it
  were a fraction of the path's length, the same inputs could have different targets.
- Half of the samples have a random later waypoint as their goal, since bidirectional planning and replanning
  need steps to such goals.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, ClassVar

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32
from numpy import ndarray
from torch import Generator, Tensor, nn

from robotdiffuse.core.errors import InputError
from robotdiffuse.core.settings import (
    Count,
    Natural,
    NotNegative,
    Positive,
    Settings,
    ShareBelowOne,
    Sizes,
)
from robotdiffuse.datasets.surface_clouds import surface_clouds
from robotdiffuse.learning.encoders import curve_keys
from robotdiffuse.learning.network import Scalar
from robotdiffuse.learning.training.batches import TrajectoryData, fast_autocast, torch_generator
from robotdiffuse.learning.training.tasks import BaselineNetwork
from robotdiffuse.learning.weight_files import RobotIdentity
from robotdiffuse.scenes.surface_points import PANDA_REGION, VisibleRegion

Clouds = Float[Tensor, "batch points 3"]
Configurations = Float[Tensor, "batch dof"]
CURVE_REACH = 16.0
"""Points are scaled so that the region's reach is this [m] before they are sorted along a space-filling
curve, whose cells have a fixed size."""
PRETRAINING = 0.1
"""Share of the training, at its beginning, in which Enet is trained as an auto-encoder."""
SUB_GOALS = 0.5
"""Share of the samples whose goal is a random later waypoint of the trajectory, instead of its last one."""
TRIVIAL_SHARE = 0.15
"""Share of the training trajectories that are trivial: the straight line from start to goal is free."""


@dataclass(frozen=True)
class MPNetSettings(Settings, name="mpnet"):
    points: Count = 320
    """Number of points of Enet's input cloud (paper: 1,400, for scenes in two dimensions)."""
    encoder_layers: Sizes = (384, 256, 128)
    """Widths of Enet's layers between the cloud and z (paper: 512, 256, 128)."""
    decoder_layer: Count = 128
    """Size of the only layer between z and the reconstruction, used only in training (paper: the mirror image
    of Enet)."""
    code: Count = 60
    """Size of z (paper: 28, for scenes in two dimensions)."""
    contraction: NotNegative = 1e-3
    """lambda, the weight of the contractive penalty [m^4]."""
    layers: Sizes = (768, 640, 512, 384, 320, 256, 192, 128, 128, 64, 32)
    """Widths of Pnet's layers (paper: 1280, 1024, 896, 768, 512, 384, 256, 256, 128, 64, 32)."""
    dropout: ShareBelowOne = 0.25
    """Share of the outputs of Pnet's layers that is dropped, in planning and training (paper: 0.5, of wider
    layers)."""
    steady_layers: Natural = 2
    """Number of Pnet's last layers without dropout (paper: nearly all layers have dropout)."""
    step: Positive = 0.7
    """Distance along the path from one waypoint to the next [rad, joint-space L2]."""
    waypoints: Count = 8
    """Number of training samples from each trajectory; they share z."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.steady_layers > len(self.layers):
            raise InputError(
                f"mpnet.steady_layers is {self.steady_layers}; it must be at most {len(self.layers)}, "
                "the number of mpnet.layers"
            )


class MPNetNetwork(BaselineNetwork):
    """Enet with its decoder, and Pnet."""

    training_defaults: ClassVar[dict[str, Any]] = {"batch": 1024}
    settings: MPNetSettings
    region: VisibleRegion = PANDA_REGION
    """The region in which points on obstacles count."""

    def __init__(self, robot: RobotIdentity, settings: MPNetSettings | None = None) -> None:
        super().__init__(robot, settings or MPNetSettings())
        settings = self.settings
        sizes = (3 * settings.points, *settings.encoder_layers, settings.code)
        self.encoder = Perceptron(sizes)
        self.decoder = Perceptron((settings.code, settings.decoder_layer, sizes[0]))
        self.policy = Perceptron(
            (settings.code + 2 * self.dof, *settings.layers, self.dof),
            settings.dropout,
            len(settings.layers) - settings.steady_layers,
        )
        self.register_buffer("step_scale", torch.tensor(0.1))
        self.step_scale: Tensor

    def fit_statistics(self, data: TrajectoryData) -> None:
        """Set the unit of Pnet's output: the root mean square of the steps between waypoints."""
        if len(data):
            rng = np.random.default_rng(0)
            current, following, _ = self.training_samples(data.q[data.draw(5_000, TRIVIAL_SHARE, rng)], rng)
            step = self.normalizer.to_unit(following) - self.normalizer.to_unit(current)
            self.step_scale.fill_(max(float(np.sqrt(np.mean(step**2))), 1e-3))

    def encode(self, cloud: Clouds) -> Float[Tensor, "batch code"]:
        """z of clouds of `settings.points` points in any order [m]; all zeros: no obstacles."""
        return self.encoder(sorted_along_curve(cloud, self.region).flatten(1))

    def next_states(
        self,
        z: Float[Tensor, "batch code"],
        q: Configurations,
        goal: Configurations,
        generator: Generator | None,
    ) -> Configurations:
        """The next waypoints from q to the goal, within the joint limits [rad].

        Dropout is drawn from the generator, in training and evaluation mode alike; None: without dropout.
        """
        x = self.to_unit(q)
        target = self.to_unit(goal)
        step = self.policy(torch.cat([z, x, target], 1), generator)
        return self.from_unit((x + self.step_scale * step).clamp(-1, 1))

    def generator(self, seed: int) -> Generator:
        """Random numbers for dropout."""
        return Generator().manual_seed(seed)

    def code_of(self, cloud: Float32[ndarray, "points 3"]) -> Float[Tensor, "code"]:
        """z of a cloud, in planning."""
        with torch.inference_mode():
            return self.encode(torch.from_numpy(cloud)[None])[0]

    def proposals(
        self,
        z: Float[Tensor, "code"],
        q: Float32[ndarray, "n dof"],
        goal: Float32[ndarray, "n dof"],
        generator: Generator,
    ) -> Float32[ndarray, "n dof"]:
        """`next_states` for arrays in one scene, in planning."""
        with torch.inference_mode():
            pairs = torch.from_numpy(q), torch.from_numpy(goal)
            return self.next_states(z.expand(len(q), -1), *pairs, generator).numpy()

    def loss(self, data: TrajectoryData, count: int, fraction: float, rng: np.random.Generator) -> Scalar:
        """The auto-encoder's loss [m^2] in the first part of the training, then Pnet's, end to end through
        Enet.

        Each scene gives `waypoints` samples. Pnet's loss is the mean squared error of the steps, in units of
        the data's steps.
        """
        settings = self.settings
        generator = torch_generator(rng)
        rows = data.draw(max(1, count // settings.waypoints), TRIVIAL_SHARE, rng)
        cloud = surface_clouds(data.scenes[rows], settings.points, generator, region=self.region)
        with fast_autocast():
            if fraction < PRETRAINING:
                return self.autoencoder_loss(cloud, generator)
            z = self.encode(cloud).repeat_interleave(settings.waypoints, 0)
            q, following, goal = map(torch.from_numpy, self.training_samples(data.q[rows], rng))
            x = self.to_unit(q)
            target = self.to_unit(goal)
            step = self.policy(torch.cat([z, x.to(z), target.to(z)], 1), generator)
        target_step = (self.to_unit(following) - x) / self.step_scale
        return (step.float() - target_step).square().mean()

    @torch.enable_grad()
    def autoencoder_loss(self, cloud: Clouds, generator: Generator) -> Scalar:
        """The mean squared distance of points to their reconstructions plus lambda |dz / d cloud|^2 [m^2]."""
        flat = sorted_along_curve(cloud, self.region).flatten(1)
        flat.requires_grad_()
        z = self.encoder(flat)
        error = (self.decoder(z).float() - flat.detach()).view(len(cloud), -1, 3).square().sum(-1).mean()
        # with random signs s the mean of |J^T s|^2 is |J|^2 (M. Hutchinson 1990)
        signs = torch.empty_like(z).bernoulli_(0.5, generator=generator) * 2 - 1
        (slope,) = torch.autograd.grad(z, flat, signs, create_graph=True)
        return error + self.settings.contraction * slope.square().sum(1).mean()

    def training_samples(
        self, q: Float[ndarray, "scenes waypoints dof"], rng: np.random.Generator
    ) -> tuple[Float[ndarray, "n dof"], Float[ndarray, "n dof"], Float[ndarray, "n dof"]]:
        """Configurations, the waypoints one step after them, and goals [rad]. Each sample takes its
        trajectory in a random direction."""
        settings = self.settings
        last = q.shape[1] - 1
        spacing = np.linalg.norm(np.diff(q, axis=1), axis=2).mean(1)
        stride = np.clip(np.rint(settings.step / np.maximum(spacing, 1e-6)), 1, last).astype(np.int64)
        rows = np.repeat(np.arange(len(q)), settings.waypoints)
        n = len(rows)
        goal = np.full(n, last)
        near = rng.random(n) < SUB_GOALS
        goal[near] = 1 + (rng.random(int(near.sum())) * last).astype(np.int64)
        at = (rng.random(n) * goal).astype(np.int64)
        places = at, np.minimum(at + stride[rows], goal), goal
        back = rng.random(n) < 0.5
        current, following, end = (q[rows, np.where(back, last - place, place)] for place in places)
        return current, following, end


class Perceptron(nn.Module):
    """Linear layers with PReLUs between them."""

    def __init__(self, sizes: Sequence[int], dropout: float = 0.0, dropped_layers: int = 0) -> None:
        """Dropout follows the first `dropped_layers` activations."""
        super().__init__()
        self.dropout = dropout
        self.dropped_layers = dropped_layers
        linear = [nn.Linear(a, b) for a, b in pairwise(sizes)]
        activations = [nn.PReLU() for _ in sizes[1:-1]]
        self.linear, self.activations = nn.ModuleList(linear), nn.ModuleList(activations)
        for layer in linear[:-1]:
            nn.init.kaiming_normal_(layer.weight, a=0.25)
            nn.init.zeros_(layer.bias)

    def forward(
        self, x: Float[Tensor, "batch inputs"], generator: Generator | None = None
    ) -> Float[Tensor, "batch outputs"]:
        """The output; dropout is drawn from the generator, None: no dropout."""
        for i, activation in enumerate(self.activations):
            x = activation(self.linear[i](x))
            if generator is not None and i < self.dropped_layers:
                keep = torch.empty_like(x).bernoulli_(1 - self.dropout, generator=generator)
                x = x * keep / (1 - self.dropout)
        return self.linear[-1](x)


def sorted_along_curve(cloud: Clouds, region: VisibleRegion) -> Clouds:
    """The points in the order of a space-filling curve (G. Morton 1966), in the region's frame [m].

    Positions are relative to the region's center; an empty cloud, all zeros, stays zero.
    """
    filled: Bool[Tensor, "batch 1 1"] = (cloud != 0).flatten(1).any(1)[:, None, None]
    local = (cloud - torch.tensor(region.center).to(cloud)) * filled
    order = curve_keys(local * (CURVE_REACH / region.reach)).argsort(1)
    return local.gather(1, order[..., None].expand(-1, -1, 3))
