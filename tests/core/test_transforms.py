"""rd.pose: a position and a rotation as a matrix."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import robotdiffuse as rd


def test_a_pose_by_quaternion_and_by_rpy_is_scipys() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        xyz, rpy = rng.normal(size=(2, 3))
        right = Rotation.from_euler("xyz", rpy)
        for T in (rd.pose(xyz, rpy=rpy), rd.pose(xyz, wxyz=3 * right.as_quat(scalar_first=True))):
            np.testing.assert_allclose(T[:3, :3], right.as_matrix(), atol=1e-12)
            np.testing.assert_array_equal(T[:3, 3], xyz)
            np.testing.assert_array_equal(T[3], [0, 0, 0, 1])
    np.testing.assert_array_equal(rd.pose([1, 2, 3])[:3, :3], np.eye(3))


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"wxyz": [1, 0, 0, 0], "rpy": [0, 0, 0]}, "pose has wxyz and rpy; give one of them"),
        ({"rpy": [0, 0]}, r"pose.rpy is \[0, 0\]; it must be 3 finite numbers"),
        ({"wxyz": [0, 0, 0, 0]}, "a quaternion must not be zero"),
        ({"xyz": [0, 0, np.nan]}, "pose.xyz is .*; it must be 3 finite numbers"),
    ],
)
def test_wrong_poses_are_refused(fields: dict, message: str) -> None:
    with pytest.raises(rd.InputError, match=message):
        rd.pose(**{"xyz": [0, 0, 0]} | fields)
