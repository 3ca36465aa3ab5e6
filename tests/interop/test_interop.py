"""Round trips of exported motions, motions of other programs, and cases that failed earlier."""

import json
import os
import sys
import threading
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import robotdiffuse as rd
from helpers import waiting
from helpers.box_arm import box_arm
from helpers.commands import GOAL, START
from helpers.full_disk import full_disk
from helpers.made_arms import chain, written
from helpers.panda import PANDA
from helpers.refusals import refuses
from robotdiffuse import Problem, Scene, Trajectory
from robotdiffuse.core.errors import OutputError
from robotdiffuse.core.transforms import transform
from robotdiffuse.interop import READERS, TRAJECTORY_ENDINGS, WRITERS, read_motion, recorded_motion, ros2, write_motion

NAMES = list(PANDA.joint_names)
FINGERS = ["panda_finger_joint1", "panda_finger_joint2"]
ARM = box_arm()
ROWS = np.zeros((2, 3))
MOTION = Trajectory(ARM.joint_names, np.array([0.0, 2.0]), ROWS, ROWS, ROWS)
CART = rd.MovingObstacle(rd.Box([2.0, 0.0, 0.0], [0.2, 0.2, 0.2], name="cart"), velocity=[0.5, 0.0, 0.0])
PERSON = rd.MovingObstacle(rd.Sphere([0.0, 3.0, 0.0], 0.3, "person"), max_speed=0.1)
PROBLEM = Problem(ARM, Scene(), ROWS[0], ROWS[0], moving=[CART, PERSON], T_world_base=transform(np.array([0.0, 0.0, 1.0])))
Planned = tuple[Problem, Trajectory]


@pytest.fixture(scope="module")
def planned() -> Planned:
    shapes = [
        rd.Sphere([0.5, 0.0, 0.5], 0.2, "ball"),
        rd.Box([0.5, 0, -0.06], [2, 2, 0.1], name="table"),
        rd.Capsule([0, 0.9, 0.4], 0.05, 0.3),
        rd.Cylinder([0, -0.9, 0.4], 0.05, 0.3),
        rd.Mesh([[-1, 0, 0], [-1, 0.1, 0], [-1, 0, 0.1]], [[0, 1, 2]]),
        rd.PointCloud([[-0.9, 0.0, 0.1], [-0.9, 0.1, 0.1]]),
    ]
    problem = Problem(PANDA, Scene(shapes), START, GOAL)
    return problem, rd.load_planner("rrt_connect").plan(problem, time_limit=5.0).trajectory


@pytest.mark.parametrize("ending", [ending for ending in (*WRITERS, ".csv", ".json") if ending in READERS])
def test_what_is_exported_is_read_again_and_validated_the_same(ending: str, planned: Planned, tmp_path: Path) -> None:
    problem, trajectory = planned
    file = tmp_path / f"motion{ending}"
    for _ in range(2):  # a file that is there is replaced
        write_motion(problem, trajectory, file)
    found = recorded_motion.motion_of_robot(read_motion(file), problem.robot)
    assert found.notes == () and isinstance(found.motion, Trajectory)
    np.testing.assert_array_equal(found.motion.positions, trajectory.positions)
    np.testing.assert_array_equal(found.motion.velocities, trajectory.velocities)
    np.testing.assert_allclose(found.motion.times, trajectory.times, atol=1e-9)  # messages count nanoseconds
    here, there = (rd.verify(problem, motion) for motion in (trajectory, found.motion))
    assert (here.valid, here.violation) == (there.valid, there.violation)
    assert there.min_clearance == pytest.approx(here.min_clearance, rel=1e-6)
    assert [path.name for path in tmp_path.iterdir()] == [file.name]


def refuse(file: Path, message: str, topic: str | None = None) -> None:
    refuses(message, read_motion, file, topic)


def in_mcap(file: Path) -> tuple[dict[str, Any], list[Any], dict[str, bytes], list[tuple[str, str]]]:
    """An MCAP file's entities of the scene by name, frames at each time, attachments, and topic and type of each message."""
    from mcap.reader import make_reader
    from mcap_protobuf.decoder import DecoderFactory

    with file.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        [(_, _, _, scene)] = reader.iter_decoded_messages(topics=["/scene"])
        frames = [found.transforms for *_, found in reader.iter_decoded_messages(topics=["/tf"])]
        attached = {attachment.name: attachment.data for attachment in reader.iter_attachments()}
        messages = [(channel.topic, schema.name) for schema, channel, _ in reader.iter_messages() if schema]
    return {entity.id: entity for entity in scene.entities}, frames, attached, messages


def test_mcap_holds_scene_urdf_frames_and_joint_states(planned: Planned, tmp_path: Path) -> None:
    problem, trajectory = planned
    write_motion(problem, trajectory, tmp_path / "m.mcap")
    entities, frames, attached, messages = in_mcap(tmp_path / "m.mcap")
    topics = [topic for topic, _ in messages]
    assert topics.count("/tf") == topics.count("/joint_states") == len(trajectory.times)
    assert topics.count("/joint_trajectory") == topics.count("/points/point_cloud") == 1
    assert entities["ball"].spheres[0].size.x == 0.4 and entities["table"].frame_id == "panda_link0"
    assert {"capsule", "cylinder", "mesh"} <= entities.keys()
    assert any(name.startswith("panda_link5/") for name in entities)
    assert {entity.frame_id for entity in entities.values()} <= {frame.child_frame_id for frame in frames[0]} | {"panda_link0"}
    assert json.loads(attached["problem.json"])["start"] == START
    found = recorded_motion.motion_of_robot(read_motion(tmp_path / "m.mcap", "/joint_states"), PANDA)
    assert "panda_finger_joint1, panda_finger_joint2 stay at their locked values" in found.notes
    np.testing.assert_array_equal(found.motion.positions, trajectory.positions)
    refuse(tmp_path / "m.mcap", r"topic '/tf' holds no motion; topics: .*/joint_trajectory", "/tf")
    write_motion(replace(problem, T_world_base=transform(np.array([1.0, 2.0, 3.0]))), trajectory, tmp_path / "m.mcap")
    again = ros2.problem_in(tmp_path / "m.mcap")
    assert again is not None and rd.verify(again, trajectory).valid
    # regression: each joint had another one's value
    turned = replace(trajectory, joint_names=trajectory.joint_names[::-1])
    refuses("trajectory.joint_names is", write_motion, problem, turned, tmp_path / "m.mcap")


def test_a_urdf_goes_along(tmp_path: Path) -> None:
    urdf = written(tmp_path, chain("base", ["a"]))
    robot = rd.load_robot(str(urdf))
    still = np.zeros((2, 1))
    motion = Trajectory(robot.joint_names, np.array([0.0, 1.0]), still, still, still)
    write_motion(Problem(robot, Scene(), [0.0], [0.0]), motion, tmp_path / "m.mcap")
    _, _, attached, messages = in_mcap(tmp_path / "m.mcap")
    assert urdf.read_bytes() in attached.values()
    assert ("/robot_description", "std_msgs/msg/String") in messages


def in_rrd(file: Path, column: str) -> dict[str, list[Any]]:
    """The values of a column by entity; empty for entities without this column."""
    from rerun.chunk import RrdReader

    found: dict[str, list[Any]] = {}
    for chunk in RrdReader(file).stream().to_chunks():
        values = found.setdefault(str(chunk.entity_path), [])
        batch = chunk.to_record_batch()
        if column in batch.schema.names:
            values += [row[0] for row in batch.column(column).to_pylist()]
    return found


def test_rerun_recordings_hold_the_joints(planned: Planned, tmp_path: Path) -> None:
    problem, trajectory = planned
    write_motion(problem, trajectory, tmp_path / "m.rrd")
    found = in_rrd(tmp_path / "m.rrd", "Scalars:scalars")
    assert {"/scene/ball", "/scene/capsule", "/scene/mesh", "/robot/panda_link5"} <= found.keys()
    for j, name in enumerate(trajectory.joint_names):
        np.testing.assert_array_equal(found[f"/joints/{name}/positions"], trajectory.positions[:, j])


@pytest.mark.parametrize("name", ["m.mcap", "bag"])
@pytest.mark.parametrize("compression", ["ZSTD", "LZ4"])
def test_unpacked_gigabytes_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, compression: str) -> None:
    """Regression: a file of 105 kB took 6 GB of memory."""
    from mcap.writer import CompressionType, Writer

    monkeypatch.setattr(ros2, "MAX_UNPACKED", 100_000)
    folder = tmp_path / "bag"
    folder.mkdir()
    (folder / "metadata.yaml").write_text("rosbag2_bagfile_information: {version: 9}")
    with (folder / "m.mcap").open("wb") as stream:
        writer = Writer(stream, chunk_size=200_000, compression=CompressionType[compression])
        writer.start()
        schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data")
        writer.add_message(writer.register_channel("/joint_trajectory", "cdr", schema), 0, bytes(150_000), 0)
        writer.finish()
    assert (folder / "m.mcap").stat().st_size < 5_000
    (tmp_path / "m.mcap").write_bytes((folder / "m.mcap").read_bytes())
    refuse(tmp_path / name, r"m\.mcap has a chunk of 150,\d+ bytes; 100,000 are allowed")


def test_a_motion_of_too_many_messages_is_refused(planned: Planned, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_motion(*planned, tmp_path / "m.mcap")
    write_motion(*planned, tmp_path / "bag.rosbag2")
    monkeypatch.setattr(ros2, "checked_reader", lambda stream, where: ros2.make_reader(stream))
    monkeypatch.setattr(ros2, "MAX_UNPACKED", 100)
    for name in ("m.mcap", "bag.rosbag2"):
        refuse(tmp_path / name, "the messages of /joint_trajectory take more than 100 bytes", "/joint_trajectory")


@pytest.mark.parametrize("ending", sorted([*WRITERS, *TRAJECTORY_ENDINGS]))
def test_a_disk_that_fills_up_is_one_line(planned: Planned, tmp_path: Path, ending: str) -> None:
    """Regression: ROS 2 bags and Rerun's recordings ended with tracebacks of SQLite and of Rerun."""
    problem, trajectory = planned
    with full_disk(4096), pytest.raises(OutputError, match=r"m\.\w+ cannot be written: ") as caught:
        write_motion(problem, trajectory, tmp_path / f"m{ending}")
    assert "\n" not in str(caught.value) and not list(tmp_path.iterdir())


def panda_record(**changes: Any) -> dict[str, Any]:
    points = [{"positions": START, "velocities": [0.0] * 7, "time_from_start": {"sec": t, "nanosec": 0}} for t in (0, 1)]
    return {"joint_names": [*NAMES], "points": points} | changes


def test_joints_are_put_into_order_by_name() -> None:
    record = panda_record()
    record["joint_names"].reverse()
    for point in record["points"]:
        point["positions"] = point["positions"][::-1]
    found = recorded_motion.motion_of_robot(recorded_motion.motion_from_record(record, "it"), PANDA)
    assert found.motion.positions[0].tolist() == START and "joints were reordered by name" in found.notes
    assert "no accelerations are given: those of the cubics through the rows are validated" in found.notes


def test_all_forms_of_messages_hold_the_same_motion() -> None:
    record = panda_record()
    times = [{"time_from_start": {"secs": t, "nsecs": 0}} for t in (0, 1)]
    forms = (
        record,
        panda_record(points=[point | time for point, time in zip(record["points"], times, strict=True)]),
        {"joint_trajectory": record, "multi_dof_joint_trajectory": {"points": []}},
        {"trajectory": [{"joint_trajectory": record}], "model_id": "panda"},
        {"trajectory": {"joint_trajectory": record}},
    )
    for form in forms:
        found = recorded_motion.motion_from_record(form, "it")
        assert found.times is not None and found.times.tolist() == [0, 1]
        assert found.positions[1].tolist() == START


def test_times_that_begin_later_and_no_times() -> None:
    found = recorded_motion.checked_motion(["a"], [[0.0], [1.0]], [0.5, 1.0])
    assert found.times is not None and found.times.tolist() == [0.0, 0.5]
    assert found.notes == ("times begin at 0.5 s; they were shifted to 0",)
    assert recorded_motion.checked_motion(["a"], [[0.0], [1.0]], [0, 0]).times is None
    assert recorded_motion.checked_motion(["a"], [[0.0], [1.0]]).times is None


def test_positions_and_times_alone_are_validated_on_the_smoothest_curve() -> None:
    robot = box_arm()
    t = np.linspace(0, 2, 41)
    q = np.outer(10 * (t / 2) ** 3 - 15 * (t / 2) ** 4 + 6 * (t / 2) ** 5, [0.5, -0.4, 0.3])
    found = recorded_motion.motion_of_robot(recorded_motion.checked_motion(robot.joint_names, q, t), robot)
    assert isinstance(found.motion, Trajectory)
    report = rd.verify(Problem(robot, Scene(), q[0], q[-1]), found.motion)
    assert report.valid, report.violation
    hasty = recorded_motion.motion_of_robot(recorded_motion.checked_motion(robot.joint_names, q, t / 10), robot).motion
    assert isinstance(hasty, Trajectory)
    refused = rd.verify(Problem(robot, Scene(), q[0], q[-1]), hasty).violation
    assert refused is not None and refused.kind in ("velocity", "acceleration", "jump")


def test_what_a_recording_lacks_is_noted_and_taken_from_the_problem() -> None:
    """Regressions: splines began at rest whatever the `start_velocity`, a first row was not unwrapped; rates without times."""
    robot = rd.load_robot("gen3")
    t = np.linspace(0, 1, 11)
    q = np.array([3.4, 0.3, 0, 1.5, 0, 1, 0]) + np.outer(t - t**2 / 2, np.eye(7)[0])
    problem = Problem(robot, Scene(), q[0], q[-1], start_velocity=np.eye(7)[0])
    recorded = recorded_motion.checked_motion(robot.joint_names, q - [2 * np.pi, 0, 0, 0, 0, 0, 0], t)
    motion, notes = vars(recorded_motion.motion_of_robot(recorded, robot, problem)).values()
    np.testing.assert_allclose(motion.positions, q, atol=1e-12)
    np.testing.assert_allclose(motion.velocities, np.outer(1 - t, np.eye(7)[0]), atol=1e-9)
    assert "jump by whole turns" in notes[0] and "from start_velocity to rest" in notes[1]
    [note] = recorded_motion.checked_motion(robot.joint_names, q, velocities=q).notes
    assert "velocities are ignored" in note


def of_panda(names: list[str], rows: list[list[float]]) -> None:
    recorded_motion.motion_of_robot(recorded_motion.checked_motion(names, rows), PANDA)


def test_bad_motions_are_refused_in_one_line() -> None:
    arrays = recorded_motion.checked_motion
    refuses("joint_names has a more than once", arrays, ["a", "a"], [[0, 0]])
    refuses("positions is empty; it must be n x 1 finite numbers", arrays, ["a"], [])
    refuses(r"positions is \[\[0\], .*; it must be n x 1", arrays, ["a"], [[0], [0, 1]])
    refuses(r"positions\[1\] is \[nan\]; its numbers", arrays, ["a"], [[0], [np.nan]])
    refuses("must be finite and within ±10000", arrays, ["a"], [[1e30]])
    refuses("velocities is an array of 1 x 1", arrays, ["a"], [[0], [1]], [0, 1], [[0]])
    refuses(r"times\[1\] is nan", arrays, ["a"], [[0], [1]], [0, np.nan])
    refuses("times do not increase: 1 s in row 0, 1 s", arrays, ["a"], [[0], [1]], [1, 1])
    refuses(r"times span 1.2e\+06 s; a motion must", arrays, ["a"], [[0], [1]], [0, 1.2e6])
    fast = replace(MOTION, times=1e-12 * MOTION.times)
    refuses("rows 0 and 1 are less than 1 ns apart", recorded_motion.joint_trajectory, fast)
    refuses("the motion lacks panda_joint1", of_panda, NAMES[1:], [START[1:]])
    finger = [*NAMES, FINGERS[0]]
    told = "has panda_finger_joint1 at 0.01, the problem locks it at 0.04: write `locked: {panda_finger_joint1"
    refuses(told, of_panda, finger, [[*START, 0.01]])
    told = "moves panda_finger_joint1 between 0 and 0.04; the problem locks it at 0.04"
    refuses(told, of_panda, finger, [[*START, 0.04], [*START, 0.0]])


def test_bad_records_are_refused_in_one_line() -> None:
    record = recorded_motion.motion_from_record
    refuses(r"it: points is \[\]", record, panda_record(points=[]), "it")
    soon = panda_record(points=[{"positions": START, "time_from_start": "soon"}])
    refuses("time_from_start is 'soon'; it must be a duration", record, soon, "it")
    drives = {"joint_trajectory": panda_record(), "multi_dof_joint_trajectory": {"points": [{}]}}
    refuses("multi_dof_joint_trajectory has points; only arms on a fixed base can be validated", record, drives, "it")
    refuses("trajectory has 2 parts", record, {"trajectory": [{}, {}]}, "it")
    refuses("it holds no motion: its status is 't", record, {"status": "timeout"}, "it")


def test_damaged_files_are_refused_in_one_line(planned: Planned, tmp_path: Path) -> None:
    write_motion(*planned, tmp_path / "m.mcap")
    whole = (tmp_path / "m.mcap").read_bytes()
    for size in (0, 10, 1000, len(whole) // 2, len(whole) - 20):
        (tmp_path / "cut.mcap").write_bytes(whole[:size])
        refuse(tmp_path / "cut.mcap", r"was cut short; `mcap recover` writes")
    bag = tmp_path / "m.rosbag2"
    write_motion(*planned, bag)
    metadata = bag / "metadata.yaml"
    text = metadata.read_text()
    metadata.write_text(text.replace("compression_mode: ''", "compression_mode: FILE"))
    refuse(bag, r"m\.rosbag2 is compressed \(mode 'FILE'\); write it anew with")
    metadata.write_text(text)
    [database] = bag.glob("*.db3")
    refuse(database, "is part of a ROS 2 bag; give the folder")
    whole = database.read_bytes()
    for size in (0, 100, len(whole) // 2):
        database.write_bytes(whole[:size])
        refuse(bag, r"damaged|holds no m")
    database.unlink()
    os.mkfifo(database)
    refuse(bag, r"\.db3 cannot be read: it is a device or a pipe")
    metadata.unlink()
    refuse(bag, r"is not a ROS 2 bag: it has no metadata\.yaml")


def test_bad_csv(tmp_path: Path) -> None:
    for text, wanted in (
        ("", "it is empty"),
        ("time,a\n", "it has a header and no rows"),
        ("time,a\n0,1,2\n", "line 2 has 3 cells; the header has 2"),
        ("time,a\n0,x\n", "line 2: a is 'x'; it must be a number"),
        ("\ntime,a\n\n0,1\n\n1,x\n", "line 6: a is 'x'"),
        ("time,a,a_position\n0,1,1\n", "the header has positions of 'a' more than once"),
        ("time,a,b_velocity\n0,1,1\n", "both positions and velocities of a, b, or neither"),
        ("time,a\n0,nan\n", "must be finite"),
        (",time,a\n0,0,1\n", "column 1 of the header has no name"),  # the index that pandas writes
    ):
        (tmp_path / "m.csv").write_text(text)
        refuse(tmp_path / "m.csv", rf"^{tmp_path}/m\.csv.*{wanted}")


def test_names_of_joints_are_no_formulas_for_a_spreadsheet(tmp_path: Path) -> None:
    names = ("=1+1", "-a", "+b", "@c", "plain")
    rows = np.arange(10.0).reshape(2, 5) - 4
    Trajectory(names, np.array([0.0, 1.0]), rows, rows, rows).save(tmp_path / "m.csv")
    header = (tmp_path / "m.csv").read_text().partition("\n")[0].split(",")
    assert not [cell for cell in header if cell[0] in "=+-@"] and "plain_position" in header
    again = read_motion(tmp_path / "m.csv")
    assert again.joint_names == names and (again.positions == rows).all()


def test_yaml_as_ros2_topic_echo_prints_it(tmp_path: Path) -> None:
    (tmp_path / "m.yaml").write_text(
        "header:\n  stamp: {sec: 0, nanosec: 0}\n  frame_id: ''\njoint_names: [a, b]\npoints:\n"
        "- positions: [0.0, 1.0]\n  velocities: []\n  accelerations: []\n  effort: []\n"
        "  time_from_start: {sec: 0, nanosec: 500000000}\n---\n"
    )
    found = read_motion(tmp_path / "m.yaml")
    assert found.joint_names == ("a", "b") and found.velocities is None


def test_a_motion_alone_says_what_it_solves() -> None:
    motion = recorded_motion.checked_motion([*NAMES, *FINGERS], [[*START, 0.01, 0.02], [*GOAL, 0.01, 0.02]])
    problem = recorded_motion.problem_of_motion(motion, PANDA, Scene())
    assert problem.robot.locked == {"panda_finger_joint1": 0.01, "panda_finger_joint2": 0.02}
    assert recorded_motion.motion_of_robot(motion, problem.robot).motion.positions[-1].tolist() == GOAL


def test_unknown_endings_list_the_known_ones(planned: Planned, tmp_path: Path) -> None:
    refuses(r"unknown ending '\.foo'; known: \.json, \.csv, \.mcap", write_motion, *planned, tmp_path / "m.foo")
    refuses(r"unknown motion format '\.foo'; known: \.csv", read_motion, tmp_path / "m.foo")
    refuses("does not exist", write_motion, *planned, tmp_path / "none" / "m.mcap")


@pytest.mark.parametrize(
    ("module", "package", "extra", "use"),
    [
        ("mcap.reader", "mcap", "ros", lambda: import_module("robotdiffuse.interop.ros2")),
        ("rerun", "rerun-sdk", "rerun", lambda: import_module("robotdiffuse.interop.rerun_file")),
        ("roslibpy", "roslibpy", "ros", lambda: recorded_motion.publish(MOTION, "", 1, "/a", 1.0)),
    ],
)
def test_a_missing_extra_says_what_to_install(module: str, package: str, extra: str, use, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    for name in ("ros2", "rerun_file"):
        monkeypatch.delitem(sys.modules, f"robotdiffuse.interop.{name}", raising=False)
    refuses(rf'{package}, .*pip install "robotdiffuse\[{extra}\]"', use)


def test_motions_are_published_to_a_rosbridge_or_no_bridge_answers(planned: Planned, monkeypatch: pytest.MonkeyPatch) -> None:
    """Regression: the publisher sent and ended at once, before subscribers had connected to it."""
    from websockets.sync.server import serve

    from robotdiffuse.interop import recorded_motion

    _, trajectory = planned
    waited: list[str] = []
    heard: list[dict[str, Any]] = []

    def wait(_: float) -> None:
        waiting.until(lambda: len(heard) > len(waited), 300.0)
        waited.append(heard[-1]["op"])

    monkeypatch.setattr(recorded_motion, "sleep", wait)
    with serve(lambda client: heard.extend(map(json.loads, client)), "127.0.0.1", 0) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        recorded_motion.publish(trajectory, "127.0.0.1", server.socket.getsockname()[1], "/arm/joint_trajectory", 5.0)
        server.shutdown()
    assert waited == ["advertise", "publish"]
    advertised, published = heard[:2]
    assert (advertised["op"], advertised["type"]) == ("advertise", "trajectory_msgs/msg/JointTrajectory")
    assert (published["op"], published["topic"]) == ("publish", "/arm/joint_trajectory")
    assert published["msg"] == recorded_motion.joint_trajectory(trajectory)
    found = recorded_motion.motion_of_robot(recorded_motion.motion_from_record(published["msg"], "it"), PANDA).motion
    np.testing.assert_array_equal(found.positions, trajectory.positions)
    refuses(r"no rosbridge answers at 127\.0\.0\.1:1 within 1 s", recorded_motion.publish, MOTION, "127.0.0.1", 1, "/a", 1.0)


def test_a_bag_replaces_a_link_to_one(tmp_path: Path) -> None:
    """Regression: writing failed, since a folder cannot be renamed to a link."""
    link = tmp_path / "m.rosbag2"
    first = tmp_path / "first.rosbag2"
    write_motion(PROBLEM, MOTION, first)
    link.symlink_to(first)
    write_motion(PROBLEM, MOTION, link)
    assert not link.is_symlink() and {path.name for path in tmp_path.iterdir()} == {link.name, first.name}
    for bag in (first, link):
        assert read_motion(bag).joint_names == ARM.joint_names


def test_a_bag_that_cannot_be_replaced_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Regression: the old bag was removed before the new one was complete."""
    bag = tmp_path / "m.rosbag2"
    write_motion(PROBLEM, MOTION, bag)
    move = Path.replace

    def failing(path: Path, target: Path) -> Path:
        if path.name == target.name == bag.name:
            raise OSError("interrupted")
        return move(path, target)

    monkeypatch.setattr(Path, "replace", failing)
    refuses(r"m\.rosbag2 cannot be written: interrupted", write_motion, PROBLEM, MOTION, bag)
    assert read_motion(bag).joint_names == ARM.joint_names and [*tmp_path.iterdir()] == [bag]


def test_two_exports_to_one_bag_do_not_share_a_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Regression: each export deleted the incomplete bag of the other."""
    bag = tmp_path / "m.rosbag2"
    to_message = ros2.to_message

    def interrupted(kind: str, content: dict) -> object:
        monkeypatch.setattr(ros2, "to_message", to_message)
        write_motion(PROBLEM, MOTION, bag)
        return to_message(kind, content)

    monkeypatch.setattr(ros2, "to_message", interrupted)
    write_motion(PROBLEM, MOTION, bag)
    assert read_motion(bag).joint_names == ARM.joint_names and [*tmp_path.iterdir()] == [bag]


def test_moving_obstacles_and_where_the_base_stands_are_in_mcap_and_rerun_files(tmp_path: Path) -> None:
    """Regression: moving obstacles and the pose of the base were left out."""
    write_motion(PROBLEM, MOTION, tmp_path / "m.mcap")
    entities, frames, _, _ = in_mcap(tmp_path / "m.mcap")
    assert entities["cart"].frame_id == "moving/cart" and entities["cart"].cubes[0].pose.position.x == 0.0
    places = [{of.child_frame_id: of.translation for of in now} for now in frames]
    assert [place["moving/cart"].x for place in places] == [2.0, 3.0]
    assert [place["moving/person"].y for place in places] == [3.0, 3.0]
    [base] = [found for found in frames[0] if found.parent_frame_id == "world"]
    assert base.child_frame_id == ARM.base and base.translation.z == 1.0
    write_motion(PROBLEM, MOTION, tmp_path / "m.rrd")
    found = in_rrd(tmp_path / "m.rrd", "Transform3D:translation")
    assert found["/scene/cart"] == [[2.0, 0.0, 0.0], [3.0, 0.0, 0.0]]
    assert found["/scene"] == found["/robot"] == [[0.0, 0.0, 1.0]]
