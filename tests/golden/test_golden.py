"""What the package makes of fixed inputs has not changed; see golden.py, which also says what was."""

import json
import os
import subprocess
import sys

import pytest
from llvmlite.binding import get_host_cpu_name

from golden.golden import GOLDEN, SECTIONS

ANY_PROCESSOR = ("problems", "shard")


@pytest.mark.timeout(1800)
@pytest.mark.parametrize("section", [name for name in SECTIONS if name != "unsteady"])
def test_golden(section: str) -> None:
    made_on = json.loads(GOLDEN.read_text())["processor"]
    if section not in ANY_PROCESSOR and made_on != get_host_cpu_name():
        pytest.skip(f"the last bits of networks and searches are those of a processor {made_on}")
    if section in ("weights", "plans") and "GOLDEN" not in os.environ:
        pytest.skip("plans have time limits, which a busy machine exceeds: GOLDEN=1 compares them")
    command = [sys.executable, str(GOLDEN.with_suffix(".py")), "--only", section]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        # a process that compiles and one that finds the compiled code in its cache differ in the last bits
        done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
