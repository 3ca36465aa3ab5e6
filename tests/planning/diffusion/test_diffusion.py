"""The diffusion model alone: unchanged samples of the network, the shortest valid one, batch after batch."""

from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest

import robotdiffuse as rd
from helpers.panda import LEFT, PANDA, RIGHT
from helpers.refusals import refuses
from robotdiffuse.collision import CollisionChecker
from robotdiffuse.learning.encoders import DGCNNSettings
from robotdiffuse.learning.exported_model import ExportedModel
from robotdiffuse.learning.motion_model import MotionModelSettings
from robotdiffuse.learning.motion_network import MotionNetwork
from robotdiffuse.learning.weight_files import RobotIdentity, weights_for
from robotdiffuse.planning.diffusion import Diffusion, DiffusionSettings, encode
from robotdiffuse.scenes.surface_points import sample_surface

PROBLEM = rd.Problem(PANDA, rd.Scene([rd.Sphere([0.5, 0.0, 0.4], 0.15, name="ball")]), LEFT, rd.JointGoal(RIGHT[None]))
MODEL = Diffusion().network(PANDA)


def test_the_answer_is_the_shortest_valid_sample_as_it_was_drawn() -> None:
    planner = Diffusion()
    result = planner.plan(PROBLEM, time_limit=60.0, seed=5)
    checker = CollisionChecker(PANDA, PROBLEM.scene)
    rng = np.random.default_rng(5)
    code = encode(MODEL, checker, planner.settings.points, rng)
    ends = LEFT.astype(np.float32), RIGHT[None].astype(np.float32)
    samples = planner.draw(MODEL, checker, code, *ends, rng)
    samples[:, [0, -1]] = LEFT, RIGHT
    paths = [rd.Path(PANDA.joint_names, q) for q in samples]
    valid = [path for path in paths if rd.verify(PROBLEM, path).valid]
    assert valid and result.stage == "network"
    assert np.array_equal(result.path.positions, min(valid, key=lambda path: path.length).positions)
    assert f"{len(valid)} of {len(samples)} samples" in result.reason


def test_weights_are_used_with_their_own_sampler_and_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    levels: list[float] = []

    def denoised(self, features, level, *rest, own=ExportedModel.denoised):
        levels.append(float(level[0]))
        return own(self, features, level, *rest)

    monkeypatch.setattr(ExportedModel, "denoised", denoised)
    of_weights = MODEL.settings
    for model, steps, calls in (
        (of_weights, None, of_weights.sampling_steps),
        (of_weights, 3, 3),
        (replace(of_weights, sampling_steps=None), None, MODEL.schedule.steps),
    ):
        monkeypatch.setattr(MODEL, "settings", model)
        levels.clear()
        Diffusion(DiffusionSettings(samples=1, guidance_steps=0, sampling_steps=steps)).plan(PROBLEM, time_limit=1e-3)
        assert len(levels) == calls and levels[0] == 1.0


@pytest.mark.parametrize("repeat", [True, False])
def test_batches_repeat_until_one_has_a_valid_sample(repeat: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    batches = []

    def draw(self, *arguments, own=Diffusion.draw, **more):
        batches.append(own(self, *arguments, **more))
        if len(batches) < 3:
            batches[-1][:, 24] = LEFT + 1.5  # away and back: not valid
        return batches[-1]

    monkeypatch.setattr(Diffusion, "draw", draw)
    result = Diffusion(DiffusionSettings(repeat=repeat)).plan(PROBLEM, time_limit=60.0)
    assert result.solved == repeat and len(batches) == (3 if repeat else 1)
    assert f"of {16 * len(batches)} samples" in result.reason


def test_more_batches_after_the_first_path_make_it_no_longer() -> None:
    first = Diffusion().plan(PROBLEM, time_limit=60.0)
    more = Diffusion(DiffusionSettings(optimize_time=1.0)).plan(PROBLEM, time_limit=60.0)
    # regression: batches were drawn until no time was left for timing
    assert Diffusion(DiffusionSettings(optimize_time=100.0)).plan(PROBLEM, time_limit=5.0).solved
    assert more.path.length <= first.path.length and more.planning_time >= 1.0
    assert [length for _, length in more.progress] == sorted({length for _, length in more.progress})[::-1]


def test_no_valid_sample_says_what_is_wrong(monkeypatch: pytest.MonkeyPatch) -> None:
    def line(self, _model, _checker, _code, start, goals, _rng, **_how):
        return (start + np.linspace(0, 1, 48)[:, None] * (goals[0] - start))[None]

    monkeypatch.setattr(Diffusion, "draw", line)
    result = Diffusion().plan(PROBLEM, time_limit=0.1)
    assert result.status is rd.Status.TIMEOUT and result.reason.startswith("0 of ") and result.refused == "scene_collision"


def test_an_encoder_of_one_size_gets_clouds_of_that_size(monkeypatch: pytest.MonkeyPatch) -> None:
    settings = DGCNNSettings(code=8, cloud=50, neighbors=4, edges=(8,), embedding=16, head=(16,))
    settings = MotionModelSettings(encoder="dgcnn", encoder_settings=settings)
    model = MotionNetwork(RobotIdentity.of(PANDA), settings)
    z = Mock(return_value=np.zeros(8, np.float32))
    monkeypatch.setattr(model, "encode", z)
    encode(model, CollisionChecker(PANDA, PROBLEM.scene), 320, np.random.default_rng(0))
    assert [len(call.args[0]) for call in z.call_args_list] == [50]


def test_a_point_cloud_in_place_of_shapes() -> None:
    points = sample_surface(PROBLEM.scene, 4000, np.random.default_rng(0))
    problem = rd.Problem(PANDA, rd.Scene([rd.PointCloud(points, 0.01)]), LEFT, rd.JointGoal(RIGHT[None]))
    assert rd.verify(PROBLEM, Diffusion().plan(problem, time_limit=60.0).path).valid, "the ball lies within its points"


def test_the_guidance_scale_reaches_the_network() -> None:
    checker = CollisionChecker(PANDA, PROBLEM.scene)
    code = encode(MODEL, checker, 320, np.random.default_rng(0))
    drawn = []
    for scale in (1.0, 1.0, 3.0):
        planner = Diffusion(DiffusionSettings(samples=2, guidance_steps=0, guidance_scale=scale))
        drawn.append(planner.draw(MODEL, checker, code, LEFT, RIGHT[None], np.random.default_rng(1)))
    assert np.array_equal(drawn[0], drawn[1]) and np.abs(drawn[2] - drawn[0]).max() > 0.01


def test_locked_joints_that_the_network_does_not_know_keep_the_weights() -> None:
    """Fingers may be locked elsewhere; a locked joint of the arm would change the number of the network's joints."""
    for opening in (0.0, 0.065):
        robot = rd.load_robot("panda", locked={"panda_finger_joint1": opening})
        assert weights_for("model", robot) is not None and Diffusion().network(robot) is not None
    assert weights_for("model", rd.load_robot("panda", locked={"panda_joint7": 0.3})) is None
    stranger = replace(PROBLEM, robot=replace(PANDA, name="stranger"))
    refuses("no weights of the network model come with the package for", Diffusion().plan, stranger)
