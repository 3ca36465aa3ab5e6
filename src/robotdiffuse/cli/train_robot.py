"""robotdiffuse train planner --robot NAME: data and weights for any arm by one command.

    FOLDER/data     motions, planned in scenes in the size of the arm
    FOLDER/encoder  the frozen encoder that comes with the package
    FOLDER          checkpoints, log and weights, which then go to where planners look for them

Each part goes on where it was interrupted, and what is finished is left as it is.
"""

import os
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from robotdiffuse.core.errors import InputError
from robotdiffuse.core.output_files import write_atomically
from robotdiffuse.robots import load_robot
from robotdiffuse.robots.robot import Robot

if TYPE_CHECKING:
    from robotdiffuse.generation import GenerationSettings
    from robotdiffuse.learning.training.config import PlannerTraining

MOTIONS = 60_000
"""About twenty minutes of two cores; with turned copies 360,000, of which training sees each seven times."""
SAMPLES = 2_400_000
"""Of training, as the Panda's weights had: one to two hours of one core."""
MIX = {"rop": 0.2, "rop_dense": 0.3, "shelf": 0.2, "crate": 0.15, "table": 0.15}
"""More furniture than the Panda's weights were trained on: there a network has most to say."""
WAYPOINTS = 96
"""Twice as many as the network's."""
SAFETY = 0.05
"""Distance to obstacles that motions keep, of an arm of a Panda's reach [m]."""
BYTES = 8_000
"""On the disk for each motion, with the codes of its scene and turned copies; they come to about half."""
BYTES_OF_RUN = 100_000_000
"""Checkpoints and weights."""


def data_for(source: str, robot: Robot, motions: int | None, seed: int | None) -> "GenerationSettings":
    """The motions that a network for the arm learns from."""
    from robotdiffuse.generation import GenerationSettings
    from robotdiffuse.generation.aorrtc_solver import AORRTCSearchSettings
    from robotdiffuse.problems.families.scaled import scale_for

    return GenerationSettings(
        robot=source,
        trajectories=motions or MOTIONS,
        seed=seed or 0,
        mix=MIX,
        trivial_share=0.1,
        target="pose",
        goals=1,
        waypoints=WAYPOINTS,
        planner="aorrtc",
        search=AORRTCSearchSettings(safety_distance=SAFETY * scale_for(robot)),
    )


def train_for_robot(
    source: str,
    given: dict[str, Any],
    make: Callable[[dict[str, Any]], "PlannerTraining"],
    out: str | None = None,
    motions: int | None = None,
    workers: int | None = None,
) -> tuple[dict[str, float], Path]:
    """Make what is missing of data and weights; returns the figures of the training, and the weights' folder.

    source: the robot as `load_robot` takes it. given: settings of the training that were asked for; `make`
    makes them whole. out: folder for the work; None: beside the user's robots. motions, workers: of the data.
    Raises InputError for an unknown robot, a folder of other settings, and a disk that is too small.
    """
    from robotdiffuse.cli.data_generate import generated
    from robotdiffuse.learning.training.config import PlannerTraining
    from robotdiffuse.learning.training.planner import train_planner
    from robotdiffuse.learning.weights_registry import user_weights

    if int(os.environ.get("WORLD_SIZE", "1")) > 1:
        raise InputError("torchrun is for the training alone: make data first, then name them with --data")
    robot = load_robot(source)
    source = str(Path(source).resolve()) if Path(source).exists() else source
    kept = user_weights(robot)
    work = kept.with_name("training") if out is None else Path(out)
    data = data_for(source, robot, motions, given.get("seed"))
    _check_room(work, data.trajectories)
    told: dict[str, Any] = {"samples": SAMPLES} if given.get("minutes") is None else {}
    told |= {"encoder": str(work / "encoder")}
    settings: PlannerTraining = make(told | given | {"data": str(work / "data"), "robot": source})
    _say(f"{robot.name}: {data.trajectories:,} motions, then training; all in {work}")
    generated(data, work / "data", workers)
    if "encoder" not in given:
        _leave_encoder(work / "encoder")
    report = train_planner(settings, str(work))
    network = "trajectory_prior" if settings.encoder is None else "model"
    for ending in ("safetensors", "json"):  # the description last: it says that there are weights
        file = f"{network}.{ending}"
        write_atomically(kept / file, (work / file).read_bytes(), make_folder=True)
    return report, kept


def _check_room(work: Path, motions: int) -> None:
    """Raises InputError if the disk has no room for the work."""
    there = next(folder for folder in (work, *work.absolute().parents) if folder.exists())
    made = sum(file.stat().st_size for file in work.rglob("*") if file.is_file()) if work.is_dir() else 0
    free, needed = shutil.disk_usage(there).free, motions * BYTES + BYTES_OF_RUN - made
    if free < needed:
        raise InputError(
            f"{motions:,} motions and the training take {needed / 1e6:,.0f} MB more, and {there} has "
            f"{free / 1e6:,.0f} MB left; make room, or name another folder with --out"
        )


def _leave_encoder(folder: Path) -> None:
    """The encoder of the weights that come with the package, as training takes one."""
    from robotdiffuse.learning.checkpoint import load_model, save_encoder
    from robotdiffuse.learning.weights_registry import BUNDLED

    if (folder / "encoder.json").is_file():
        return
    encoder = load_model(BUNDLED / "panda").encoder
    assert encoder is not None
    save_encoder(encoder, folder, {"from": "the weights that come with the package for panda"})


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)
