"""Importing PyBullet is silent, and what other threads print meanwhile is kept."""

import subprocess
import sys

import pytest

pytest.importorskip("pybullet")

PYBULLET = """
import os
os.write(1, b"printed by another thread\\n")
for stream in (1, 2):
    os.write(stream, b"pybullet build time: now\\n")
"""


def test_only_the_build_time_is_left_out(tmp_path) -> None:
    (tmp_path / "pybullet.py").write_text(PYBULLET)
    code = f"import sys; sys.path.insert(0, {str(tmp_path)!r}); import robotdiffuse.simulation"
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert ended.returncode == 0, ended.stderr
    assert ended.stdout == "printed by another thread\n" and ended.stderr == ""
