"""Every family of the table: problems can be planned, are repeatable, keep the settings; furniture and its free regions."""

from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

from helpers.made_arms import chain, joint, link, read_urdf, row, written
from helpers.refusals import refuses
from helpers.sphere_oracles import distance
from robotdiffuse import Box, Scene, Sphere, load_robot
from robotdiffuse.collision import CollisionChecker
from robotdiffuse.core.transforms import rotation_from_rpy
from robotdiffuse.generation.factory import TARGETS
from robotdiffuse.problems.families import FAMILIES, family as drawing, furniture, load_family
from robotdiffuse.problems.families.rop import ROP, Rop
from robotdiffuse.problems.families.scaled import ScaledFamily, family_for, scale_for
from robotdiffuse.robots.robot import LinkPairTable, scaled
from robotdiffuse.scenes.packed_scenes import BOX, PackedScenes
from robotdiffuse.scenes.shapes import Shape
from robotdiffuse.scenes.surface_points import VisibleRegion, sample_surface

PANDA = load_robot("panda")
BASE = np.array([[0, 0, 0.1, 0.15], [-0.1, 0, 0.05, 0.1]])


@pytest.mark.parametrize("target", [drawing.CONFIGURATION, *TARGETS])
@pytest.mark.parametrize("name", FAMILIES)
def test_problems_are_as_the_family_says(name: str, target: str) -> None:
    family = load_family(name)
    rng = np.random.default_rng(8)
    for _ in range(2):
        drawn = family.draw(PANDA, rng, goals=3, target=target)
        q = np.concatenate([drawn.start[None], drawn.goals]).astype(np.float64)
        assert 1 <= len(drawn.goals) <= 3 and CollisionChecker(PANDA, drawn.scene).free(q).all()
        poses = np.stack([PANDA.fk(row) for row in q])
        if isinstance(family, Rop):
            assert ((poses[:, :3, 3] >= family.region[0]) & (poses[:, :3, 3] <= family.region[1])).all()
        np.testing.assert_allclose(poses[1:, :3, 3], [drawn.T_base_tip[:3, 3]] * len(drawn.goals), atol=1e-3)
        floors = () if family.floor is None else (family.floor,)
        assert drawn.scene.shapes[: len(floors)] == floors
        PackedScenes.pack([drawn.scene], family.max_obstacles, floor=bool(floors))
    assert replace(family, **asdict(family)) == family, "a manifest keeps its settings"  # type: ignore[type-var]


def test_position_of_the_tip_is_uniform_in_the_region() -> None:
    """Targets are uniform, as the authors': their mean is within five standard deviations of the middle."""
    rng = np.random.default_rng(2)
    empty = replace(ROP, obstacles=(0, 0), tip_x=(0.3, 0.5), tip_y=(-0.2, 0.2), tip_z=(0.3, 0.6))
    targets = [empty.draw(PANDA, rng, target=drawing.POSITION).T_base_tip[:3, 3] for _ in range(100)]
    spread = np.diff(empty.region, axis=0)[0] / np.sqrt(12 * 100)
    assert (np.abs(np.mean(targets, axis=0) - empty.region.mean(axis=0)) < 5 * spread).all()


SMALL = load_robot("so101")


@pytest.mark.parametrize("name", ["panda", "ur5e", "xarm7"])
def test_arms_like_a_panda_get_families_as_they_are(name: str) -> None:
    robot = load_robot(name)
    assert scale_for(robot) == 1.0 and family_for("shelf", robot) is load_family("shelf")


def test_a_scaled_arm_reaches_so_many_times_as_far_and_its_tables_are_scaled_too() -> None:
    robot = load_robot("ur5e")
    large = scaled(robot, 1.5)
    assert large.reach == pytest.approx(1.5 * robot.reach, rel=1e-9)
    q = np.random.default_rng(0).uniform(robot.lower, robot.upper, (200, robot.dof))
    one, other = (CollisionChecker(arm, Scene()) for arm in (robot, large))
    expected = np.minimum(1.5 * one.pair_clearances(q), 1.0)  # distances are capped at a meter
    np.testing.assert_allclose(other.pair_clearances(q), expected, atol=1e-5)
    table = LinkPairTable(("panda_hand", "panda_leftfinger"), ("panda_finger_joint1",), (0.0,), (0.04,), np.arange(8) < 3)
    (large,) = scaled(replace(load_robot("panda"), tables=(table,)), 1.5).tables
    positions = np.linspace(-0.01, 0.05, 50)
    np.testing.assert_array_equal(large.at(1.5 * positions), table.at(positions))


def test_mimic_joints_of_a_scaled_arm_follow_as_far(tmp_path: Path) -> None:
    """Regression: offsets of prismatic mimic joints were not scaled, nor were ratios of turns and lengths."""
    slide = "prismatic", "0 0 0.1", "0 0 1", 'lower="-1" upper="1"'
    follow = '<mimic joint="a" multiplier="0.5" offset="0.03"/>'
    tail = [link("l1"), link("l2"), joint("b", "a_link", "l1", *slide, follow), joint("c", "l1", "l2", more=follow)]
    robot = read_urdf(written(tmp_path, chain("base", ["a"], kind="prismatic"), *tail, chain("l2", ["d"])), locked={"a": 0.2})
    expected = robot.fk([0.3], "d_link")
    expected[:3, 3] *= 1.5
    np.testing.assert_allclose(scaled(robot, 1.5).with_locked({"a": 0.3}).fk([0.3], "d_link"), expected, atol=1e-12)


@pytest.mark.parametrize("name", FAMILIES)
def test_problems_of_an_arm_of_five_joints_and_a_third_of_the_reach(name: str) -> None:
    """Regression: only ROP had problems for this arm: furniture was out of reach, and the arm reaches few poses."""
    family = family_for(name, SMALL)
    assert isinstance(family, ScaledFamily) and family.scale == 0.4
    drawn = family.draw(SMALL, np.random.default_rng(3), 2, drawing.POSE)
    q = np.concatenate([drawn.start[None], drawn.goals]).astype(np.float64)
    assert CollisionChecker(SMALL, drawn.scene).free(q).all()
    tips = np.array([SMALL.fk(row)[:3, 3] for row in q])
    np.testing.assert_allclose(tips[1:], [drawn.T_base_tip[:3, 3]] * len(drawn.goals), atol=1e-5)
    PackedScenes.pack([drawn.scene], family.max_obstacles, floor=True)


def test_values_of_prismatic_joints_are_scaled_too(tmp_path: Path) -> None:
    """Regression: the start and the goals were those of the arm's copy of a Panda's size."""
    lift = chain("base", ["lift"], kind="prismatic", axis="0 0 1", limits='lower="0" upper="0.6"')
    robot = read_urdf(written(tmp_path, lift, chain("lift_link", row("j", 6), xyz="0 0 0.35")))
    family = family_for("rop", robot)
    assert isinstance(family, ScaledFamily)
    drawn = family.draw(robot, np.random.default_rng(3), 2, drawing.POSE)
    for q in drawn.goals:
        np.testing.assert_allclose(robot.fk(q), drawn.T_base_tip, atol=1e-3)
    assert robot.prismatic[0] and abs(drawn.goals[0][0]) > 0.01


def test_papers_scenes() -> None:
    rng = np.random.default_rng(0)
    shapes = [shape for _ in range(300) for shape in ROP.scene(rng).shapes]
    obstacles = [shape for shape in shapes if shape.name != "floor"]
    spheres = [shape for shape in obstacles if isinstance(shape, Sphere)]
    cubes = [shape for shape in obstacles if isinstance(shape, Box)]
    assert len(spheres) + len(cubes) == 600 and 220 < len(spheres) < 380 and {shape.radius for shape in spheres} == {0.25}
    assert {(*shape.size, *shape.wxyz) for shape in cubes} == {(0.2, 0.2, 0.2, 1, 0, 0, 0)}
    centers = np.array([shape.center for shape in (*spheres, *cubes)])
    assert (centers >= [-1, -1, 0.1]).all() and (centers <= 1).all() and np.abs(centers.mean(axis=0) - [0, 0, 0.55]).max() < 0.1


def test_every_setting_counts() -> None:
    settings = Rop(obstacles=(4, 4), kinds=("box",), cube_side=(0.3, 0.4), x=(2.0, 3.0), yaw=True)
    _floor, *shapes = settings.scene(np.random.default_rng(2)).shapes
    assert len(shapes) == 4 == settings.max_obstacles
    for shape in shapes:
        assert isinstance(shape, Box) and 2 <= shape.center[0] <= 3 and 0.3 <= shape.size[0] <= 0.4
        assert 0 < abs(shape.wxyz[3]) <= np.sin(np.pi / 8) and shape.wxyz[1] == shape.wxyz[2] == 0


def test_obstacles_stay_clear_of_the_base() -> None:
    rng = np.random.default_rng(4)
    settings = replace(ROP, x=(-0.5, 0.5), y=(-0.5, 0.5), yaw=True)
    for _ in range(100):
        for shape in settings.scene(rng, BASE).shapes[1:]:  # without the floor
            points = sample_surface(Scene([shape]), 200, rng, VisibleRegion(floor=-5.0, reach=9.0))
            assert (np.linalg.norm(points[:, None] - BASE[:, :3], axis=2) > BASE[:, 3]).all()
            assert isinstance(shape, Sphere | Box) and np.linalg.norm(shape.center - BASE[0, :3]) > 0.15
    refuses("widen", replace(ROP, x=(0.0, 0.0), y=(0.0, 0.0), z=(0.1, 0.1)).scene, rng, BASE)


def test_wrong_settings_and_impossible_problems(monkeypatch: pytest.MonkeyPatch) -> None:
    refuses("'cone'; known: box, sphere", replace, ROP, kinds=("sphere", "cone"))
    refuses("obstacles is from 3 to 2", replace, ROP, obstacles=(3, 2))
    refuses("must not be empty", replace, ROP, kinds=())
    refuses(r"boards\[0\] is 1; it must be at least 2", replace, furniture.SHELF, boards=(1, 3))
    refuses(r"thickness\[0\] is 0.0; it must be positive", replace, furniture.CRATE, thickness=(0.0, 0.02))
    refuses("wall_share is 0.8 and pillar_share 0.3", replace, furniture.TABLE, wall_share=0.8)
    monkeypatch.setattr(drawing, "MAX_SCENES", 2)
    far = replace(ROP, tip_z=(5.0, 6.0))
    refuses("no free start and goal in 2 scenes of Rop for panda", far.draw, PANDA, np.random.default_rng(10))


NAMES = ("shelf", "crate", "table", "clutter", "kitchen", "cabinet")
FURNITURE: dict[str, furniture.Furniture] = {name: getattr(furniture, name.upper()) for name in NAMES}
every_piece = pytest.mark.parametrize("name", FURNITURE)


def named(furnished: furniture.FurnishedScene, name: str) -> list[Shape]:
    return [shape for shape in furnished.scene.shapes if shape.name.split("_")[0] == name]


@every_piece
def test_scenes_stand_on_the_ground_and_have_free_regions_in_reach(name: str) -> None:
    """No obstacle is inside the base, and all obstacles can be packed into arrays."""
    family = FURNITURE[name]
    rng = np.random.default_rng(0)
    assert family.max_obstacles <= 48
    for _ in range(15):
        furnished = family.furnish(rng, BASE)
        floor, *shapes = furnished.scene.shapes
        assert floor is furniture.FLOOR
        packed = PackedScenes.pack([furnished.scene], family.max_obstacles, floor=True)
        assert (packed.kinds > 0).sum() == len(shapes)
        assert (packed.params[packed.kinds == BOX][:, 7:9] == 0).all(), "turned about the vertical only"
        for shape in shapes:
            assert shape.bounds[0, 2] > -1e-12 and (distance(shape, BASE[:, :3]) > BASE[:, 3]).all()
        assert len(furnished.regions) >= 2
        for region in furnished.regions:
            assert (region.size > 0.08).all()
            assert np.linalg.norm(region.center - furniture.SHOULDER) <= family.reach
            assert np.linalg.norm(region.approach) == pytest.approx(1)
            points = region.center + rng.uniform(-0.5, 0.5, (200, 3)) * region.size @ rotation_from_rpy(0.0, 0.0, region.yaw).T
            assert min(distance(shape, points).min() for shape in furnished.scene.shapes) > -1e-9


@pytest.mark.parametrize("name", ["shelf", "crate", "table"])
def test_furniture_is_as_its_settings_say(name: str) -> None:
    rng = np.random.default_rng(0)
    for furnished in (FURNITURE[name].furnish(rng, BASE) for _ in range(60)):
        tops = [table.bounds[1, 2] for table in named(furnished, "table")]
        things = named(furnished, "ball") + named(furnished, "thing")
        if tops:
            assert furniture.TABLE.height[0] <= tops[0] <= furniture.TABLE.height[1]
            assert furniture.TABLE.objects[0] <= len(things) <= furniture.TABLE.objects[1]
            assert all(thing.bounds[0, 2] == pytest.approx(tops[0]) for thing in things)
        assert (2 <= len(named(furnished, "board")) <= 4) == (name == "shelf")
        for region in furnished.regions:
            down = bool((region.approach == [0, 0, -1]).all())
            assert down if name == "crate" else down or region.approach[2] == 0


def test_targets_have_the_fingers_in_the_region() -> None:
    approach = np.array([0.6, 0.0, -0.8])
    region = furniture.Region(np.array([0.5, 0.1, 0.3]), np.array([0.4, 0.2, 2 * furniture.REGION_MARGIN]), 0.7, approach)
    rng = np.random.default_rng(5)
    T = np.stack([furniture.sample_target(region, rng) for _ in range(1000)])
    products = T[:, :3, :3] @ T[:, :3, :3].transpose(0, 2, 1)
    np.testing.assert_allclose(products, np.broadcast_to(np.eye(3), (1000, 3, 3)), atol=1e-12)
    local = (T[:, :3, 3] + 0.1 * T[:, :3, 2] - region.center) @ rotation_from_rpy(0.0, 0.0, 0.7)
    assert (np.abs(local) <= region.size / 2 - furniture.REGION_MARGIN + 1e-12).all()
    assert (np.abs(local).max(axis=0) > 0.95 * (region.size / 2 - furniture.REGION_MARGIN) - 1e-12).all()
    cosines = T[:, :3, 2] @ approach
    least = np.cos(furniture.MAX_TILT)
    assert cosines.min() > least - 1e-12
    # uniform on the cap: the cosine is uniform; mean of 1000 draws within five standard deviations
    assert abs(cosines.mean() - (1 + least) / 2) < 5 * (1 - least) / np.sqrt(12 * 1000)


@every_piece
def test_impossible_settings(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(furniture, "MAX_TRIES", 5)
    short = replace(FURNITURE[name], reach=0.01)
    refuses("each of 5 scenes of .*; change distance, reach or objects", short.furnish, np.random.default_rng(6), BASE)
