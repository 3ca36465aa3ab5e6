"""Every family of the table: its problems are usable, repeatable and what it says of itself."""

from dataclasses import asdict, replace

import numpy as np
import pytest

from robotdiffuse import InputError, load_robot
from robotdiffuse.collision import CollisionChecker
from robotdiffuse.generation.factory import TARGETS, GenerationSettings, draw
from robotdiffuse.problems.families import FAMILIES, load_family
from robotdiffuse.problems.families import family as drawing
from robotdiffuse.problems.families.family import CONFIGURATION, POSITION
from robotdiffuse.problems.families.rop import ROP
from robotdiffuse.problems.files import problem_record
from robotdiffuse.problems.held_out import held_out_problem
from robotdiffuse.robots.kinematics import link_pose
from robotdiffuse.scenes.scene_arrays import PackedScenes

PANDA = load_robot("panda")
every_family = pytest.mark.parametrize("name", FAMILIES)
every_target = pytest.mark.parametrize("target", [CONFIGURATION, *TARGETS])


@every_target
@every_family
def test_problems_are_as_the_family_says(name: str, target: str) -> None:
    family = load_family(name)
    rng = np.random.default_rng(8)
    for _ in range(2):
        drawn = family.draw(PANDA, rng, goals=3, target=target)
        q = np.concatenate([drawn.start[None], drawn.goals]).astype(np.float64)
        assert 1 <= len(drawn.goals) <= 3 and CollisionChecker(PANDA, drawn.scene).free(q).all()
        poses = np.stack([link_pose(PANDA, row, PANDA.tip) for row in q])
        assert ((poses[:, :3, 3] >= family.region[0]) & (poses[:, :3, 3] <= family.region[1])).all()
        np.testing.assert_allclose(poses[1:, :3, 3], [drawn.T_base_tip[:3, 3]] * len(drawn.goals), atol=1e-3)
        floors = () if family.floor is None else (family.floor,)
        assert drawn.scene.shapes[: len(floors)] == floors
        PackedScenes.pack([drawn.scene], family.max_obstacles, floor=bool(floors))


@every_family
def test_same_seed_same_problem(name: str) -> None:
    a, b, c = (held_out_problem(name, number) for number in (3, 3, 4))
    assert problem_record(a) == problem_record(b) != problem_record(c)


@every_family
def test_data_are_made_of_it(name: str) -> None:
    settings = GenerationSettings(mix={"rop": 1.0, name: 1e6}, goals=2)
    number, drawn = draw(settings, PANDA, np.random.default_rng(1))
    assert list(settings.mix)[number] == name and 1 <= len(drawn.goals) <= 2
    assert settings.slots >= load_family(name).max_obstacles


@every_family
def test_settings_can_be_kept_in_a_manifest(name: str) -> None:
    family = load_family(name)
    assert replace(family, **asdict(family)) == family  # type: ignore[type-var]


def test_position_of_the_tip_is_uniform_in_the_region() -> None:
    """Uniform targets, as the authors'; the mean within five standard deviations of the middle."""
    rng = np.random.default_rng(2)
    empty = replace(ROP, obstacles=(0, 0), tip_x=(0.3, 0.5), tip_y=(-0.2, 0.2), tip_z=(0.3, 0.6))
    targets = [empty.draw(PANDA, rng, target=POSITION).T_base_tip[:3, 3] for _ in range(100)]
    spread = np.diff(empty.region, axis=0)[0] / np.sqrt(12 * 100)
    assert (np.abs(np.mean(targets, axis=0) - empty.region.mean(axis=0)) < 5 * spread).all()


def test_impossible_problems(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(drawing, "MAX_SCENES", 2)
    with pytest.raises(InputError, match="no free start and goal in 2 scenes of Rop for panda"):
        replace(ROP, tip_z=(5.0, 6.0)).draw(PANDA, np.random.default_rng(10))


def test_unknown_families_are_refused_with_those_known() -> None:
    with pytest.raises(InputError, match=r"family 'rap'.*crate, kitchen, rop, rop_dense"):
        load_family("rap")
