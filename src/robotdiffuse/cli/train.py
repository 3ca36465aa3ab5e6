"""The commands `robotdiffuse train encoder`, `completion`, `planner`, `baseline` and `export`."""

import argparse
import os
from functools import partial
from pathlib import Path
from typing import Any

from robotdiffuse.cli.arguments import command, count, names, natural, option, positive, share
from robotdiffuse.core.errors import InputError, shown
from robotdiffuse.learning import need_packages

TRAINING_OPTIONS = (
    *("minutes", "samples", "seed", "batch", "learning_rate", "threads"),
    "checkpoint_seconds",
)
MODEL_OPTIONS = (
    *("denoiser", "objective", "sampler", "sampling_steps", "target"),
    *("condition_drop", "waypoints"),
)
"""Options of `train planner` that replace parts of its config."""


def add(commands: argparse._SubParsersAction) -> None:
    parser = command(
        commands,
        "train",
        "train networks",
        "Train a network. Ctrl-C stops after writing a checkpoint; run the same command again to "
        "continue. To train with N processes, on a GPU each if there are enough: "
        "torchrun --nproc-per-node N -m robotdiffuse train ...",
    )
    kinds = parser.add_subparsers(title="networks", metavar="NETWORK", required=True)

    encoder = command(
        kinds,
        "encoder",
        "train an auto-encoder of point clouds",
        "Train an auto-encoder of point clouds on random scenes. The planner's training keeps it frozen.",
        run_encoder,
    )
    option(encoder, "--encoder NAME", "encoder to train (default: point_autoencoder)", dest="name")
    option(encoder, "--scenes NAME", "training scenes: mixed (default), or rop, those of the paper's data")
    _add_shared(encoder)
    _add_device(encoder)

    completion = command(
        kinds,
        "completion",
        "train the occupancy completion network",
        "Train the occupancy completion network, which predicts the obstacles that depth "
        "cameras do not see, on random scenes.",
        run_completion,
    )
    option(completion, "--families NAMES", "families of the scenes (default: all)", names)
    option(completion, "--robot NAME", "bundled name or URDF of the arm in the images")
    option(completion, "--workers N", "processes that draw samples (default: 1)", natural)
    option(completion, "--weights FOLDER", "weights to begin with; bundled: those that come with the package")
    _add_shared(completion)
    _add_device(completion)

    planner = command(
        kinds,
        "planner",
        "train the network that predicts motions",
        "Train the network that predicts motions, on planned trajectories. With --robot and "
        "without --data, generate data for the arm, train on them, and install the weights where planners "
        "find them; this takes about two hours on two cores.",
        run_planner,
    )
    option(
        planner, "--data FOLDER", "folder with shards of trajectories (default: generate them for --robot)"
    )
    option(
        planner,
        "--config NAME",
        "compact (default), paper, points (no clearances as inputs), trajectory_prior (for MPD and "
        "EDMP), or a row of the paper's Table 2: table2_jpc, table2_unet, ...",
        default="compact",
    )
    option(
        planner,
        "--encoder FOLDER",
        "folder of a trained encoder; pointnet or dgcnn, which are trained with the planner; or points, "
        "for the denoiser cross_attention (default: that of the config, or the bundled one)",
    )
    option(planner, "--robot NAME", "bundled name or URDF of the robot (default: panda)")
    option(planner, "--trajectories N", "motions to generate, without --data (default: 60,000)", count)
    option(planner, "--workers N", "processes that generate data without --data (all cores)", count)
    _add_shared(planner, out_required=False)
    _add_device(planner)
    parts = planner.add_argument_group("parts of the model that replace those of the config")
    option(
        parts,
        "--denoiser NAME",
        "transformer, encoder_decoder, decoder_only, unet, or cross_attention for the encoder points",
    )
    option(parts, "--sampler NAME", "sampler for planning: ddim or ddpm")
    option(parts, "--objective NAME", "what the denoiser predicts: clean or noise")
    option(
        parts,
        "--target NAME",
        "what motions are relative to: residual (the straight line), absolute or limits",
    )
    option(parts, "--sampling-steps N", "denoising steps for planning", count)
    option(
        parts,
        "--condition-drop P",
        "fraction of samples without condition, for classifier-free guidance",
        share,
    )
    option(parts, "--waypoints N", "waypoints of a motion", count)

    baseline = command(
        kinds,
        "baseline",
        "train the network of a learned baseline: mpnet, mpinets, trajectory_prior",
        "Train the network of a learned baseline on planned trajectories.",
        run_baseline,
    )
    option(baseline, "name NAME", "mpnet, mpinets or trajectory_prior (for MPD and EDMP)")
    option(baseline, "--data FOLDER !", "data set of `data generate`")
    option(baseline, "--robot NAME", "bundled name or URDF of the data's robot")
    _add_shared(baseline)

    export = command(
        kinds,
        "export",
        "write the ONNX files of trained weights anew",
        "Write the ONNX files that planning runs, from trained weights. Training writes them "
        "too; weights of earlier versions lack them.",
        run_export,
    )
    option(export, "folder FOLDER", "folder with weights")


def _add_shared(parser: argparse.ArgumentParser, out_required: bool = True) -> None:
    default = "" if out_required else "; without --data also for the data (default: beside the user's robots)"
    parser.add_argument(
        "--out",
        required=out_required,
        metavar="FOLDER",
        help=f"folder for weights, settings and checkpoints{default}",
    )
    length = parser.add_mutually_exclusive_group()
    option(length, "--minutes MIN", "length of the training [minutes]", positive)
    option(length, "--samples N", "length of the training [samples]", count)
    option(parser, "--seed N", "random seed", natural)
    option(parser, "--batch N", "samples per step", count)
    option(parser, "--learning-rate X", "largest learning rate", positive)
    option(parser, "--threads N", "number of PyTorch threads", count)
    option(parser, "--checkpoint-seconds S", "time between checkpoints [s] (default: 120)", positive)


def _add_device(parser: argparse.ArgumentParser) -> None:
    option(parser, "--device NAME", "cpu or cuda (default: cuda if there is one)")


def _given(arguments: argparse.Namespace, names: tuple[str, ...]) -> dict[str, object]:
    """The options that were given; the others keep the defaults of the settings."""
    given: dict[str, object] = {name: getattr(arguments, name) for name in names}
    return {name: value for name, value in given.items() if value is not None}


def run_encoder(arguments: argparse.Namespace) -> int:
    need_packages("training", "torch")
    from robotdiffuse.learning.training.config import EncoderTraining
    from robotdiffuse.learning.training.encoder import train_encoder

    given = _given(arguments, ("name", "scenes", "device", *TRAINING_OPTIONS))
    if "samples" in given:
        given["minutes"] = None
    settings = EncoderTraining(**given)  # type: ignore[arg-type]
    _print_report(train_encoder(settings, arguments.out), arguments.out)
    return 0


def run_completion(arguments: argparse.Namespace) -> int:
    need_packages("training", "torch")
    from robotdiffuse.learning.training.completion import CompletionTraining, train_completion

    given = _given(arguments, ("families", "robot", "workers", "weights", "device", *TRAINING_OPTIONS))
    if "minutes" in given:
        given["samples"] = None
    settings = CompletionTraining(**given)  # type: ignore[arg-type]
    _print_report(train_completion(settings, arguments.out), arguments.out)
    return 0


def run_planner(arguments: argparse.Namespace) -> int:
    need_packages("training", "torch")
    from robotdiffuse.learning.denoisers import DENOISERS
    from robotdiffuse.learning.training.configs import CONFIGS, planner_training
    from robotdiffuse.learning.training.planner import train_planner

    if arguments.config not in CONFIGS:
        known = [f"{name}: {config.description}" for name, config in CONFIGS.items()]
        raise InputError(f"unknown config {shown(arguments.config)}; known:", known)
    given = _given(arguments, ("data", "encoder", "robot", "device", *TRAINING_OPTIONS, *MODEL_OPTIONS))
    config = CONFIGS[arguments.config].changes
    if "denoiser" in given and config.get("denoiser_settings") is not None:
        # the config's settings are for its own denoiser; another one gets settings of the same size
        given["denoiser_settings"] = DENOISERS.defaults(arguments.denoiser).paper_size()
    if {"denoiser", "objective", "waypoints"} & set(given):
        given["progressive"] = False  # the stages are for the config's own parts
    if "encoder" in config:
        given.setdefault("encoder", config["encoder"])
    if arguments.config == "paper" and "encoder" not in given:
        raise InputError(
            "--config paper needs --encoder: a folder of "
            "`robotdiffuse train encoder --encoder compression_autoencoder --scenes rop`, the paper's encoder"
        )
    if arguments.data is None:
        return _run_for_robot(arguments, given)
    if arguments.out is None:
        raise InputError("--data needs --out, a folder for the weights")
    for name in ("trajectories", "workers"):
        if getattr(arguments, name) is not None:
            raise InputError(f"--{name} is for data to be generated; --data names existing data")
    # several processes would write it at once
    bundled = "encoder" not in given and int(os.environ.get("WORLD_SIZE", "1")) == 1
    if bundled:
        given["encoder"] = str(Path(arguments.out) / "encoder")
    settings = planner_training(arguments.config, given)
    if bundled:
        from robotdiffuse.cli.train_robot import copy_bundled_encoder

        copy_bundled_encoder(Path(arguments.out) / "encoder")
    _print_report(train_planner(settings, arguments.out), arguments.out)
    return 0


def _run_for_robot(arguments: argparse.Namespace, given: dict[str, Any]) -> int:
    from robotdiffuse.cli.train_robot import train_for_robot
    from robotdiffuse.learning.training.configs import planner_training

    if arguments.robot is None:
        raise InputError("give --robot to generate data for an arm, or --data to use existing data")
    report, kept = train_for_robot(
        arguments.robot,
        given,
        partial(planner_training, arguments.config),
        arguments.out,
        arguments.trajectories,
        arguments.workers,
    )
    _print_report(report, str(kept))
    return 0


def run_baseline(arguments: argparse.Namespace) -> int:
    need_packages("training", "torch")
    from robotdiffuse.learning.training.baseline import baseline_training, train_baseline
    from robotdiffuse.learning.training.configs import planner_training
    from robotdiffuse.learning.training.planner import train_planner

    given = _given(arguments, ("data", "robot", *TRAINING_OPTIONS))
    if arguments.name == "trajectory_prior":
        report = train_planner(planner_training(arguments.name, given), arguments.out)
    else:
        report = train_baseline(baseline_training(arguments.name, given), arguments.out)
    _print_report(report, arguments.out)
    return 0


def run_export(arguments: argparse.Namespace) -> int:
    need_packages("the export", "torch")
    from robotdiffuse.learning.checkpoint import export_weights

    print(f"wrote the ONNX files of {', '.join(export_weights(arguments.folder))} into {arguments.folder}")
    return 0


def _print_report(figures: dict[str, float], out: str) -> None:
    if int(os.environ.get("RANK", "0")) > 0:
        return  # only the first process of torchrun prints
    for name, value in figures.items():
        print(f"{name}: {value:.6g}")
    print(f"wrote {out}")
