"""Valid files and requests, which fuzzing damages."""

from pathlib import Path
from typing import Any

import numpy as np
import yaml

FOLDER = Path(__file__).parents[2] / "files" / "fuzz"
FILE: dict[str, dict[str, Any]] = yaml.safe_load((FOLDER / "examples.yaml").read_text())
PROBLEM = FILE["problem"]
SMALL = PROBLEM | {"scene": PROBLEM["scene"][:1]}
ROWS = np.linspace(PROBLEM["start"], PROBLEM["goal"]["joints"], 3).tolist()
PARTS = ("pose", "view", "equipped", "constrained", "moving", "in_motion", "moveit", "held", "request", "limits")
POSE, VIEW, EQUIPPED, CONSTRAINED, MOVING, IN_MOTION, MOVEIT, HELD, REQUEST, LIMITS = (FILE[part] for part in PARTS)
JOINTS = [f"panda_joint{i}" for i in range(1, 8)]
URDF = (FOLDER / "two.urdf").read_bytes()
SRDF = (FOLDER / "two.srdf").read_bytes()
MESHES = ("stl", "obj", "ply", "off", "glb", "dae")
