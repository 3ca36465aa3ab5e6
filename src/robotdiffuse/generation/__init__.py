"""Data generation: random problems solved by Shared-Tree Informed RRT* or AORRTC, validated, and kept in
shards."""

from robotdiffuse.generation.factory import GenerationSettings, generate

__all__ = ["GenerationSettings", "generate"]
