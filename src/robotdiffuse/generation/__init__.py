"""Data generation: random problems are solved by Shared-Tree Informed RRT* or AORRTC, validated, and written
to shards."""

from robotdiffuse.generation.factory import GenerationSettings, generate

__all__ = ["GenerationSettings", "generate"]
