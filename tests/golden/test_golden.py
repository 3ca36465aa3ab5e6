"""What the package makes of fixed inputs has not changed; see golden.py, which also says what was."""

import subprocess
import sys

import pytest

from golden.golden import GOLDEN


@pytest.mark.timeout(1800)
def test_golden() -> None:
    command = [sys.executable, str(GOLDEN.with_suffix(".py"))]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        # a process that compiles and one that finds the compiled code in its cache differ in the last bits
        done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
