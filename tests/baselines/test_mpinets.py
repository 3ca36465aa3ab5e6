"""MPiNets: the grouping of points against brute force, the network's properties, roll-outs as a planner."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from helpers.panda import LEFT, PANDA, RIGHT
from helpers.refusals import refuses
from helpers.trainings import trained
from robotdiffuse import Box, Problem, Scene, Sphere, Status
from robotdiffuse.baselines.mpinets import MPiNets, MPiNetsSettings
from robotdiffuse.learning import mpinets
from robotdiffuse.learning.checkpoint import save_network
from robotdiffuse.learning.training.batches import TrajectoryData
from robotdiffuse.learning.weight_files import RobotIdentity
from robotdiffuse.scenes.scene_arrays import BOX, PackedScenes

RANGES = RobotIdentity.of(PANDA)
WALL = [0.45, 0.0, 0.25, 0.3, 0.05, 0.5, 1.0, 0.0, 0.0, 0.0]
SMALL = mpinets.MPiNetsNetworkSettings(
    scene_points=48, robot_points=4, target_points=2, centers=(24, 8), neighbors=(6, 4),
    first_widths=(16, 16), second_widths=(24, 32), all_widths=(48,), cloud_widths=(32, 16),
)  # fmt: skip


@pytest.fixture
def network() -> mpinets.MPiNetsNetwork:
    torch.manual_seed(0)
    return mpinets.MPiNetsNetwork(RANGES, SMALL).eval()


class Straight(mpinets.MPiNetsNetwork):
    def forward(self, clouds: torch.Tensor, q: torch.Tensor, goal: torch.Tensor) -> torch.Tensor:
        return q + (goal - q).clamp(-0.1, 0.1)


def line_data(walls: bool) -> TrajectoryData:
    ends = np.stack([LEFT, RIGHT])[[[0, 1], [1, 0]] * 4] + np.random.default_rng(3).uniform(-0.05, 0.05, (8, 2, 7))
    share = np.linspace(0, 1, 24)[:, None]
    q = (ends[:, :1] * (1 - share) + ends[:, 1:] * share).astype(np.float32)
    kinds = np.full((8, 1), BOX if walls else 0, np.int8)
    params = np.tile(np.array(WALL, np.float32), (8, 1, 1)) * walls
    return TrajectoryData(q, PackedScenes(kinds, params), np.zeros(8, bool), None, "", 0)


def clouds_of(network: mpinets.MPiNetsNetwork, count: int, seed: int = 0) -> torch.Tensor:
    return network.clouds(line_data(True).scenes[:count], np.random.default_rng(seed))


@pytest.mark.parametrize("points", [20, 300])
def test_grouping_is_that_of_brute_force(points: int) -> None:
    cloud = np.random.default_rng(points).normal(size=(3, points, 3)).astype(np.float32)
    count = 12
    most = 7
    radius = 0.8
    centers, around = mpinets.group_points(torch.from_numpy(cloud), count, most, radius)
    for x, chosen, near in zip(cloud.astype(np.float64), centers, around, strict=True):
        distance = np.linalg.norm(x[:, None] - x[None], axis=2)
        expected = [int(np.linalg.norm(x - x.mean(0), axis=1).argmax())]
        while len(expected) < count:
            expected.append(int(distance[expected].min(0).argmax()))
        assert chosen.tolist() == expected
        for center, found in zip(chosen, near, strict=True):
            order = np.argsort(distance[center])
            inside = order[distance[center][order] < radius][:most].tolist()
            assert found.tolist() == inside + [int(center)] * (most - len(inside))


def test_order_of_the_scene_points_makes_no_difference(network: mpinets.MPiNetsNetwork) -> None:
    cloud = clouds_of(network, 1)
    q, goal = torch.tensor(np.stack([LEFT, RIGHT]), dtype=torch.float32)[:, None]
    shuffled = cloud[:, torch.randperm(cloud.shape[1])]
    with torch.no_grad():
        assert torch.equal(network(cloud, q, goal), network(shuffled, q, goal))
        moved = network(cloud + torch.tensor([0.0, 0.0, 0.3]), q, goal)
    assert not torch.equal(network(cloud, q, goal), moved)


def test_samples_are_steps_of_the_motions(network: mpinets.MPiNetsNetwork) -> None:
    data = line_data(True)
    steps = network.draw(data, 200, np.random.default_rng(0))
    every = np.concatenate([data.q, data.q[:, ::-1]])
    for q, expert, goal in zip(steps.q.numpy(), steps.expert.numpy(), steps.goal.numpy(), strict=True):
        of = every[[bool((motion[-1] == goal).all()) and (motion == expert).all(1).any() for motion in every]]
        at = int((of[0] == expert).all(1).argmax())
        before = of[0][[at - 1, at]] if at == len(of[0]) - 1 else of[0][[at - 1]]
        assert np.abs(before - q).max(1).min() < 6 * SMALL.noise
    assert torch.unique(steps.goal, dim=0).shape[0] == 16


def test_loss_falls_on_few_motions() -> None:
    torch.manual_seed(0)
    network = mpinets.MPiNetsNetwork(RANGES, replace(SMALL, noise=0.0))
    data = line_data(False)
    rng = np.random.default_rng(0)
    network.fit_statistics(data)
    losses = trained(network, lambda _: network.loss(data, 24, 0.5, rng), 25, 3e-3)
    assert np.mean(losses[-5:]) < 0.8 * np.mean(losses[:5])
    assert all(parameter.grad is not None for parameter in network.parameters())


def test_a_path_in_collision_is_no_result(monkeypatch: pytest.MonkeyPatch) -> None:
    straight = Straight(RANGES, SMALL)
    monkeypatch.setattr(MPiNets, "network", lambda _self, _robot: straight)
    problem = Problem(PANDA, Scene([Box(WALL[:3], WALL[3:6])]), LEFT, RIGHT)
    MPiNets().plan(problem, 0.1, 1)  # compiles and loads
    result = MPiNets().plan(problem, 0.5, 1)
    assert result.status is Status.TIMEOUT and result.refused == "scene_collision"
    assert "is not valid" in result.reason


def test_trained_weights_are_read_and_the_same_seed_gives_the_same_path(tmp_path, network):
    save_network("mpinets", network, tmp_path, {})
    planner = MPiNets(MPiNetsSettings(weights=str(tmp_path), near=0.299))
    q = torch.tensor(LEFT[None], dtype=torch.float32)
    cloud = clouds_of(network, 1)
    # weights are stored in half precision
    assert torch.allclose(network(cloud, q, q), planner.network(PANDA)(cloud, q, q), atol=1e-3)
    # the untrained policy makes some steps before it is near enough by chance
    problem = Problem(PANDA, Scene([Sphere([0.0, 0.0, 1.5], 0.1)]), LEFT, LEFT + np.array([0.0, 0.0, 0.3, 0.0, 0.0, 0.0, 0.0]))
    paths = [planner.plan(problem, 20.0, seed).path for seed in (5, 5)]
    assert np.array_equal(paths[0].positions, paths[1].positions)
    assert len(paths[0].positions) > 2


def test_bad_network_settings() -> None:
    made = mpinets.MPiNetsNetworkSettings
    refuses("scene_points is 0", made, scene_points=0)
    refuses("target_points is 13; it must be at most robot_points, 12", made, target_points=13)
    refuses("centers is", made, centers=(64, 65))
    refuses("cloud_widths is", made, cloud_widths=(30, 16))
