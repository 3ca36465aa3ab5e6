"""Files that are written whole or not at all."""

import os
from pathlib import Path

from robotdiffuse.errors import InputError


def write_atomically(file: Path, content: str | bytes, make_folder: bool = False) -> None:
    """Write beside the file, then rename over it, so that nobody sees it half written.

    An interruption or a full disk leaves the old file, or none. Raises InputError when it cannot be written.
    """
    temporary = file.with_name(f".{file.name}.{os.getpid()}.tmp")
    try:
        if make_folder:
            file.parent.mkdir(parents=True, exist_ok=True)
        try:
            temporary.write_bytes(content.encode() if isinstance(content, str) else content)
            temporary.replace(file)
        except OSError:
            temporary.unlink(missing_ok=True)
            raise
    except OSError as error:
        raise InputError(f"{file} cannot be written: {error.strerror or error}") from None
