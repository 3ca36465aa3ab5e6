"""The data factory: random problems, solved by Shared-Tree Informed RRT*, validated, and kept in shards."""

from robotdiffuse.generation.factory import generate
from robotdiffuse.generation.settings import GenerationSettings

__all__ = ["GenerationSettings", "generate"]
