"""The suite's own checks of shapes: a call like one that passed is not checked again, any other is."""

from collections.abc import Callable
from typing import Any

import jaxtyping
import numpy as np
import pytest
from beartype import beartype
from jaxtyping import Float, TypeCheckError
from numpy import ndarray


def scaled(
    rows: Float[ndarray, "n dof"], by: Float[ndarray, "dof"] | float, *, returned: Any = None
) -> Float[ndarray, "n dof"]:
    return rows * by if returned is None else returned


WRONG: dict[str, Callable[[Any], Any]] = {
    "a vector": lambda call: call(np.ones(3), 2.0),
    "other dimensions": lambda call: call(np.ones((2, 3)), np.ones(2)),
    "integers": lambda call: call(np.ones((2, 3), int), 2.0),
    "a list": lambda call: call([[1.0, 2.0, 3.0]], 2.0),
    "a word": lambda call: call(np.ones((2, 3)), "2"),
    "one row less is returned": lambda call: call(np.ones((2, 3)), 2.0, returned=np.ones((1, 3))),
    "a list is returned": lambda call: call(np.ones((2, 3)), 2.0, returned=[1.0]),
}


@pytest.mark.parametrize("wrong", WRONG)
def test_wrong_shapes_are_refused_after_right_ones(wrong: str) -> None:
    checked = jaxtyping.jaxtyped(typechecker=beartype)(scaled)
    for returned in (None, np.zeros((2, 3))):
        for _ in range(3):
            checked(np.ones((2, 3)), 2.0, returned=returned)
            checked(np.ones((4, 3)), by=np.ones(3))
        with pytest.raises(TypeCheckError):
            WRONG[wrong](checked)
