"""Training of baselines: learning, checkpoints, weights of other robots, the command."""

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
import torch

from helpers.commands import Said
from helpers.panda import PANDA
from helpers.refusals import refuses
from helpers.stores import random_motions, write_motions
from robotdiffuse.core.registry import Entry
from robotdiffuse.core.settings import Settings
from robotdiffuse.learning.checkpoint import load_network
from robotdiffuse.learning.training.batches import TrajectoryData
from robotdiffuse.learning.training.tasks import BaselineNetwork, baseline_training, train_baseline
from robotdiffuse.learning.weight_files import NETWORKS, RobotIdentity


@dataclass(frozen=True)
class ReversalSettings(Settings):
    width: int = 7


class Reversal(BaselineNetwork):
    training_defaults: ClassVar[dict] = {"batch": 16, "learning_rate": 0.05}

    def __init__(self, robot: RobotIdentity, settings: ReversalSettings) -> None:
        super().__init__(robot, settings)
        self.layer = torch.nn.Linear(2 * self.dof, self.dof)

    def loss(self, data: TrajectoryData, count: int, fraction: float, rng: np.random.Generator) -> torch.Tensor:
        q = self.to_unit(torch.from_numpy(data.q[rng.integers(0, len(data), count)]))
        return (self.layer(torch.cat([q[:, 0], q[:, -1]], -1)) - q[:, q.shape[1] // 2]).square().mean()


@pytest.fixture
def data(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    monkeypatch.setitem(NETWORKS, "reversal", Entry(f"{__name__}:Reversal", "for tests", "ReversalSettings"))
    write_motions(tmp_path / "data", PANDA, random_motions(PANDA, 40))
    return str(tmp_path / "data")


def test_training_learns(data: str, tmp_path: Path) -> None:
    settings = baseline_training("reversal", {"data": data, "samples": 6400, "warmup_steps": 5})
    assert (settings.batch, settings.learning_rate, settings.minutes) == (16, 0.05, None)
    report = train_baseline(settings, str(tmp_path / "whole"))
    assert report["validation"] < 1e-3 and report["samples"] == 6400


def test_weights_of_another_robot_or_none_are_refused(data: str, tmp_path: Path) -> None:
    message = "no weights of the network reversal come with the package for panda; train them"
    refuses(message, load_network, "reversal", None, PANDA)
    message = "holds no reversal; train them: robotdiffuse train baseline reversal"
    refuses(message, load_network, "reversal", str(tmp_path), PANDA)
    train_baseline(baseline_training("reversal", {"data": data, "samples": 160}), str(tmp_path / "out"))
    narrow = PANDA.with_locked({"panda_joint7": 0.0})
    refuses("was trained for panda with joints", load_network, "reversal", str(tmp_path / "out"), narrow)


def test_command(data: str, tmp_path: Path, said: Said) -> None:
    asked = ("train", "baseline", "reversal", "--data", data, "--out", tmp_path / "out", "--samples", 320)
    assert "samples: 320" in said(0, *asked)
    assert "belongs to a run with batch = 16, not 8" in said(2, *asked, "--batch-size", 8)
    error = said(2, "train", "baseline", "nonsense", "--data", data, "--out", "x")
    assert "unknown network 'nonsense'; known: completion, model, mpinets, mpnet" in error


@pytest.mark.parametrize("name", sorted(NETWORKS.keys() - {"completion"}))
def test_every_network_normalizes_by_the_joint_limits(name: str) -> None:
    network = NETWORKS.load(name)(RobotIdentity.of(PANDA), NETWORKS.defaults(name))
    ends = np.stack([PANDA.lower, PANDA.upper])
    np.testing.assert_allclose(network.normalizer.to_unit(ends), [[-1] * 7, [1] * 7])
    given = torch.from_numpy(ends)
    torch.testing.assert_close(network.from_unit(network.to_unit(given)), given)
