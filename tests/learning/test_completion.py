"""The occupancy completion network: its inputs and outputs, its training, and its weights."""

import multiprocessing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import robotdiffuse as rd
from helpers.panda import HOME, PANDA
from helpers.refusals import refuses
from helpers.trainings import trained
from robotdiffuse.learning import completion
from robotdiffuse.learning.checkpoint import load_completion, save_network
from robotdiffuse.learning.completion_network import CompletionNetwork, folded, unfolded
from robotdiffuse.learning.training import completion as training
from robotdiffuse.perception.observed_volume import ObservedVolume, observe
from robotdiffuse.perception.ray_caster import looking_at, ray_cast, voxels_within
from robotdiffuse.perception.voxel_grid import FINE, SHAPE, refined
from robotdiffuse.problems.families import FAMILIES, load_family

SMALL = completion.CompletionSettings(channels=(8, 8, 8), blocks=(1, 1, 1))
TINY = training.CompletionTraining(samples=8, batch=2, workers=0, network=SMALL, families=("rop", "table"))


@pytest.fixture(autouse=True)
def few_held_out(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("VALIDATION_SAMPLES", "CALIBRATION_SAMPLES", "TEST_SAMPLES"):
        monkeypatch.setattr(training, name, 1)


def seen_from_behind(scene: rd.Scene) -> ObservedVolume:
    T = looking_at(np.array([-1.0, 0.3, 1.0]), np.array([0.5, 0.0, 0.3]))
    return observe([ray_cast(scene, T, (130.0, 130.0, 79.5, 59.5), (160, 120), PANDA, HOME)], PANDA, HOME)


@pytest.mark.parametrize("family", FAMILIES)
def test_samples_agree_with_the_scene(family: str) -> None:
    samples = completion.draw_samples((family,), PANDA, range(4))
    truth = completion.unpack_fine(samples.truth)
    free = (samples.seen & completion.FREE) > 0
    occupied = (samples.seen & completion.OCCUPIED) > 0
    assert free.mean() > 0.05 and truth[free].mean() < 1e-3
    assert truth[occupied].any(axis=-1).mean() > 0.85, "the rest touch a corner"
    assert (samples.behind[free | occupied] == 0).all()


def test_training_begins_with_the_weights_that_it_is_given() -> None:
    settings = replace(TINY, network=completion.CompletionSettings(), weights="bundled")
    task = training.CompletionTask(settings, training.Processes("cpu"))
    given = load_completion().state_dict()
    assert all(torch.equal(value, given[name]) for name, value in task.module.state_dict().items())
    other = replace(TINY, weights="bundled")
    refuses("weights bundled: their network has", training.CompletionTask, other, training.Processes("cpu"))
    refuses(r"families.*rap.*crate", replace, TINY, families=("rap",))


def test_packing_and_folding_of_voxels_are_undone() -> None:
    fine = voxels_within(load_family("table").scene(np.random.default_rng(0)), FINE)
    bits = completion.unpack_fine(completion.pack_fine(fine))
    for place in np.argwhere(bits.any(axis=-1))[::97]:
        for bit in range(8):
            assert bits[(*place, bit)] == fine[tuple(2 * place + (bit >> 2, bit >> 1 & 1, bit & 1))]
    assert bits.sum() == fine.sum()
    x = torch.arange(8 * 12 * 4 * 2).reshape(2, 8, 12, 4)
    assert (unfolded(folded(x))[..., 0] == x).all() and folded(x)[1, 2, 3, 1].tolist() == x[1, 4:6, 6:8, 2:4].ravel().tolist()


def test_the_network_s_inputs() -> None:
    volume = seen_from_behind(rd.Scene([rd.Box((0.5, 0.0, 0.3), (0.1, 0.6, 0.6))]))
    seen, behind = (torch.from_numpy(array)[None] for array in completion.pack(volume))
    inputs = CompletionNetwork(SMALL).features(seen, behind)[0].reshape(7, 8, 28, 28, 16).permute(0, 2, 3, 4, 1)
    planes = [unfolded(plane[None])[0, ..., 0].numpy() for plane in inputs]
    for plane, of in zip(planes, (volume.occupied, volume.free, volume.shadow, volume.out_of_view), strict=False):
        assert (plane == of).all() and of.any()
    np.testing.assert_allclose(planes[4], volume.behind / 0.5, atol=0.011)
    np.testing.assert_allclose(planes[5], completion.voxel_centers()[..., 2], atol=1e-6)
    np.testing.assert_allclose(planes[6], np.hypot(*np.moveaxis(completion.voxel_centers()[..., :2], -1, 0)), atol=1e-6)


@pytest.mark.slow
def test_voxels_of_predictions_and_samples_agree(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    task = training.CompletionTask(replace(TINY, learning_rate=1e-2), training.Processes("cpu"))
    rng = np.random.default_rng(1)
    scene = load_family("table").scene(rng)
    volume = seen_from_behind(scene)
    fine = voxels_within(scene, FINE)
    seen, behind = completion.pack(volume)
    sample = completion.Samples(seen[None], behind[None], completion.pack_fine(fine)[None])
    monkeypatch.setattr(task.prefetcher, "next", lambda rng: sample)
    losses = trained(task.module, lambda _: task.loss(0.0, rng), 60, 5e-3)
    assert losses[-1] < 0.3 * losses[0]
    save_network("completion", task.module, tmp_path, {})
    p = completion.predict(volume, completion.exported_completion(tmp_path))
    assert p.shape == tuple(2 * n for n in SHAPE) and p.dtype == np.float32
    free = refined(volume.free)
    assert (p[free] == 0).all()
    counted = ~free & refined(completion.reachable())
    assert training.average_precision(p[counted], fine[counted]) > 2 * fine[counted].mean()


def test_training_writes_weights(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(CompletionNetwork, "exports", lambda _: {})  # it takes seconds
    report = training.train_completion(replace(TINY, samples=2), str(tmp_path))
    loaded = load_completion(tmp_path)
    assert report["samples"] == 2 and loaded.settings == SMALL and loaded.temperature == pytest.approx(report["temperature"])
    refuses("robotdiffuse train completion", load_completion, tmp_path / "nothing")


@pytest.mark.slow
def test_training_is_resumed_exactly_with_and_without_prefetching(tmp_path: Path) -> None:
    report = training.train_completion(TINY, str(tmp_path / "whole"))
    training.train_completion(replace(TINY, samples=4), str(tmp_path / "parts"))
    assert training.train_completion(TINY, str(tmp_path / "parts")).keys() == report.keys() and report["samples"] == 8
    whole = load_completion(tmp_path / "whole")
    assert whole.temperature > 0 and not any(p.requires_grad for p in whole.parameters())
    rng = np.random.default_rng(2)
    other = np.random.default_rng(2)
    ahead, alone = (training.SamplePrefetcher(("rop",), PANDA, 2, workers) for workers in (1, 0))
    for number in range(3):
        if number == 1:  # regression: the death of a worker ended the training without a checkpoint
            multiprocessing.active_children()[-1].kill()
        a = ahead.next(rng)
        assert all((x == y).all() for x, y in zip(a, alone.next(other), strict=True))
    assert (ahead.next(np.random.default_rng(3)).seen == alone.next(np.random.default_rng(3)).seen).all()
    ahead.close()


def test_temperature_and_calibration() -> None:
    rng = np.random.default_rng(4)
    logits = rng.normal(size=200_000).astype(np.float32) * 2
    truth = rng.random(len(logits)) < 1 / (1 + np.exp(-logits))
    assert training.fitted_temperature(3 * logits, truth) == pytest.approx(3, rel=0.03)
    p = 1 / (1 + np.exp(-logits))
    assert training.calibration_error(p, truth) < 0.01 < 0.1 < training.calibration_error(p**3, truth)
    assert training.average_precision(p, truth) == pytest.approx(training.average_precision(p**3, truth))
    by_hand = training.average_precision(np.array([0.9, 0.8, 0.1], np.float32), np.array([True, False, True]))
    assert by_hand == pytest.approx((1 + 2 / 3) / 2)


def test_nothing_is_predicted_beyond_reach() -> None:
    """Training has no voxels there, so the network would predict walls a meter around the arm."""
    unknown = np.zeros(SHAPE, np.uint8)
    p = completion.exported_completion()(unknown, unknown)
    reach = refined(completion.reachable())
    assert not p[~reach].any() and p[reach].any()


@pytest.mark.parametrize("family", ["rop_dense", "shelf", "kitchen"])
def test_bundled_weights_are_better_than_a_constant(family: str) -> None:
    """Average precision over unknown voxels above the ground; that of a constant is the share of occupied voxels."""
    samples = completion.draw_samples((family,), PANDA, range(11, 19))
    network = completion.exported_completion()
    above = completion.voxel_centers()[..., 2] > 0.02
    p = [network(*volume) for volume in zip(samples.seen, samples.behind, strict=True)]
    counted = ((samples.seen & (completion.FREE | completion.OCCUPIED)) == 0) & completion.reachable() & above
    called = np.stack([completion.unpack_fine(completion.pack_fine(one > 0.1)) for one in p])[counted]
    true = completion.unpack_fine(samples.truth)[counted]
    assert called[true].mean() > 0.4, "recall"
    assert true[called].mean() > 3 * true.mean(), "precision"
