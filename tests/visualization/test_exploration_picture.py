"""The strip of pictures of an exploration."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from helpers.explorations import recorded
from robotdiffuse.core.errors import InputError
from robotdiffuse.visualization.exploration import GAP, moments, write_exploration_picture
from robotdiffuse.visualization.picture import PictureSettings

SMALL = PictureSettings(width=240, height=150, ghosts=1)


def test_each_moment_has_a_picture(tmp_path: Path) -> None:
    problem, explorer = recorded()
    write_exploration_picture(explorer, problem.scene, tmp_path / "explore.png", SMALL)
    count = len(moments(explorer))
    columns = min(count, 3 if count > 4 else 2)
    with Image.open(tmp_path / "explore.png") as image:
        width, height = columns * (240 + GAP) - GAP, -(-count // columns) * (150 + GAP) - GAP
        assert image.size == (width, height)
        first = np.asarray(image)[:100, :240].astype(int)
    blue = (first[..., 2] > first[..., 0] + 25).sum()
    assert blue > 50, "the wall was seen"
    with pytest.raises(InputError):
        write_exploration_picture(explorer, problem.scene, tmp_path / "explore.html", SMALL)
