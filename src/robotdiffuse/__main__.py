"""The command line from its first import on: `python -m robotdiffuse`, and the script of that name."""

import gc
import sys
from typing import NoReturn

YOUNG = 10_000
"""Objects between two looks for garbage, of which imports, half a million objects, make none."""


def main() -> int:
    """As `cli.main`; Ctrl-C is one line while that is still imported, too."""
    gc.set_threshold(YOUNG)
    try:
        from robotdiffuse.core.processes import exit_on_interrupt

        with exit_on_interrupt():
            from robotdiffuse import cli
    except KeyboardInterrupt:
        print("robotdiffuse: stopped", file=sys.stderr)
        return 130
    return cli.main()


def run() -> NoReturn:
    """`main`, and the end of the process."""
    status = main()
    from robotdiffuse.core.processes import exit_process

    exit_process(status)


if __name__ == "__main__":
    run()
