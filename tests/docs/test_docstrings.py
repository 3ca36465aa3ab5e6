"""Public functions document their parameters in Google's style, and their examples run."""

import doctest
import inspect
from collections.abc import Callable, Iterator

import griffe
import numpy as np
import pytest

import robotdiffuse as rd

NAMES = sorted(getattr(rd, "__all__"))  # noqa: B009  (the stub does not name it)


def public_functions(name: str) -> Iterator[Callable[..., object]]:
    """The function with a public name, or the public methods that a class defines itself."""
    value = getattr(rd, name)
    if inspect.isfunction(value):
        yield value
    if inspect.isclass(value):
        for own, member in list(vars(value).items()):  # copying adds to it
            function = getattr(member, "__func__", member)
            if inspect.isfunction(function) and not own.startswith("_"):
                yield inspect.unwrap(function)


def parameters(function: Callable[..., object]) -> set[str]:
    return {name for name in inspect.signature(function).parameters if name not in ("self", "cls")}


def documented(function: Callable[..., object]) -> set[str]:
    """Names below `Args:`, as griffe reads them for the reference."""
    sections = griffe.Docstring(inspect.getdoc(function) or "").parse("google", warnings=False)
    return {
        argument.name.lstrip("*")
        for section in sections
        if section.kind is griffe.DocstringSectionKind.parameters
        for argument in section.value
    }


@pytest.mark.parametrize("name", NAMES)
def test_every_parameter_is_documented(name: str) -> None:
    for function in public_functions(name):
        assert inspect.getdoc(function), function.__qualname__
        assert documented(function) == parameters(function), function.__qualname__


@pytest.mark.parametrize("name", NAMES)
def test_examples_run(name: str) -> None:
    finder = doctest.DocTestFinder(recurse=False)
    for function in public_functions(name):
        for example in finder.find(function, function.__qualname__, globs={"rd": rd, "np": np}):
            assert doctest.DocTestRunner(optionflags=doctest.ELLIPSIS).run(example).failed == 0, function.__qualname__
