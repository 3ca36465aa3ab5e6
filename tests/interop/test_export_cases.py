"""Bags that replace others, moving obstacles and bases in exports, and line numbers of CSV files."""

from pathlib import Path

import numpy as np
import pytest

import robotdiffuse as rd
from helpers.box_arm import box_arm
from robotdiffuse.core.errors import InputError
from robotdiffuse.core.transforms import transform
from robotdiffuse.core.types import Trajectory
from robotdiffuse.interop import read_motion, rosbag, write_motion
from robotdiffuse.problems.problem import Problem
from robotdiffuse.scenes.scene import Scene

ARM = box_arm()
ROWS = np.zeros((2, 3))
MOTION = Trajectory(ARM.joint_names, np.array([0.0, 2.0]), ROWS, ROWS, ROWS)
CART = rd.MovingObstacle(rd.Box([2.0, 0.0, 0.0], [0.2, 0.2, 0.2], name="cart"), velocity=[0.5, 0.0, 0.0])
PERSON = rd.MovingObstacle(rd.Sphere([0.0, 3.0, 0.0], 0.3, "person"), max_speed=0.1)
PROBLEM = Problem(
    ARM, Scene(), ROWS[0], ROWS[0], moving=[CART, PERSON], T_world_base=transform(np.array([0.0, 0.0, 1.0]))
)


def test_a_bag_replaces_a_link_to_one(tmp_path: Path) -> None:
    """It failed, since a folder cannot be renamed to a link."""
    link, first = tmp_path / "m.rosbag2", tmp_path / "first.rosbag2"
    write_motion(PROBLEM, MOTION, first)
    link.symlink_to(first)
    write_motion(PROBLEM, MOTION, link)
    assert not link.is_symlink() and {path.name for path in tmp_path.iterdir()} == {link.name, first.name}
    for bag in (first, link):
        assert read_motion(bag).joint_names == ARM.joint_names


def test_a_bag_that_cannot_be_replaced_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The old bag was removed before the new one was in its place."""
    bag = tmp_path / "m.rosbag2"
    write_motion(PROBLEM, MOTION, bag)
    replace = Path.replace

    def failing(path: Path, target: Path) -> Path:
        if path.name == target.name == bag.name:
            raise OSError("interrupted")
        return replace(path, target)

    monkeypatch.setattr(Path, "replace", failing)
    with pytest.raises(InputError, match=r"m\.rosbag2 cannot be written: interrupted"):
        write_motion(PROBLEM, MOTION, bag)
    assert read_motion(bag).joint_names == ARM.joint_names and [*tmp_path.iterdir()] == [bag]


def test_two_exports_to_one_bag_do_not_share_a_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each deleted the half-written bag of the other."""
    bag, to_message = tmp_path / "m.rosbag2", rosbag.to_message

    def interrupted(kind: str, content: dict) -> object:
        monkeypatch.setattr(rosbag, "to_message", to_message)
        write_motion(PROBLEM, MOTION, bag)
        return to_message(kind, content)

    monkeypatch.setattr(rosbag, "to_message", interrupted)
    write_motion(PROBLEM, MOTION, bag)
    assert read_motion(bag).joint_names == ARM.joint_names and [*tmp_path.iterdir()] == [bag]


def test_mcap_shows_moving_obstacles_in_frames_of_their_own(tmp_path: Path) -> None:
    """They were left out."""
    from mcap.reader import make_reader
    from mcap_protobuf.decoder import DecoderFactory

    write_motion(PROBLEM, MOTION, tmp_path / "m.mcap")
    with (tmp_path / "m.mcap").open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        [(_, _, _, scene)] = reader.iter_decoded_messages(topics=["/scene"])
        updates = [found for *_, found in reader.iter_decoded_messages(topics=["/tf"])]
    entities = {entity.id: entity for entity in scene.entities}
    assert entities["cart"].frame_id == "moving/cart" and entities["cart"].cubes[0].pose.position.x == 0.0
    places = [{of.child_frame_id: of.translation for of in update.transforms} for update in updates]
    assert [place["moving/cart"].x for place in places] == [2.0, 3.0]
    assert [place["moving/person"].y for place in places] == [3.0, 3.0]


def test_rerun_shows_moving_obstacles_and_where_the_base_stands(tmp_path: Path) -> None:
    """Both were left out."""
    from rerun.chunk import RrdReader

    write_motion(PROBLEM, MOTION, tmp_path / "m.rrd")
    found: dict[str, list] = {}
    for chunk in RrdReader(tmp_path / "m.rrd").stream().to_chunks():
        batch = chunk.to_record_batch()
        if "Transform3D:translation" in batch.schema.names:
            rows = batch.column("Transform3D:translation").to_pylist()
            found.setdefault(str(chunk.entity_path), []).extend(row[0] for row in rows)
    assert found["/scene/cart"] == [[2.0, 0.0, 0.0], [3.0, 0.0, 0.0]]
    assert found["/scene"] == found["/robot"] == [[0.0, 0.0, 1.0]]


def test_lines_of_a_csv_file_are_counted_with_blank_ones(tmp_path: Path) -> None:
    (tmp_path / "m.csv").write_text("\ntime,a\n\n0,1\n\n1,x\n")
    with pytest.raises(InputError, match="line 6: a is 'x'"):
        read_motion(tmp_path / "m.csv")
