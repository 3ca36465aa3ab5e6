"""Entry point of `python -m robotdiffuse` and of the script `robotdiffuse`."""

import gc
import sys
from typing import NoReturn

GC_THRESHOLD = 10_000
"""Number of new objects between two garbage collections. Imports create half a million objects, none of them
garbage."""


def main() -> int:
    """Run `cli.main`; Ctrl-C during its import also ends the program with one line."""
    gc.set_threshold(GC_THRESHOLD)
    try:
        from robotdiffuse.core.interrupts import exit_on_interrupt

        with exit_on_interrupt():
            from robotdiffuse import cli
    except KeyboardInterrupt:
        print("robotdiffuse: stopped", file=sys.stderr)
        return 130
    return cli.main()


def run() -> NoReturn:
    """Run `main` and exit the process with its status."""
    from robotdiffuse.core.interrupts import exit_fast

    exit_fast(main)


if __name__ == "__main__":
    run()
