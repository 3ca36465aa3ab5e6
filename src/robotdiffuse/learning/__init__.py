"""Networks: their training with PyTorch, and the parts that planning needs, with NumPy and ONNX Runtime."""

from importlib.util import find_spec

from robotdiffuse.core.errors import InputError, joined


def need_packages(what: str, *packages: str) -> None:
    """Raises InputError, which names the extra `train`, unless these packages are installed.

    what: what needs the packages, for the message.
    """
    missing = [package for package in packages if find_spec(package) is None]
    if missing:
        raise InputError(f'{what} needs {joined(missing)}, not installed: pip install "robotdiffuse[train]"')
