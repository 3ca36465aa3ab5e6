"""A worker that does not let go of the interpreter, as compiled code does not, and its parent."""

import ctypes
import os
import sys

from robotdiffuse.core.processes import SingleWorker


def nothing() -> None:
    pass


def hold(seconds: int) -> None:
    ctypes.PyDLL(None).sleep(seconds)


if __name__ == "__main__":
    worker = SingleWorker(nothing, ())
    print(worker.call(os.getpid), flush=True)
    worker.submit(hold, int(sys.argv[1]))
    print("begun", flush=True)
    sys.stdin.read()
