"""Collision checking: compiled kernels, exact meshes, motion certificates and differentiable signed
distances."""

from robotdiffuse.collision.checker import CollisionChecker

__all__ = ["CollisionChecker"]
