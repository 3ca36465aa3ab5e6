"""`robotdiffuse train planner --robot NAME`: generates data and trains weights for any arm.

    FOLDER/data     motions, planned in scenes of the arm's size
    FOLDER/encoder  the bundled encoder, which stays frozen
    FOLDER          checkpoints, log and weights; the weights are then installed where planners find them

An interrupted run continues where it stopped.
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
"""Motions to generate: about twenty minutes on two cores. With rotated copies they are 360,000, and the
training sees each seven times."""
SAMPLES = 2_400_000
"""Training samples, as for the bundled Panda weights: one to two hours on one core."""
MIX = {"rop": 0.2, "rop_dense": 0.3, "shelf": 0.2, "crate": 0.15, "table": 0.15}
"""Fractions of the problem families: more furniture than for the Panda's weights, where a network helps
most."""
WAYPOINTS = 96
"""Waypoints of a motion, twice as many as the network's."""
SAFETY_DISTANCE = 0.05
"""Distance of the motions to obstacles for an arm of the Panda's reach [m]; scaled with the reach."""
BYTES_PER_MOTION = 8_000
"""Disk space reserved for each motion, including scene codes and rotated copies; about twice what it
needs."""
BYTES_PER_TRAINING = 100_000_000
"""Disk space for checkpoints and weights."""


def data_settings(source: str, robot: Robot, motions: int | None, seed: int | None) -> "GenerationSettings":
    """Settings of the training data for an arm."""
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
        search=AORRTCSearchSettings(safety_distance=SAFETY_DISTANCE * scale_for(robot)),
    )


def train_for_robot(
    source: str,
    given: dict[str, Any],
    make: Callable[[dict[str, Any]], "PlannerTraining"],
    out: str | None = None,
    motions: int | None = None,
    workers: int | None = None,
) -> tuple[dict[str, float], Path]:
    """Generate the data, train, and install the weights; returns the training's figures and the weights'
    folder.

    source: the robot, as for `load_robot`. given: training settings from the command line, which `make`
    completes. out: working folder; None: beside the user's robots. motions, workers: for the data.

    Raises InputError for an unknown robot, a folder of other settings, and too little disk space.
    """
    from robotdiffuse.cli.console import progress
    from robotdiffuse.generation import generate
    from robotdiffuse.learning.training.config import PlannerTraining
    from robotdiffuse.learning.training.planner import train_planner
    from robotdiffuse.learning.weight_files import user_weights

    if int(os.environ.get("WORLD_SIZE", "1")) > 1:
        raise InputError("torchrun only trains: generate the data first, then give --data")
    robot = load_robot(source)
    source = str(Path(source).resolve()) if Path(source).exists() else source
    kept = user_weights(robot)
    work = kept.with_name("training") if out is None else Path(out)
    data = data_settings(source, robot, motions, given.get("seed"))
    _check_disk(work, data.trajectories)
    defaults: dict[str, Any] = {"samples": SAMPLES} if given.get("minutes") is None else {}
    defaults |= {"encoder": str(work / "encoder")}
    settings: PlannerTraining = make(defaults | given | {"data": str(work / "data"), "robot": source})
    _say(f"{robot.name}: {data.trajectories:,} motions, then training; all in {work}")
    with progress("trajectories") as update:
        generate(data, work / "data", workers or os.cpu_count() or 1, progress=update)
    if "encoder" not in given:
        copy_bundled_encoder(work / "encoder")
    report = train_planner(settings, str(work))
    network = "trajectory_prior" if settings.encoder is None else "model"
    # the description last: its presence means that the weights are complete
    for file in sorted(work.glob(f"{network}.*"), key=lambda file: file.suffix == ".json"):
        write_atomically(kept / file.name, file.read_bytes(), make_folder=True)
    return report, kept


def _check_disk(work: Path, motions: int) -> None:
    """Raises InputError if the disk has too little space."""
    there = next(folder for folder in (work, *work.absolute().parents) if folder.exists())
    made = sum(file.stat().st_size for file in work.rglob("*") if file.is_file()) if work.is_dir() else 0
    free, needed = shutil.disk_usage(there).free, motions * BYTES_PER_MOTION + BYTES_PER_TRAINING - made
    if free < needed:
        raise InputError(
            f"{motions:,} motions and the training need {needed / 1e6:,.0f} MB more, and {there} has "
            f"{free / 1e6:,.0f} MB left; free some space, or name another folder with --out"
        )


def copy_bundled_encoder(folder: Path) -> Path:
    """Save the encoder of the bundled weights in the form that the training reads; returns the folder."""
    from robotdiffuse.learning.checkpoint import load_model, save_network
    from robotdiffuse.learning.weight_files import BUNDLED

    if (folder / "encoder.json").is_file():
        return folder
    encoder = load_model(BUNDLED / "panda").encoder
    assert encoder is not None
    save_network("encoder", encoder, folder, {"from": "the weights that come with the package for panda"})
    return folder


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)
