"""MoveIt requests: what is read, and what is refused rather than ignored."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from helpers.moveit_files import MOTION_BENCH_MAKER, change, request_data
from robotdiffuse import InputError, PoseGoal, load_robot
from robotdiffuse.core.transforms import (
    quaternion_from_rotation,
    rotation_from_quaternion,
    transform,
)
from robotdiffuse.problems.files import (
    load_motion_bench_maker,
    problem_record,
)
from robotdiffuse.problems.moveit import MoveItFrames, moveit_frames, moveit_request
from robotdiffuse.robots.kinematics import link_pose


def pose_constraint() -> dict[str, Any]:
    region = {"primitive_poses": [{"position": [0.4, 0, 0.5], "orientation": [0, 0, 0, 1]}]}
    return {
        "position_constraints": [{"link_name": "panda_hand", "constraint_region": region}],
        "orientation_constraints": [{"link_name": "panda_hand", "orientation": [1, 0, 0, 0]}],
    }


def test_several_goal_constraints_are_a_set() -> None:
    data = request_data()
    data["goal_constraints"].append(data["goal_constraints"][0])
    assert len(moveit_request(data, moveit_frames({})).joint_goals) == 2


def test_pose_goal(tmp_path: Path) -> None:
    for file in MOTION_BENCH_MAKER.glob("*0001.yaml"):
        shutil.copy(file, tmp_path)
    data = request_data() | {"goal_constraints": [pose_constraint()]}
    (tmp_path / "request0001.yaml").write_text(yaml.safe_dump(data))
    goal = load_motion_bench_maker(tmp_path)[0].load().goal
    assert isinstance(goal, PoseGoal) and goal.frame == "panda_hand"
    np.testing.assert_allclose(goal.T_base_frame[:3, 3], [0.4, 0, 0.5])
    np.testing.assert_allclose(goal.T_base_frame[:3, :3], np.diag([1.0, -1, -1]), atol=1e-12)
    link, T = moveit_request(data, MoveItFrames(None, np.diag([-1.0, -1, 1, 1]))).pose_goal or ("", np.eye(4))
    assert link == "panda_hand"
    np.testing.assert_allclose(T[:3, 3], [-0.4, 0, 0.5])
    flipped = np.diag([-1.0, -1, 1]) @ rotation_from_quaternion(np.array([0.0, 1, 0, 0]))
    np.testing.assert_allclose(T[:3, :3], flipped, atol=1e-12)


@pytest.mark.parametrize("frame", ["panda_hand", "world"])
def test_objects_are_held_at_the_start(frame: str, tmp_path: Path) -> None:
    for file in MOTION_BENCH_MAKER.glob("*0001.yaml"):
        shutil.copy(file, tmp_path)
    bare = load_motion_bench_maker(tmp_path)[0].load()
    T_base_hand = link_pose(bare.robot, bare.start, "panda_hand")
    T = (
        T_base_hand @ transform(np.array([0.0, 0.0, 0.2]))
        if frame == "world"
        else transform(np.array([0, 0, 0.2]))
    )
    x, y, z, w = np.roll(quaternion_from_rotation(T[:3, :3]), -1).tolist()
    held = {
        "link_name": "panda_hand",
        "touch_links": ["panda_link6", "no_link_of_it"],
        "object": {
            "header": {"frame_id": frame},
            "id": "rod",
            "primitives": [{"type": "cylinder", "dimensions": [0.2, 0.01]}],
            "primitive_poses": [{"position": T[:3, 3].tolist(), "orientation": [x, y, z, w]}],
        },
    }
    data = change(request_data(), ["start_state", "attached_collision_objects"], [held])
    (tmp_path / "request0001.yaml").write_text(yaml.safe_dump(data))
    problem = load_motion_bench_maker(tmp_path)[0].load()
    [rod] = problem.robot.attached
    assert rod.name == "rod" and rod.touch_links == ("panda_link6",)
    np.testing.assert_allclose(rod.T_link_body, transform(np.array([0.0, 0.0, 0.2])), atol=1e-9)
    T_world = problem_record(problem)["attached"][0]["cylinder"]  # type: ignore[index]
    np.testing.assert_allclose(T_world["center"], [0, 0, 0.2], atol=1e-9)


def pose_request(path: list[Any], value: object) -> dict[str, Any]:
    return request_data() | {"goal_constraints": [change(pose_constraint(), path, value)]}


def test_scaling_factors_are_noted() -> None:
    asked = {"max_velocity_scaling_factor": 0.1, "max_acceleration_scaling_factor": 1.0}
    request = moveit_request(request_data() | asked, moveit_frames({}, load_robot("panda")))
    [note] = request.notes
    assert note == (
        "the request's max_velocity_scaling_factor 0.1 is ignored: plan with velocity_scaling=0.1"
    )


def test_the_velocity_of_a_start_state_is_noted() -> None:
    asked = request_data()
    asked["start_state"]["joint_state"]["velocity"] = [0.0, 0.3]
    [note] = moveit_request(asked, moveit_frames({}, load_robot("panda"))).notes
    assert note == "start_state.joint_state.velocity [0.0, 0.3] is ignored: the motion begins at rest"


WRONG_REQUESTS: dict[str, tuple[object, str]] = {
    "number": (3, "a motion plan request is 3"),
    "no goal": (request_data() | {"goal_constraints": []}, "goal_constraints is empty"),
    "path constraints": (
        request_data() | {"path_constraints": {"joint_constraints": [1]}},
        "path_constraints",
    ),
    "reference": (request_data() | {"reference_trajectories": [{}]}, "reference_trajectories is not supp"),
    "cartesian speed": (request_data() | {"max_cartesian_speed": 0.1}, "max_cartesian_speed is not supp"),
    "scaling": (
        request_data() | {"max_velocity_scaling_factor": 2},
        "max_velocity_scaling_factor is 2; it must be a number from 0 to 1",
    ),
    "attached": (
        change(request_data(), ["start_state", "attached_collision_objects"], [1]),
        r"attached_collision_objects\[0\] is 1; it must be a mapping",
    ),
    "attached shape": (
        change(
            request_data(),
            ["start_state", "attached_collision_objects"],
            [{"link_name": "panda_hand", "object": {"planes": [1], "header": {"frame_id": "panda_hand"}}}],
        ),
        r"attached_collision_objects\[0\].object: planes\[0\] is 1; it must be a mapping",
    ),
    "positions": (
        change(request_data(), ["start_state", "joint_state", "position"], [0]),
        "9 finite numbers",
    ),
    "value": (
        change(request_data(), ["goal_constraints", 0, "joint_constraints", 2, "position"], None),
        r"goal_constraints\[0\].joint_constraints\[2\].position is \[None\]",
    ),
    "two poses": (
        request_data() | {"goal_constraints": [pose_constraint(), pose_constraint()]},
        "joint_constraints alone, or be the only goal",
    ),
    "position alone": (pose_request(["orientation_constraints"], []), "one position and one orientation"),
    "two links": (
        pose_request(["orientation_constraints", 0, "link_name"], "x"),
        "both must constrain one link",
    ),
    "offset": (pose_request(["position_constraints", 0, "target_point_offset"], [0, 0, 1]), "must be zero"),
    "region": (pose_request(["position_constraints", 0, "constraint_region"], {}), "has 0 primitive_poses"),
}


@pytest.mark.parametrize("case", WRONG_REQUESTS)
def test_wrong_requests(case: str) -> None:
    data, message = WRONG_REQUESTS[case]
    with pytest.raises(InputError, match=message) as raised:
        moveit_request(data, moveit_frames({}))
    assert "\n" not in str(raised.value)


def test_goal_without_a_joint(tmp_path: Path) -> None:
    for file in MOTION_BENCH_MAKER.glob("*0001.yaml"):
        shutil.copy(file, tmp_path)
    data = request_data()
    del data["goal_constraints"][0]["joint_constraints"][3]
    (tmp_path / "request0001.yaml").write_text(yaml.safe_dump(data))
    [entry] = load_motion_bench_maker(tmp_path)
    assert "goal_constraints[0] has no value for panda_joint4" in entry.error
