"""The command line from its first import on: `python -m robotdiffuse`, and the script of that name."""

import sys


def main() -> int:
    """As `cli.main`; Ctrl-C is one line while that is still imported, too."""
    try:
        from robotdiffuse.processes import interrupts_at_once

        with interrupts_at_once():
            from robotdiffuse import cli
    except KeyboardInterrupt:
        print("robotdiffuse: stopped", file=sys.stderr)
        return 130
    return cli.main()


if __name__ == "__main__":
    from robotdiffuse.processes import leave

    leave(main())
