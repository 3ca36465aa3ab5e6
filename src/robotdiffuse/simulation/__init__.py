"""The PyBullet world (extra `sim`): a collision oracle that shares no code with ours."""

from robotdiffuse.simulation.oracle import OracleContact, PyBulletOracle

__all__ = ["OracleContact", "PyBulletOracle"]
