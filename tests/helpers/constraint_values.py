"""What path constraints measure, by their definitions: the oracle of compiled constraints and of planned motions."""

import numpy as np
from numpy import ndarray
from scipy.spatial.transform import Rotation, Slerp

import robotdiffuse as rd
from robotdiffuse.problems.constraints import Constraint


def true_values(made: rd.Problem, constraint: Constraint, q: ndarray) -> ndarray:
    """What `PathConstraints.values` must return for configurations [n, dof]: [n, 1], of a Cartesian line [n, 2]."""
    T = made.robot.fk(q, constraint.frame)
    p = T[:, :3, 3]
    if isinstance(constraint, rd.AxisCone):
        return np.arccos(np.clip(T[:, :3, :3] @ constraint.axis @ constraint.direction, -1, 1))[:, None]
    if isinstance(constraint, rd.PositionBox):
        box = np.eye(4) if constraint.T_base_box is None else constraint.T_base_box
        x = (p - box[:3, 3]) @ box[:3, :3]
        beyond = np.maximum(constraint.low - x, x - constraint.high)
        return np.linalg.norm(np.maximum(beyond, 0), axis=1, keepdims=True) + np.minimum(beyond.max(axis=1, keepdims=True), 0)
    if isinstance(constraint, rd.OnPlane):
        return np.abs((p - constraint.point) @ constraint.normal)[:, None]
    if isinstance(constraint, rd.OnLine):
        return np.linalg.norm(np.cross(p - constraint.point, constraint.direction), axis=1, keepdims=True)
    assert isinstance(made.goal, rd.JointGoal)
    ends = made.robot.fk([made.start, made.goal.positions[0]], constraint.frame)
    way = ends[1, :3, 3] - ends[0, :3, 3]
    share = np.clip((p - ends[0, :3, 3]) @ way / (way @ way), 0, 1)
    off = np.linalg.norm(p - ends[0, :3, 3] - share[:, None] * way, axis=1)
    there = Slerp([0, 1], Rotation.from_matrix(ends[:, :3, :3]))(share)
    return np.stack([off, (there.inv() * Rotation.from_matrix(T[:, :3, :3])).magnitude()], axis=1)


def allowed(constraint: Constraint) -> list[float]:
    """The largest values that keep the constraint."""
    if isinstance(constraint, rd.CartesianLine):
        assert constraint.angle is not None
        return [constraint.tolerance, constraint.angle]
    if isinstance(constraint, rd.PositionBox):
        return [0.0]
    return [constraint.angle if isinstance(constraint, rd.AxisCone) else constraint.tolerance]
