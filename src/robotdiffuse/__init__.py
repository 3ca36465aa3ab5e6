"""Motion planning for robot arms: `import robotdiffuse as rd`; every motion is verified.

The public names stand in `__init__.pyi`. Each is imported when it is first used, since the compiled kernels
take a second to load.
"""

import sys

import lazy_loader

__version__ = "0.1.0"
_load, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> object:
    """The public name. If a package that it needs is not installed, a class that says so when it is called,
    so that `import *` and `help` work without the package."""
    if name not in __all__:  # with the module, so that Python suggests a similar name
        text = f"module {__name__!r} has no attribute {name!r}"
        raise AttributeError(text, name=name, obj=sys.modules[__name__])
    try:
        return _load(name)
    except ValueError as error:
        from robotdiffuse.core.errors import MissingPackageError

        if not isinstance(error, MissingPackageError):
            raise
        missing = f"rd.{name}: {error}"

    def refuse(*_: object, **__: object) -> None:
        raise MissingPackageError(missing)

    return type(name, (), {"__new__": refuse})
