"""The words of messages."""

import numpy as np
import pytest
import torch

import robotdiffuse as rd
from helpers.refusals import refuses
from robotdiffuse.core.errors import InputError, check_name, counted, needs


def test_one_and_none_are_said_as_such() -> None:
    """Regression: "1 problems", "1 workers"."""
    assert [counted(count, "entry", "entries") for count in (0, 1, 2000)] == ["0 entries", "1 entry", "2,000 entries"]
    assert [counted(count, "worker") for count in (1, "ray")] == ["1 worker", "ray workers"]
    # Regression: the message ended with "known: "
    refuses("unknown body 'box'; known: none$", check_name, "body", "box", [])


def test_a_package_that_is_installed_but_broken_is_not_called_missing() -> None:
    with pytest.raises(InputError, match=r"this needs OMPL, libboost\.so: not found: pip install"), needs("OMPL", "baselines"):
        raise ImportError("libboost.so: not found")
    with pytest.raises(InputError, match="this needs OMPL, not installed"), needs("OMPL", "baselines"):
        raise ModuleNotFoundError("No module named 'ompl'")


@pytest.mark.parametrize("given", [torch.tensor([1.0, 0, 2], requires_grad=True), np.array([1, 0.0, 2], object)], ids=type)
def test_tensors_with_gradients_and_rows_of_tables_are_numbers(given: torch.Tensor | np.ndarray) -> None:
    """Regression: both were refused; a row of a table with a column of texts is an array of objects."""
    assert rd.Sphere(given, 0.1).center.tolist() == [1, 0, 2]
    refuses(r"sphere.center is \['1', True\]; it must be 3", rd.Sphere, np.array(["1", True], object), 0.1)


def test_masked_numbers_are_missing() -> None:
    """Regression: the numbers that a mask hides were used in silence, as goals and as measured depths."""
    hidden = np.ma.masked_array([0.5, 0.0, 9.0], [False, False, True])
    refuses(r"sphere.center is \[0.5, 0.0, None\]; it must be 3 finite numbers", rd.Sphere, hidden, 0.1)
    np.testing.assert_array_equal(rd.DepthView(hidden[None], (3, 3, 1, 0), np.eye(4)).depth, [[0.5, 0.0, np.nan]])
