"""MoveIt planning scenes and requests for tests."""

from copy import deepcopy
from pathlib import Path
from typing import Any

from robotdiffuse.core.input_files import read_yaml

MOTION_BENCH_MAKER = Path(__file__).parents[1] / "files" / "motion_bench_maker"
QUARTER = [0, 0, 0.7071067811865476, 0.7071067811865476]
"""xyzw of a quarter turn about z."""
MOUNTED = """<robot name="mounted">
  <link name="world"/><link name="stand"/>
  <link name="base"><collision><geometry><box size="0.1 0.1 0.1"/></geometry></collision></link>
  <link name="arm"><collision>
    <origin xyz="0.3 0 0"/><geometry><box size="0.4 0.05 0.05"/></geometry></collision>
  </link>
  <joint name="mount" type="fixed"><parent link="world"/><child link="stand"/>
    <origin xyz="1 2 0.5" rpy="0 0 1.5707963267948966"/></joint>
  <joint name="rail" type="{kind}"><parent link="stand"/><child link="base"/><origin xyz="0 0 0.3"/>
    <axis xyz="1 0 0"/><limit lower="-1" upper="1" velocity="1" effort="1"/></joint>
  <joint name="turn" type="revolute"><parent link="base"/><child link="arm"/><axis xyz="0 0 1"/>
    <limit lower="-3" upper="3" velocity="1" effort="1"/></joint>
</robot>"""
"""An arm on a stand in the world: its base is not the root of the URDF."""


def scene_data(**world: object) -> dict[str, Any]:
    return {"world": {"collision_objects": [dict(world)]}}


def ball(**more: object) -> dict[str, Any]:
    at = [{"position": [1, 0, 0], "orientation": [0, 0, 0, 1]}]
    return {
        "id": "ball",
        "primitives": [{"type": "sphere", "dimensions": [0.2]}],
        "primitive_poses": at,
        **more,
    }


def request_data() -> dict[str, Any]:
    data = read_yaml(MOTION_BENCH_MAKER / "request0001.yaml")
    assert isinstance(data, dict)
    return deepcopy(data)


def change(data: dict[str, Any], path: list[Any], value: object) -> dict[str, Any]:
    at: Any = data
    for key in path[:-1]:
        at = at[key]
    at[path[-1]] = value
    return data
