"""The exit statuses of all commands."""

SOLVED, NO_PLAN, BAD_INPUT, WRITE_FAILED, STOPPED = 0, 1, 2, 3, 130
"""Done; no valid motion; bad input; the output could not be written; stopped by the user."""
