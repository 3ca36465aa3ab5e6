"""MPNet: its auto-encoder, its training data, bidirectional planning, contraction and replanning; MPiNets: the grouping of
points against brute force, the network's properties, roll-outs as a planner."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from helpers.panda import LEFT, PANDA, RIGHT
from helpers.refusals import refuses
from helpers.trainings import trained
from robotdiffuse import Box, JointGoal, Problem, Scene, Sphere, Status, verify
from robotdiffuse.baselines.mpinets import MPiNets, MPiNetsSettings
from robotdiffuse.baselines.mpnet import MPNet, MPNetPlannerSettings, NeuralPlanning
from robotdiffuse.collision import CollisionChecker
from robotdiffuse.datasets.shards import resample
from robotdiffuse.learning import mpinets
from robotdiffuse.learning.checkpoint import save_network
from robotdiffuse.learning.mpnet import MPNetNetwork, MPNetSettings, sorted_along_curve
from robotdiffuse.learning.training.batches import TrajectoryData
from robotdiffuse.learning.weight_files import RobotIdentity
from robotdiffuse.planning.context import PlanningContext, PlanRequest
from robotdiffuse.planning.learned import scene_clouds
from robotdiffuse.planning.start_goal import StartGoal
from robotdiffuse.scenes.packed_scenes import BOX, PackedScenes

UP = np.array([0.0, -0.9, 0.0, -1.9, 0.0, 2.2, 0.785])
WALL = Scene([Box([0.5, 0.0, 0.2], [0.3, 0.05, 0.4], name="wall")])
PROBLEM = Problem(PANDA, WALL, LEFT, JointGoal(RIGHT[None]))
SMALL = MPNetSettings(points=40, encoder_layers=(32, 16), code=8, decoder_layer=16, layers=(64, 64, 32), steady_layers=1)


def network(settings: MPNetSettings = SMALL) -> MPNetNetwork:
    torch.manual_seed(0)
    return MPNetNetwork(RobotIdentity.of(PANDA), settings)


def motions(waypoints: int = 48) -> TrajectoryData:
    q = []
    scenes = []
    s = np.linspace(0, 1, waypoints)[:, None]
    for i, height in enumerate((0.3, 0.4, 0.5, 0.6)):
        way = (1 - s) * LEFT + s * RIGHT + height * np.sin(np.pi * s) * np.eye(7)[1] * -1.5
        q.append((way if i % 2 else way[::-1]).astype(np.float32))
        scenes.append(Scene([Box([0.5, 0.0, height / 2], [0.3, 0.05, height])]))
    trivial = np.array([False, False, False, True])
    return TrajectoryData(resample(np.stack(q), waypoints), PackedScenes.pack(scenes, 2), trivial, None, "made", 0)


@pytest.fixture(scope="module")
def weights(tmp_path_factory) -> str:
    net = network()
    data = motions()
    rng = np.random.default_rng(0)
    net.fit_statistics(data)
    trained(net, lambda step: net.loss(data, 256, step / 80, rng), 80, 3e-3)
    folder = tmp_path_factory.mktemp("mpnet")
    save_network("mpnet", net, folder, {})
    return str(folder)


def planning(weights: str) -> NeuralPlanning:
    start_goal = StartGoal(CollisionChecker(PANDA, WALL), LEFT, np.array([RIGHT]))
    context = PlanningContext("mpnet", PROBLEM, PlanRequest(60.0))
    return NeuralPlanning(context, start_goal, network(), MPNetPlannerSettings(weights))


@pytest.mark.parametrize(("fraction", "most"), [(0.0, np.inf), (1.0, 0.8)], ids=["auto-encoder", "end to end"])
def test_the_loss_falls(fraction: float, most: float) -> None:
    """Predicting straight steps has a loss of 1."""
    net = network()
    data = motions()
    rng = np.random.default_rng(0)
    net.fit_statistics(data)
    losses = trained(net, lambda _: net.loss(data, 256, fraction, rng), 120, 3e-3)
    last = np.mean(losses[-20:])
    assert last < 0.6 * np.mean(losses[:5]) and last < most


def test_the_first_part_trains_enet_alone_and_the_rest_trains_it_along() -> None:
    data = motions()
    for fraction, parts in ((0.0, {"encoder", "decoder"}), (0.5, {"encoder", "policy"})):
        net = network()
        net.loss(data, 64, fraction, np.random.default_rng(0)).backward()
        assert {name.split(".")[0] for name, p in net.named_parameters() if p.grad is not None} == parts


@pytest.mark.parametrize(("code", "draws", "tolerance"), [(1, 1, 1e-5), (3, 300, 0.1)])
def test_the_contractive_penalty_is_the_jacobian_squared(code: int, draws: int, tolerance: float) -> None:
    """Exact for a single output and any random sign; for several outputs, in the mean over random signs."""
    net, plain = (network(replace(SMALL, code=code, contraction=weight)) for weight in (1.0, 0.0))
    cloud = torch.rand(3, 40, 3, generator=torch.Generator().manual_seed(0)) - 0.5
    rows = sorted_along_curve(cloud, net.region).flatten(1)
    jacobians = torch.stack([torch.autograd.functional.jacobian(net.encoder, row[None]) for row in rows])
    expected = jacobians.square().sum((1, 2, 3, 4)).mean()
    with torch.no_grad():  # as in a validation
        losses = [net.autoencoder_loss(cloud, net.generator(seed)) for seed in range(draws)]
        found = torch.stack(losses).mean() - plain.autoencoder_loss(cloud, net.generator(0))
    torch.testing.assert_close(found.detach(), expected, rtol=tolerance, atol=1e-5)


def test_waypoints_are_a_step_apart_or_the_goal() -> None:
    data = motions()
    here, following, goal = network(replace(SMALL, step=0.5)).training_samples(data.q, np.random.default_rng(0))
    moved = np.linalg.norm(following - here, axis=1)
    at_goal = (following == goal).all(1)
    assert len(here) == len(data) * SMALL.waypoints and 0 < at_goal.mean() < 0.7
    assert (np.abs(moved[~at_goal] - 0.5) < 0.06).all() and (moved < 0.56).all() and (moved > 0).all()
    to_the_end = (goal[:, None] == np.concatenate([data.q[:, 0], data.q[:, -1]])).all(2).any(1).mean()
    assert 0.4 < to_the_end < 0.8, "half have sub-goals"


def test_the_order_of_the_points_does_not_matter_and_no_points_are_zeros() -> None:
    net = network()
    rng = np.random.default_rng(0)
    cloud = torch.from_numpy(rng.uniform([-0.5, -0.5, 0.1], [0.5, 0.5, 0.9], (2, 40, 3)).astype(np.float32))
    torch.testing.assert_close(net.encode(cloud), net.encode(cloud[:, torch.from_numpy(rng.permutation(40))]))
    near = sorted_along_curve(cloud, net.region)
    steps = (near[:, 1:] - near[:, :-1]).norm(dim=-1).mean()
    assert steps < 0.7 * (cloud[:, 1:] - cloud[:, :-1]).norm(dim=-1).mean(), "neighbors are near each other"
    assert not sorted_along_curve(torch.zeros(1, 40, 3), net.region).any()
    empty = scene_clouds(CollisionChecker(PANDA, Scene([])), net.region, net.settings.points, 1, rng)[0]
    torch.testing.assert_close(net.code_of(empty), net.encode(torch.zeros(1, 40, 3))[0])


def test_dropout_is_on_in_planning_and_drawn_from_the_generator(weights: str) -> None:
    net = network().eval()
    z = torch.zeros(1, 8)
    q, goal = (torch.from_numpy(end[None].astype(np.float32)) for end in (LEFT, RIGHT))
    generator = torch.Generator().manual_seed(0)
    first, second = (net.next_states(z, q, goal, generator) for _ in range(2))
    again = net.next_states(z, q, goal, torch.Generator().manual_seed(0))
    assert not torch.equal(first, second) and torch.equal(first, again)
    assert torch.equal(net.next_states(z, q, goal, None), net.next_states(z, q, goal, None))
    one = planning(weights)
    states = one.network.proposals(one.z, np.tile(LEFT, (8, 1)).astype(np.float32), one.goals[:8], one.generator)
    assert len(np.unique(states, axis=0)) == 8


def test_replanning_keeps_what_is_free_and_leaves_out_states_in_collision(weights: str) -> None:
    one = planning(weights)
    middle = (LEFT + RIGHT) / 2
    path = np.array([LEFT, UP, middle, RIGHT], np.float32)
    assert not CollisionChecker(PANDA, WALL).free(middle[None])[0]
    np.testing.assert_array_equal(one.without_collisions(path), path[[0, 1, 3]])
    good = np.array([LEFT, UP, RIGHT], np.float32)
    np.testing.assert_array_equal(one.replan([path, good], one.between), [good, good])
    blocked = one.replan([np.array([LEFT, RIGHT], np.float32)], one.between)[0]
    assert len(blocked) > 2
    np.testing.assert_array_equal(blocked[[0, -1]], np.stack([LEFT, RIGHT]).astype(np.float32))


def test_hybrid_replanning_joins_what_the_network_does_not(weights: str) -> None:
    settings = MPNetPlannerSettings(weights, attempts=1, steps=1, replanning=0, hybrid=True)
    results = [MPNet(settings).plan(PROBLEM, 120.0, seed=seed) for seed in (*range(6), 0)]
    assert all(result.solved and verify(PROBLEM, result.path).valid for result in results)
    assert any("RRT-Connect" in result.reason for result in results)
    assert np.array_equal(results[0].path.positions, results[-1].path.positions)


RANGES = RobotIdentity.of(PANDA)
BARRIER = [0.45, 0.0, 0.25, 0.3, 0.05, 0.5, 1.0, 0.0, 0.0, 0.0]
TINY = mpinets.MPiNetsNetworkSettings(
    scene_points=48, robot_points=4, target_points=2, centers=(24, 8), neighbors=(6, 4),
    first_widths=(16, 16), second_widths=(24, 32), all_widths=(48,), cloud_widths=(32, 16),
)  # fmt: skip


@pytest.fixture
def policy() -> mpinets.MPiNetsNetwork:
    torch.manual_seed(0)
    return mpinets.MPiNetsNetwork(RANGES, TINY).eval()


class Straight(mpinets.MPiNetsNetwork):
    def forward(self, clouds: torch.Tensor, q: torch.Tensor, goal: torch.Tensor) -> torch.Tensor:
        return q + (goal - q).clamp(-0.1, 0.1)


def line_data(walls: bool) -> TrajectoryData:
    ends = np.stack([LEFT, RIGHT])[[[0, 1], [1, 0]] * 4] + np.random.default_rng(3).uniform(-0.05, 0.05, (8, 2, 7))
    share = np.linspace(0, 1, 24)[:, None]
    q = (ends[:, :1] * (1 - share) + ends[:, 1:] * share).astype(np.float32)
    kinds = np.full((8, 1), BOX if walls else 0, np.int8)
    params = np.tile(np.array(BARRIER, np.float32), (8, 1, 1)) * walls
    return TrajectoryData(q, PackedScenes(kinds, params), np.zeros(8, bool), None, "", 0)


def clouds_of(policy: mpinets.MPiNetsNetwork, count: int, seed: int = 0) -> torch.Tensor:
    return policy.clouds(line_data(True).scenes[:count], np.random.default_rng(seed))


@pytest.mark.parametrize("points", [20, 300])
def test_grouping_is_that_of_brute_force(points: int) -> None:
    cloud = np.random.default_rng(points).normal(size=(3, points, 3)).astype(np.float32)
    count, most, radius = 12, 7, 0.8
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


def test_order_of_the_scene_points_makes_no_difference(policy: mpinets.MPiNetsNetwork) -> None:
    cloud = clouds_of(policy, 1)
    q, goal = torch.tensor(np.stack([LEFT, RIGHT]), dtype=torch.float32)[:, None]
    shuffled = cloud[:, torch.randperm(cloud.shape[1])]
    with torch.no_grad():
        assert torch.equal(policy(cloud, q, goal), policy(shuffled, q, goal))
        moved = policy(cloud + torch.tensor([0.0, 0.0, 0.3]), q, goal)
    assert not torch.equal(policy(cloud, q, goal), moved)


def test_samples_are_steps_of_the_motions(policy: mpinets.MPiNetsNetwork) -> None:
    data = line_data(True)
    steps = policy.draw(data, 200, np.random.default_rng(0))
    every = np.concatenate([data.q, data.q[:, ::-1]])
    for q, expert, goal in zip(steps.q.numpy(), steps.expert.numpy(), steps.goal.numpy(), strict=True):
        of = every[[bool((motion[-1] == goal).all()) and (motion == expert).all(1).any() for motion in every]]
        at = int((of[0] == expert).all(1).argmax())
        before = of[0][[at - 1, at]] if at == len(of[0]) - 1 else of[0][[at - 1]]
        assert np.abs(before - q).max(1).min() < 6 * TINY.noise
    assert torch.unique(steps.goal, dim=0).shape[0] == 16


def test_loss_falls_on_few_motions() -> None:
    torch.manual_seed(0)
    policy = mpinets.MPiNetsNetwork(RANGES, replace(TINY, noise=0.0))
    data = line_data(False)
    rng = np.random.default_rng(0)
    policy.fit_statistics(data)
    losses = trained(policy, lambda _: policy.loss(data, 24, 0.5, rng), 25, 3e-3)
    assert np.mean(losses[-5:]) < 0.8 * np.mean(losses[:5])
    assert all(parameter.grad is not None for parameter in policy.parameters())


def test_a_path_in_collision_is_no_result(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(MPiNets, "network", lambda _self, _robot: Straight(RANGES, TINY))
    problem = Problem(PANDA, Scene([Box(BARRIER[:3], BARRIER[3:6])]), LEFT, RIGHT)
    MPiNets().plan(problem, 0.1, 1)  # compiles and loads
    result = MPiNets().plan(problem, 0.5, 1)
    assert result.status is Status.TIMEOUT and result.refused == "scene_collision"
    assert "is not valid" in result.reason


def test_trained_weights_are_read_and_the_same_seed_gives_the_same_path(tmp_path, policy):
    save_network("mpinets", policy, tmp_path, {})
    planner = MPiNets(MPiNetsSettings(weights=str(tmp_path), near=0.299))
    q = torch.tensor(LEFT[None], dtype=torch.float32)
    cloud = clouds_of(policy, 1)
    # weights are stored in half precision
    assert torch.allclose(policy(cloud, q, q), planner.network(PANDA)(cloud, q, q), atol=1e-3)
    # the untrained policy makes some steps before it is near enough by chance
    problem = Problem(PANDA, Scene([Sphere([0.0, 0.0, 1.5], 0.1)]), LEFT, LEFT + np.array([0.0, 0.0, 0.3, 0.0, 0.0, 0.0, 0.0]))
    paths = [planner.plan(problem, 20.0, seed).path for seed in (5, 5)]
    assert np.array_equal(paths[0].positions, paths[1].positions)
    assert len(paths[0].positions) > 2


def test_bad_network_settings() -> None:
    refuses("mpnet.layers is ", MPNetSettings, layers=())
    refuses("mpnet.steady_layers is ", MPNetSettings, steady_layers=12)
    made = mpinets.MPiNetsNetworkSettings
    refuses("scene_points is 0", made, scene_points=0)
    refuses("target_points is 13; it must be at most robot_points, 12", made, target_points=13)
    refuses("centers is", made, centers=(64, 65))
    refuses("cloud_widths is", made, cloud_widths=(30, 16))
