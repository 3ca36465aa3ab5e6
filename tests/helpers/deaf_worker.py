"""A parent process and a worker that holds Python's global lock (GIL) for a while, as compiled code may."""

import ctypes
import os
import sys

from robotdiffuse.processes.workers import Workers


def hold(seconds: int) -> None:
    ctypes.PyDLL(None).sleep(seconds)


if __name__ == "__main__":
    workers = Workers(1)
    print(workers.submit(os.getpid).result(), flush=True)
    workers.submit(hold, int(sys.argv[1]))
    print("begun", flush=True)
    sys.stdin.read()
