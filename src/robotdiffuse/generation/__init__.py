"""Data generation: random problems solved by Shared-Tree Informed RRT* or AORRTC, validated, and kept in
shards."""

from robotdiffuse.generation.factory import generate
from robotdiffuse.generation.settings import GenerationSettings

__all__ = ["GenerationSettings", "generate"]
