"""Valid files and requests, which fuzzing damages."""

from typing import Any

import numpy as np

PROBLEM: dict[str, Any] = {
    "robot": "panda",
    "locked": {"panda_finger_joint1": 0.04, "panda_finger_joint2": 0.04},
    "scene": [
        {"sphere": {"center": [0.5, 0.3, 0.6], "radius": 0.25, "name": "ball"}},
        {"box": {"center": [0.0, 0.6, 0.4], "size": [0.2, 0.2, 0.2], "wxyz": [1, 0, 0, 0]}},
        {"cylinder": {"center": [0.4, -0.6, 0.2], "radius": 0.05, "height": 0.4, "wxyz": [1, 0, 0, 0]}},
        {"capsule": {"center": [0.4, -0.6, 0.9], "radius": 0.05, "height": 0.4}},
        {"mesh": {"vertices": [[1, 1, 0], [1, 2, 0], [2, 1, 0]], "faces": [[0, 1, 2]], "xyz": [0, 0, 1]}},
        {"point_cloud": {"points": [[1, 1, 1], [1, 1, 1.1]], "point_radius": 0.01}},
    ],
    "start": [0, -0.785, 0, -2.356, 0, 1.571, 0.785],
    "goal": {"joints": [0.4, -0.785, 0, -2.356, 0, 1.571, 0.785]},
    "clearance": 0.01,
}
SMALL = PROBLEM | {"scene": PROBLEM["scene"][:1]}
ROWS = np.linspace(PROBLEM["start"], PROBLEM["goal"]["joints"], 3).tolist()
POSE = {"frame": "panda_hand", "xyz": [0.5, 0, 0.5], "wxyz": [0, 1, 0, 0]}
VIEW = {"cloud": [[1, 0, 1], [1, 0.1, 1]], "camera": {"xyz": [0, 0, 1], "wxyz": [0.5, 0.5, 0.5, 0.5]}}
SUCKER = {"cylinder": {"center": [0, 0, 0.09], "radius": 0.012, "height": 0.1}}
EQUIPPED: dict[str, Any] = {
    "base": {"xyz": [0.0, 0.0, 0.7], "wxyz": [1, 0, 0, 0]},
    "tool": {"link": "panda_hand", "name": "sucker", "xyz": [0, 0, 0.14], "shapes": [SUCKER]},
    "attached": [{"link": "sucker", "box": {"center": [0, 0, 0.06], "size": [0.1, 0.1, 0.1], "name": "parcel"}}],
    "goal": {"pose": {"frame": "parcel", "xyz": [0.45, 0.3, 1.0], "wxyz": [0, 1, 0, 0]}},
    "waypoints": [{"joints": [0.2, -0.785, 0, -2.356, 0, 1.571, 0.785]}],
}
CONSTRAINED: dict[str, Any] = {
    "constraints": [
        {"axis_cone": {"frame": "panda_hand", "axis": [0, 0, 1], "direction": [0, 0, -1], "angle": 0.17}},
        {"position_box": {"frame": "panda_hand", "low": [0, -1, 0], "high": [1, 1, 1], "xyz": [0, 0, 0.1]}},
        {"on_plane": {"frame": "panda_hand", "point": [0, 0, 0.4], "normal": [0, 0, 1], "tolerance": 0.1}},
        {"on_line": {"frame": "panda_hand", "point": [0.5, 0, 0.4], "direction": [0, 1, 0], "tolerance": 1}},
        {"cartesian_line": {"frame": "panda_hand", "tolerance": 0.1, "angle": 0.5, "speed": 0.1}},
    ],
    "goal": {"pose": POSE | {"xyz_tolerance": [0.1, 0.1, 0], "rpy_tolerance": [0, 0, 3.1]}},
}
POSES = [{"xyz": [0.6, 0, 0.3]}, {"xyz": [0.6, 1, 0.3], "wxyz": [1, 0, 0, 0]}]
MOVING: dict[str, Any] = {
    "moving": [
        {"sphere": {"center": [0.5, -0.6, 0.5], "radius": 0.1}, "velocity": [0, 0.3, 0]},
        {"box": {"center": [0.6, 0, 0.3], "size": [0.2, 0.2, 0.2]}, "times": [0, 2], "poses": POSES},
        {"sphere": {"center": [0.5, 0.6, 0.5], "radius": 0.1, "name": "hand"}, "max_speed": 0.5},
    ]
}
IN_MOTION: dict[str, Any] = {"start_velocity": [0.1, 0, 0, 0, 0, 0, 0]}
WORLD = {"header": {"frame_id": "world"}}
TABLE = WORLD | {"child_frame_id": "table", "transform": {"translation": [0, 0, 0], "rotation": [0, 0, 0, 1]}}
CAN = WORLD | {
    "id": "Can",
    "primitives": [{"type": "cylinder", "dimensions": [0.2, 0.03]}, {"type": 1, "dimensions": [1, 1, 1]}],
    "primitive_poses": [{"position": [1, 1, 1], "orientation": [0, 0, 0, 1]}] * 2,
    "meshes": [{"vertices": [[1, 1, 0], [1, 2, 0], [2, 1, 0]], "triangles": [[0, 1, 2]]}],
    "mesh_poses": [{"position": {"x": 0, "y": 0, "z": 0}, "orientation": [0, 0, 0, 1]}],
}
MOVEIT = {"name": "", "robot_model_name": "panda", "fixed_frame_transforms": [TABLE], "world": {"collision_objects": [CAN]}}
JOINTS = [f"panda_joint{i}" for i in range(1, 8)]
CUP = {"header": {"frame_id": "panda_hand"}, "id": "cup", "primitives": [{"type": 3, "dimensions": [0.2, 0.03]}]}
CUP |= {"primitive_poses": [{"position": [0, 0, 0.15], "orientation": [0, 0, 0, 1]}]}
HELD = {"link_name": "panda_hand", "touch_links": ["panda_leftfinger"], "object": CUP}
REQUEST: dict[str, Any] = {
    "start_state": {"joint_state": {"name": JOINTS, "position": PROBLEM["start"]}},
    "goal_constraints": [
        {"joint_constraints": [{"joint_name": n, "position": p} for n, p in zip(JOINTS, PROBLEM["start"], strict=True)]}
    ],
}
URDF = b"""<?xml version="1.0"?>
<robot name="two">
<link name="base"><collision><origin xyz="0 0 0" rpy="0 0 0"/>
<geometry><box size="0.1 0.1 0.1"/></geometry></collision></link>
<link name="upper"><collision><geometry><cylinder radius="0.03" length="0.3"/></geometry></collision></link>
<link name="lower"><collision><geometry><mesh filename="part.stl" scale="1 1 1"/></geometry>
</collision></link>
<link name="finger"><visual><geometry><sphere radius="0.01"/></geometry></visual></link>
<joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/>
<origin xyz="0 0 0.1" rpy="0 0 0"/><axis xyz="0 0 1"/><limit lower="-2" upper="2" velocity="1"/></joint>
<joint name="elbow" type="continuous"><parent link="upper"/><child link="lower"/>
<axis xyz="0 1 0"/><limit velocity="1"/></joint>
<joint name="grip" type="prismatic"><parent link="lower"/><child link="finger"/>
<limit lower="0" upper="0.1" velocity="1"/><mimic joint="elbow" multiplier="0.5" offset="0"/></joint>
</robot>"""
SRDF = b"""<robot name="two">
<group name="arm"><chain base_link="base" tip_link="lower"/><group name="other"/></group>
<group name="other"><joint name="grip"/></group>
<group_state name="home" group="arm"><joint name="elbow" value="0.3"/></group_state>
<passive_joint name="grip"/><disable_collisions link1="base" link2="upper" reason="Adjacent"/>
</robot>"""
LIMITS = {"joint_limits": {"shoulder": {"max_velocity": 2.0, "max_acceleration": 3.0, "has_jerk_limits": False}}}
MESHES = ("stl", "obj", "ply", "off", "glb", "dae")
