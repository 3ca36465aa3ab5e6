"""Masses and inertias of links, and payloads."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple, no_type_check

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from numpy.typing import ArrayLike

from robotdiffuse.core.bounds import MAX_COORDINATE, Value, numbers, read_only, within
from robotdiffuse.core.errors import InputError, shown

SLACK = 1e-6
"""How negative the smallest principal moment of a link may be, relative to the largest entry, for rounding in
files."""


class Inertia(NamedTuple):
    """Mass and inertia of a link, in its frame."""

    mass: float
    """[kg]"""
    com: Float[ndarray, "3"]
    """Centre of mass [m]."""
    moments: Float[ndarray, "3 3"]
    """Inertia matrix about the centre of mass, along the frame's axes [kg m²]."""

    @property
    def values(self) -> list[float]:
        """The ten numbers that `inertia_of` takes."""
        upper = self.moments[np.triu_indices(3)]
        return [self.mass, *self.com.tolist(), *upper.tolist()]


def inertia_of(values: ArrayLike) -> Inertia:
    """An inertia from mass, x, y, z, ixx, ixy, ixz, iyy, iyz, izz; raises ValueError if physically
    impossible."""
    row = np.array(values, np.float64)
    if row.shape != (10,) or not within(row):
        raise ValueError("ten finite numbers expected")
    xx, xy, xz, yy, yz, zz = row[4:]
    moments = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    least = float(np.linalg.eigvalsh(moments)[0])
    if not row[0] > 0 or least < -SLACK * np.abs(moments).max():
        raise ValueError("a mass above 0 and moments of inertia of at least 0 expected")
    return read_only(Inertia(float(row[0]), row[1:4], moments))


@no_type_check
@dataclass(frozen=True, eq=False)
class Payload(Value):
    """A mass that a link carries; joint torques must support it in addition to the arm.

    Raises InputError for numbers that are not finite, and for negative mass or moments of inertia.
    """

    mass: float
    """[kg]"""
    com: Float[ndarray, "3"] = (0.0, 0.0, 0.0)  # pyright: ignore[reportAssignmentType]
    """Centre of mass, in the frame of the link [m]."""
    link: str | None = None
    """Link that carries the mass; None: the robot's tip."""
    moments: Float[ndarray, "3"] = (0.0, 0.0, 0.0)  # pyright: ignore[reportAssignmentType]
    """Moments of inertia about the centre of mass, along the frame's axes [kg m²]; 0 for a point mass."""

    def __post_init__(self) -> None:
        mass = numbers(self.mass)
        if mass is None or mass.ndim != 0 or not 0 <= mass <= MAX_COORDINATE:
            raise InputError(
                f"payload.mass is {shown(self.mass)}; it must be a number from 0 to {MAX_COORDINATE:g} kg"
            )
        object.__setattr__(self, "mass", float(mass))
        for name, least in (("com", -MAX_COORDINATE), ("moments", 0.0)):
            value = numbers(getattr(self, name))
            if (
                value is None
                or value.shape != (3,)
                or not ((value >= least) & (value <= MAX_COORDINATE)).all()
            ):
                raise InputError(
                    f"payload.{name} is {shown(getattr(self, name))}; it must be 3 numbers from {least:g} to "
                    f"{MAX_COORDINATE:g}"
                )
            object.__setattr__(self, name, value)
        if self.link is not None and not isinstance(self.link, str):
            raise InputError(f"payload.link is {shown(self.link)}; it must be the name of a link")
        super().__post_init__()

    if TYPE_CHECKING:

        def __init__(
            self,
            mass: float,
            com: ArrayLike = (0.0, 0.0, 0.0),
            link: str | None = None,
            moments: ArrayLike = (0.0, 0.0, 0.0),
        ) -> None: ...
