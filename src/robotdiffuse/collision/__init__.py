"""Collision checking: the compiled kernels, the differentiable signed distance, and the exact meshes."""

from robotdiffuse.collision.checker import CollisionChecker

__all__ = ["CollisionChecker"]
