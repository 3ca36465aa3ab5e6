"""robotdiffuse train encoder, robotdiffuse train planner"""

import argparse

from robotdiffuse.cli.arguments import count, natural, positive

SHARED = ("minutes", "samples", "seed", "batch", "learning_rate", "threads")


def add(commands: argparse._SubParsersAction) -> None:
    parser = commands.add_parser(
        "train",
        help="train the encoder or the planner's network",
        description="Train a network. Ctrl-C stops after a checkpoint; the same command continues.",
    )
    kinds = parser.add_subparsers(title="networks", metavar="NETWORK", required=True)

    encoder = kinds.add_parser(
        "encoder",
        help="an auto-encoder of point clouds",
        description="Train an auto-encoder of point clouds on random scenes; it is frozen afterwards.",
    )
    encoder.add_argument("--encoder", dest="name", metavar="NAME", help="which one (point_autoencoder)")
    _add_shared(encoder)
    encoder.set_defaults(run=run_encoder)

    planner = kinds.add_parser(
        "planner",
        help="the network that predicts motions",
        description="Train the network that predicts motions, on planned trajectories.",
    )
    planner.add_argument("--data", required=True, metavar="FOLDER", help="folder with shards of trajectories")
    planner.add_argument(
        "--config",
        default="compact",
        metavar="NAME",
        help="compact (default), paper, or a row of the paper's Table 2: table2_jpc, table2_unet, ...",
    )
    planner.add_argument(
        "--encoder",
        metavar="FOLDER",
        help="folder with a trained encoder, or the name of one to train along: pointnet, dgcnn; needed "
        "unless the config names one",
    )
    planner.add_argument("--robot", metavar="NAME", help="bundled name or URDF of the data's robot")
    _add_shared(planner)
    planner.set_defaults(run=run_planner)


def _add_shared(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--out", required=True, metavar="FOLDER", help="folder for weights, settings and checkpoints"
    )
    length = parser.add_mutually_exclusive_group()
    length.add_argument("--minutes", type=positive, metavar="MIN", help="length of the run in wall time")
    length.add_argument("--samples", type=count, metavar="N", help="length of the run in training samples")
    parser.add_argument("--seed", type=natural, metavar="N", help="random seed")
    parser.add_argument("--batch", type=count, metavar="N", help="samples per step")
    parser.add_argument("--learning-rate", type=positive, metavar="X", help="highest learning rate")
    parser.add_argument("--threads", type=count, metavar="N", help="threads of PyTorch")


def _given(arguments: argparse.Namespace, names: tuple[str, ...]) -> dict[str, object]:
    """The options that were given; the others keep the defaults of the settings."""
    given: dict[str, object] = {name: getattr(arguments, name) for name in names}
    return {name: value for name, value in given.items() if value is not None}


def run_encoder(arguments: argparse.Namespace) -> int:
    from robotdiffuse.learning.config import EncoderTraining
    from robotdiffuse.learning.encoder_training import train_encoder

    given = _given(arguments, ("name", *SHARED))
    if "samples" in given:
        given["minutes"] = None
    settings = EncoderTraining(**given)  # type: ignore[arg-type]
    _report(train_encoder(settings, arguments.out), arguments.out)
    return 0


def run_planner(arguments: argparse.Namespace) -> int:
    from robotdiffuse.learning.configs import planner_training
    from robotdiffuse.learning.training import train_planner

    settings = planner_training(arguments.config, _given(arguments, ("data", "encoder", "robot", *SHARED)))
    _report(train_planner(settings, arguments.out), arguments.out)
    return 0


def _report(figures: dict[str, float], out: str) -> None:
    for name, value in figures.items():
        print(f"{name}: {value:.6g}")
    print(f"wrote {out}")
