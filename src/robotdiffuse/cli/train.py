"""The commands `robotdiffuse train encoder`, `completion`, `planner`, `baseline` and `export`."""

import argparse
import os
from functools import partial
from pathlib import Path
from typing import Any

from robotdiffuse.cli.arguments import count, names, natural, positive, share
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
    parser = commands.add_parser(
        "train",
        help="train networks",
        description="Train a network. Ctrl-C stops after writing a checkpoint; run the same command again to "
        "continue. To train with N processes, on a GPU each if there are enough: "
        "torchrun --nproc-per-node N -m robotdiffuse train ...",
    )
    kinds = parser.add_subparsers(title="networks", metavar="NETWORK", required=True)

    encoder = kinds.add_parser(
        "encoder",
        help="train an auto-encoder of point clouds",
        description="Train an auto-encoder of point clouds on random scenes. The planner's training keeps "
        "it frozen.",
    )
    encoder.add_argument(
        "--encoder", dest="name", metavar="NAME", help="encoder to train (default: point_autoencoder)"
    )
    encoder.add_argument(
        "--scenes", metavar="NAME", help="training scenes: mixed (default), or rop, those of the paper's data"
    )
    _add_shared(encoder)
    _add_device(encoder)
    encoder.set_defaults(run=run_encoder)

    completion = kinds.add_parser(
        "completion",
        help="train the occupancy completion network",
        description="Train the occupancy completion network, which predicts the obstacles that depth "
        "cameras do not see, on random scenes.",
    )
    completion.add_argument(
        "--families", type=names, metavar="NAMES", help="families of the scenes (default: all)"
    )
    completion.add_argument("--robot", metavar="NAME", help="bundled name or URDF of the arm in the images")
    completion.add_argument(
        "--workers", type=natural, metavar="N", help="processes that draw samples (default: 1)"
    )
    completion.add_argument(
        "--weights", metavar="FOLDER", help="weights to begin with; bundled: those that come with the package"
    )
    _add_shared(completion)
    _add_device(completion)
    completion.set_defaults(run=run_completion)

    planner = kinds.add_parser(
        "planner",
        help="train the network that predicts motions",
        description="Train the network that predicts motions, on planned trajectories. With --robot and "
        "without --data, generate data for the arm, train on them, and install the weights where planners "
        "find them; this takes about two hours on two cores.",
    )
    planner.add_argument(
        "--data",
        metavar="FOLDER",
        help="folder with shards of trajectories (default: generate them for --robot)",
    )
    planner.add_argument(
        "--config",
        default="compact",
        metavar="NAME",
        help="compact (default), paper, points (no clearances as inputs), trajectory_prior (for MPD and "
        "EDMP), or a row of the paper's Table 2: table2_jpc, table2_unet, ...",
    )
    planner.add_argument(
        "--encoder",
        metavar="FOLDER",
        help="folder of a trained encoder; pointnet or dgcnn, which are trained with the planner; or points, "
        "for the denoiser cross_attention (default: that of the config, or the bundled one)",
    )
    planner.add_argument("--robot", metavar="NAME", help="bundled name or URDF of the robot (default: panda)")
    planner.add_argument(
        "--trajectories",
        type=count,
        metavar="N",
        help="motions to generate, without --data (default: 60,000)",
    )
    planner.add_argument(
        "--workers", type=count, metavar="N", help="processes that generate data without --data (all cores)"
    )
    _add_shared(planner, out_required=False)
    _add_device(planner)
    parts = planner.add_argument_group("parts of the model that replace those of the config")
    parts.add_argument(
        "--denoiser",
        metavar="NAME",
        help="transformer, encoder_decoder, decoder_only, unet, or cross_attention for the encoder points",
    )
    parts.add_argument("--sampler", metavar="NAME", help="sampler for planning: ddim or ddpm")
    parts.add_argument("--objective", metavar="NAME", help="what the denoiser predicts: clean or noise")
    parts.add_argument(
        "--target",
        metavar="NAME",
        help="what motions are relative to: residual (the straight line), absolute or limits",
    )
    parts.add_argument("--sampling-steps", type=count, metavar="N", help="denoising steps for planning")
    parts.add_argument(
        "--condition-drop",
        type=share,
        metavar="P",
        help="fraction of samples without condition, for classifier-free guidance",
    )
    parts.add_argument("--waypoints", type=count, metavar="N", help="waypoints of a motion")
    planner.set_defaults(run=run_planner)

    baseline = kinds.add_parser(
        "baseline",
        help="train the network of a learned baseline: mpnet, mpinets, trajectory_prior",
        description="Train the network of a learned baseline on planned trajectories.",
    )
    baseline.add_argument(
        "name", metavar="NAME", help="mpnet, mpinets or trajectory_prior (for MPD and EDMP)"
    )
    baseline.add_argument("--data", required=True, metavar="FOLDER", help="data set of `data generate`")
    baseline.add_argument("--robot", metavar="NAME", help="bundled name or URDF of the data's robot")
    _add_shared(baseline)
    baseline.set_defaults(run=run_baseline)

    export = kinds.add_parser(
        "export",
        help="write the ONNX files of trained weights anew",
        description="Write the ONNX files that planning runs, from trained weights. Training writes them "
        "too; weights of earlier versions lack them.",
    )
    export.add_argument("folder", metavar="FOLDER", help="folder with weights")
    export.set_defaults(run=run_export)


def _add_shared(parser: argparse.ArgumentParser, out_required: bool = True) -> None:
    default = "" if out_required else "; without --data also for the data (default: beside the user's robots)"
    parser.add_argument(
        "--out",
        required=out_required,
        metavar="FOLDER",
        help=f"folder for weights, settings and checkpoints{default}",
    )
    length = parser.add_mutually_exclusive_group()
    length.add_argument("--minutes", type=positive, metavar="MIN", help="length of the training [minutes]")
    length.add_argument("--samples", type=count, metavar="N", help="length of the training [samples]")
    parser.add_argument("--seed", type=natural, metavar="N", help="random seed")
    parser.add_argument("--batch", type=count, metavar="N", help="samples per step")
    parser.add_argument("--learning-rate", type=positive, metavar="X", help="largest learning rate")
    parser.add_argument("--threads", type=count, metavar="N", help="number of PyTorch threads")
    parser.add_argument(
        "--checkpoint-seconds", type=positive, metavar="S", help="time between checkpoints [s] (default: 120)"
    )


def _add_device(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--device", metavar="NAME", help="cpu or cuda (default: cuda if there is one)")


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
    from robotdiffuse.learning.training.config import CONFIGS, planner_training
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
    for option in ("trajectories", "workers"):
        if getattr(arguments, option) is not None:
            raise InputError(f"--{option} is for data to be generated; --data names existing data")
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
    from robotdiffuse.learning.training.config import planner_training

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
    from robotdiffuse.learning.training.config import planner_training
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
