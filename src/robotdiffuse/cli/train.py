"""The commands `robotdiffuse train encoder`, `completion`, `planner`, `baseline` and `export`."""

import os
import shutil
from pathlib import Path
from typing import Any

from robotdiffuse.cli.arguments import Namespace, chosen
from robotdiffuse.cli.console import progress, say
from robotdiffuse.core.errors import InputError, counted, needs, shown
from robotdiffuse.core.files import lock_folder, write_atomically
from robotdiffuse.generation import GenerationSettings, generate
from robotdiffuse.generation.aorrtc_solver import AORRTCSearchSettings
from robotdiffuse.learning.weight_files import BUNDLED, user_weights
from robotdiffuse.problems.families.scaled import scale_for
from robotdiffuse.robots import load_robot, names_a_file
from robotdiffuse.robots.robot import Robot

with needs("torch", "train"):
    from robotdiffuse.learning.checkpoint import export_weights, load_encoder, load_network, save_network
    from robotdiffuse.learning.denoisers import DENOISERS, PAPER_SIZES
    from robotdiffuse.learning.training.completion import CompletionTraining, train_completion
    from robotdiffuse.learning.training.config import (
        CONFIGS,
        EncoderTraining,
        MotionTraining,
        PlannerTraining,
        one_length,
        planner_training,
    )
    from robotdiffuse.learning.training.loop import Processes
    from robotdiffuse.learning.training.tasks import (
        baseline_training,
        train_baseline,
        train_encoder,
        train_planner,
    )


def run_encoder(arguments: Namespace) -> None:
    _train(arguments, EncoderTraining, train_encoder)


def run_completion(arguments: Namespace) -> None:
    _train(arguments, CompletionTraining, train_completion)


def _train(arguments: Namespace, kind: Any, train: Any) -> None:
    """Train a network by the function `train`, with settings of the class `kind`."""
    settings = kind(**one_length(chosen(arguments, kind.__dataclass_fields__)))
    _check_folder(arguments.out)
    _print_report(train(settings, arguments.out), arguments.out)


def run_planner(arguments: Namespace) -> None:
    if arguments.config not in CONFIGS:
        descriptions = [f"{name}: {config.description}" for name, config in CONFIGS.items()]
        raise InputError(f"unknown config {shown(arguments.config)}; known:", descriptions)
    options = chosen(arguments, PlannerTraining.__dataclass_fields__)
    config = CONFIGS[arguments.config].changes
    for name in ("denoiser", "objective", "waypoints"):
        if options.get(name) == config.get(name, getattr(PlannerTraining, name)):
            options.pop(name, None)  # what the config has already
    if "denoiser" in options and config.get("denoiser_settings") is not None:
        # these settings are for the config's own denoiser; another gets its PAPER_SIZES, or its defaults
        options["denoiser_settings"] = PAPER_SIZES.get(arguments.denoiser) or DENOISERS.defaults(
            arguments.denoiser
        )
    if {"denoiser", "objective", "waypoints"} & set(options):
        # the stages of progressive training suit the config's own denoiser, objective and waypoints
        options["progressive"] = False
    if options.get("target") == "limits":
        options["smooth_noise"] = False  # that target takes white noise only
    if "encoder" in config:
        options.setdefault("encoder", config["encoder"])
    if arguments.config == "paper" and "encoder" not in options:
        raise InputError(
            "--config paper needs --encoder: a folder of "
            "`robotdiffuse train encoder --encoder compression_autoencoder --scenes rop`, the paper's encoder"
        )
    if not arguments.data:
        if not arguments.robot:
            raise InputError("give --robot to generate data for an arm, or --data to use existing data")
        common = arguments.robot, options, arguments.config, arguments.out
        report, weights = train_for_robot(*common, arguments.trajectories, arguments.workers)
        return _print_report(report, str(weights))
    if not arguments.out:
        raise InputError("--data needs --out, a folder for the weights")
    for name in ("trajectories", "workers"):
        if getattr(arguments, name):
            raise InputError(f"--{name} is for data to be generated; --data names existing data")
    # with several processes, all would write the bundled encoder at once
    bundled = "encoder" not in options and int(os.environ.get("WORLD_SIZE", "1")) == 1
    if bundled:
        options["encoder"] = str(Path(arguments.out) / "encoder")
    settings = planner_training(arguments.config, options)
    _check_folder(arguments.out)
    folder = Path(arguments.out)
    new = bundled and copy_bundled_encoder(folder / "encoder")
    try:
        report = train_planner(settings, arguments.out)
    except InputError:
        if new and os.listdir(folder) == ["encoder"]:
            shutil.rmtree(folder)
        raise
    _print_report(report, arguments.out)


def run_baseline(arguments: Namespace) -> None:
    options = chosen(arguments, MotionTraining.__dataclass_fields__)
    _check_folder(arguments.out)
    if arguments.name == "trajectory_prior":
        report = train_planner(planner_training(arguments.name, options), arguments.out)
    else:
        report = train_baseline(baseline_training(arguments.name, options), arguments.out)
    _print_report(report, arguments.out)


def run_export(arguments: Namespace) -> None:
    print(f"wrote the ONNX files of {', '.join(export_weights(arguments.folder))} into {arguments.folder}")


def _check_folder(out: str) -> None:
    """Raise InputError if the folder cannot be written, before the data are read or generated."""
    if _is_first_process():
        with lock_folder(Path(out)):
            pass


def _is_first_process() -> bool:
    """Whether this is the first of the processes that torchrun started, or the only process."""
    return int(os.environ.get("RANK", "0")) == 0


def _print_report(figures: dict[str, float], out: str) -> None:
    if not _is_first_process():
        return
    for name, value in figures.items():
        print(f"{name}: {value:.6g}")
    print(f"wrote {out}")


MOTIONS = 60_000
"""Number of motions to generate: about twenty minutes on two cores. With rotated copies they are 360,000, and
the config `compact` sees each seven times."""
MIX = {"rop": 0.2, "rop_dense": 0.3, "shelf": 0.2, "crate": 0.15, "table": 0.15}
"""Fractions of the problem families. They contain more furniture than the data of the Panda's weights, since
a network helps most there."""
WAYPOINTS = 96
"""Number of waypoints of a motion, twice as many as the network's."""
SAFETY_DISTANCE = 0.05
"""Distance of the motions to obstacles for an arm of the Panda's reach [m]; scaled with the reach."""
BYTES_PER_MOTION = 8_000
"""Disk space reserved for each motion with its scene embedding and rotated copies; about twice what they
need."""
BYTES_PER_TRAINING = 100_000_000
"""Disk space reserved for checkpoints and weights."""


def data_settings(source: str, robot: Robot, motions: int | None, seed: int | None) -> GenerationSettings:
    """Settings of the training data for an arm."""
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
    options: dict[str, Any],
    config: str,
    out: str | None = None,
    motions: int | None = None,
    workers: int | None = None,
) -> tuple[dict[str, float], Path]:
    """Generate the data, train, and install the weights; returns the training's figures and the weights'
    folder.

    source: the robot, as for `load_robot`. options: training settings from the command line, which change
    those of `config`. out: working folder; None: `training`, beside the robot's weights. motions:
    number of motions to generate; workers: number of processes that generate them.

    Raises InputError for an unknown robot, a missing device or encoder, a folder that was made with other
    settings, and too little disk space.
    """
    if int(os.environ.get("WORLD_SIZE", "1")) > 1:
        raise InputError("torchrun only trains: generate the data first, then give --data")
    robot = load_robot(source)
    source = str(Path(source).resolve()) if names_a_file(source) else source
    weights_dir = user_weights(robot)
    work = weights_dir.with_name("training") if out is None else Path(out)
    data = data_settings(source, robot, motions, options.get("seed"))
    _check_disk(work, data.trajectories)
    defaults: dict[str, Any] = {"encoder": str(work / "encoder")}
    settings: PlannerTraining = planner_training(
        config, defaults | options | {"data": str(work / "data"), "robot": source}
    )
    # raise InputError for a missing device or encoder now, before the data are generated
    Processes(settings.device)
    if "encoder" in options and settings.encoder is not None and not settings.jointly:
        load_encoder(settings.encoder)
    say(f"{robot.name}: {counted(data.trajectories, 'motion')}, then training; all in {work}")
    with progress("trajectories") as update:
        generate(data, work / "data", workers or os.cpu_count() or 1, progress=update)
    if "encoder" not in options:
        copy_bundled_encoder(work / "encoder")
    report = train_planner(settings, str(work))
    network = "trajectory_prior" if settings.encoder is None else "model"
    # NAME.json is written last: if it exists, the weights are complete
    for file in sorted(work.glob(f"{network}.*"), key=lambda file: file.suffix == ".json"):
        write_atomically(weights_dir / file.name, file.read_bytes(), make_folder=True)
    return report, weights_dir


def _check_disk(work: Path, motions: int) -> None:
    """Raises InputError if the disk has too little space."""
    existing = next(folder for folder in (work, *work.absolute().parents) if folder.exists())
    written = sum(file.stat().st_size for file in work.rglob("*") if file.is_file())
    free = shutil.disk_usage(existing).free
    needed = motions * BYTES_PER_MOTION + BYTES_PER_TRAINING - written
    if free < needed:
        raise InputError(
            f"{motions:,} motions and the training need {needed / 1e6:,.0f} MB more, and {existing} has "
            f"{free / 1e6:,.0f} MB left; free some space, or name another folder with --out"
        )


def copy_bundled_encoder(folder: Path) -> bool:
    """Save the encoder of the bundled weights in the form that the training reads, unless it was saved
    before; returns whether it is new."""
    if (folder / "encoder.json").is_file():
        return False
    encoder = load_network("model", BUNDLED / "panda", load_robot("panda")).encoder
    save_network("encoder", encoder, folder, {"from": "the weights that come with the package for panda"})
    return True
