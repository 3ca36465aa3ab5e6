"""Fixtures that tests of networks share."""

import pytest

from robotdiffuse.learning.motion_network import MotionNetwork


@pytest.fixture
def no_export(monkeypatch: pytest.MonkeyPatch) -> None:
    """Weights are saved without ONNX files, whose export takes seconds, for tests that read weights by PyTorch."""
    monkeypatch.setattr(MotionNetwork, "exports", lambda _: {})
