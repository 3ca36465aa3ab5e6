"""The commands for data, training and comparisons, in one table."""

import os

from robotdiffuse.cli.arguments import (
    ALL_CORES,
    CLUSTER,
    CPU_TIME,
    HALF_OF_CORES,
    IMPORT,
    PANDA,
    SEED,
    Command,
    Group,
    count,
    names,
    natural,
    not_negative,
    positive,
    positives,
    share,
    shares,
)
from robotdiffuse.problems.families import FAMILIES

FOLDER = ("folder FOLDER", "folder of `robotdiffuse data generate`")
ROBOT_OF_DATA = ("--robot NAME", "the robot of the data, if the name in the manifest is not known here")
NPZ = "x_train n x 254 x 7, y_train n x 23"
DATA = Command(
    "data",
    "generate and inspect training data",
    "Generate and inspect training data.",
    (
        Command(
            "generate",
            "plan motions for many random problems",
            "Solve many random problems with Shared-Tree Informed RRT* or another planner, and write the "
            "motions that pass the validator to shards. Ctrl-C or a crash loses at most the unfinished "
            "shards; run the same command again to continue.",
            "data:run_generate",
            (
                ("--out FOLDER !", "folder for the data"),
                PANDA,
                ("--trajectories N", "motions to make (default: 140000)", count),
                ("--seed N", "random seed (default: 0)", natural),
                (
                    "--mix NAME=P,...",
                    f"fractions of the problem families {', '.join(FAMILIES)} (default: rop=1)",
                    shares,
                ),
                (
                    "--trivial-share P",
                    "fraction to keep of the problems that a straight line solves (default: 1, as in the "
                    "paper)",
                    share,
                ),
                ("--target KIND", "goals reach a tip position (position, default) or its full pose (pose)"),
                ("--goals N", "maximum number of goal configurations per target (default: 10)", count),
                ("--waypoints N", "waypoints of a motion (default: 254)", count),
                ("--timing KIND", "waypoints equally spaced in arc length (arc, default) or in time (time)"),
                ("--safety-distance M", "distance to keep to obstacles [m] (default: 0.05)", not_negative),
                ("--planner NAME", "shared_tree_rrt_star (default, as in the paper) or aorrtc"),
                ("--shard N", "motions per shard (default: 500)", count),
                ALL_CORES,
                ("--cluster NAME", "ray: use the Ray cluster at RAY_ADDRESS"),
                IMPORT,
            ),
        ),
        Command(
            "info",
            "print statistics and write a page of plots",
            "Print the statistics of a data set and write a page of plots.",
            "data:run_info",
            (FOLDER, ("--page FILE.html", "page of plots (default: FOLDER/report.html)"), ROBOT_OF_DATA),
        ),
        Command(
            "check",
            "check all shards and validate their motions again",
            "Check the structure of all shards and validate their motions again, with RobotDiffuse's "
            "validator and with PyBullet on meshes. Exit status: 0 clean, 1 violations found, 2 bad input.",
            "data:run_check",
            (
                FOLDER,
                ("--count N", "validate N random motions (default: all)", count),
                SEED,
                (*ALL_CORES, os.cpu_count() or 1),
                ("--no-pybullet", "do not validate with PyBullet"),
                ROBOT_OF_DATA,
            ),
        ),
        Command(
            "view",
            "show random motions as 3D replays",
            "Write random motions of a data set as 3D replays in one page. Without --out, the page opens in "
            "the browser.",
            "data:run_view",
            (
                FOLDER,
                ("--count N", "motions (default: 6)", count, 6),
                SEED,
                ("--out FILE.html", "page (default: FOLDER/samples.html)"),
                ROBOT_OF_DATA,
            ),
        ),
        Command(
            "export",
            "write the data in the format of the paper's robot.npz",
            f"Write the motions among exactly two spheres in the layout of the paper's robot.npz: {NPZ}.",
            "data:run_export",
            (FOLDER, ("file FILE.npz", "file to write")),
        ),
        Command(
            "import",
            "make a data set from the paper's robot.npz",
            "Make a data set from a file in the layout of the paper's robot.npz, to check and train on like "
            "any other. The file does not contain the radius of its spheres.",
            "data:run_import",
            (
                ("file FILE.npz", NPZ),
                ("--out FOLDER !", "folder for the data"),
                (*PANDA, None, "panda"),
                ("--radius M", "radius of the spheres [m] (default: 0.25)", positive, 0.25),
            ),
        ),
    ),
)
OUT = ("--out FOLDER !", "folder for weights, settings and checkpoints")
TRAINING = (
    Group(
        None,
        (
            ("--minutes MIN", "length of the training [minutes]", positive),
            ("--samples N", "length of the training [samples]", count),
        ),
    ),
    ("--seed N", "random seed", natural),
    ("--batch-size N", "batch size", count, None, {"dest": "batch"}),
    ("--learning-rate X", "peak learning rate", positive),
    ("--threads N", "number of PyTorch threads", count),
    (
        "--checkpoint-seconds S",
        "time between checkpoints [s] (default: 120; encoder: 60; config paper: 1800)",
        positive,
    ),
)
DEVICE = ("--device NAME", "cpu or cuda (default: cuda if there is one)")
TRAIN = Command(
    "train",
    "train networks",
    "Train a network. Ctrl-C stops after writing a checkpoint; run the same command again to continue. To "
    "train with N processes, on a GPU each if there are enough: torchrun --nproc-per-node N -m robotdiffuse "
    "train ...",
    (
        Command(
            "encoder",
            "train an auto-encoder of point clouds",
            "Train an auto-encoder of point clouds on random scenes. The planner's training keeps it frozen.",
            "train:run_encoder",
            (
                ("--encoder NAME", "encoder to train (default: point_autoencoder)", {"dest": "name"}),
                ("--scenes NAME", "training scenes: mixed (default), or rop, those of the paper's data"),
                OUT,
                *TRAINING,
                DEVICE,
            ),
        ),
        Command(
            "completion",
            "train the occupancy completion network",
            "Train the occupancy completion network, which predicts the obstacles that depth cameras do not "
            "see, on random scenes.",
            "train:run_completion",
            (
                ("--families NAMES", "families of the scenes (default: all)", names),
                ("--robot NAME", "bundled name or URDF of the arm in the images"),
                ("--workers N", "processes that draw samples (default: 1)", natural),
                ("--weights FOLDER", "weights to begin with; bundled: those that come with the package"),
                OUT,
                *TRAINING,
                DEVICE,
            ),
        ),
        Command(
            "planner",
            "train the network that predicts motions",
            "Train the network that predicts motions, on planned trajectories. With --robot and without "
            "--data, generate data for the arm, train on them, and install the weights where planners find "
            "them; this takes about two hours on two cores.",
            "train:run_planner",
            (
                (
                    "--data FOLDER",
                    "folder with shards of trajectories (default: generate them for --robot)",
                ),
                (
                    "--config NAME",
                    "compact (default), paper, points (no clearances as inputs), trajectory_prior (for MPD "
                    "and EDMP), or a row of the paper's Table 2: table2_jpc, table2_unet, ...",
                    None,
                    "compact",
                ),
                (
                    "--encoder FOLDER",
                    "folder of a trained encoder; pointnet or dgcnn, which are trained with the planner; or "
                    "points, for the denoiser cross_attention (default: that of the config, or the bundled "
                    "one)",
                ),
                ("--robot NAME", "bundled name or URDF of the robot (default: panda)"),
                ("--trajectories N", "motions to generate, without --data (default: 60,000)", count),
                ("--workers N", "processes that generate data, without --data (default: all cores)", count),
                (
                    "--out FOLDER",
                    f"{OUT[1]}; without --data also for the data (default: beside the robot's weights)",
                ),
                *TRAINING,
                DEVICE,
                Group(
                    "parts of the model that replace those of the config",
                    (
                        (
                            "--denoiser NAME",
                            "transformer, encoder_decoder, decoder_only, unet, or cross_attention for the "
                            "encoder points",
                        ),
                        ("--sampler NAME", "sampler for planning: ddim or ddpm"),
                        ("--objective NAME", "what the denoiser predicts: clean or noise"),
                        (
                            "--target NAME",
                            "what is subtracted from motions: residual (the straight line), absolute (the "
                            "mean of the data) or limits (nothing)",
                        ),
                        ("--sampling-steps N", "denoising steps for planning", count),
                        (
                            "--condition-drop P",
                            "fraction of samples without condition, for classifier-free guidance",
                            share,
                        ),
                        ("--waypoints N", "waypoints of a motion", count),
                    ),
                ),
            ),
        ),
        Command(
            "baseline",
            "train the network of a learned baseline: mpnet, mpinets, trajectory_prior",
            "Train the network of a learned baseline on planned trajectories.",
            "train:run_baseline",
            (
                ("name NAME", "mpnet, mpinets or trajectory_prior (for MPD and EDMP)"),
                ("--data FOLDER !", "data set of `data generate`"),
                ("--robot NAME", "bundled name or URDF of the data's robot"),
                OUT,
                *TRAINING,
            ),
        ),
        Command(
            "export",
            "write the ONNX files of trained weights anew",
            "Write the ONNX files that planning runs, from trained weights. Training writes them too; "
            "weights of earlier versions lack them.",
            "train:run_export",
            (("folder FOLDER", "folder with weights"),),
        ),
    ),
    below="networks",
)
BENCH = Command(
    "bench",
    "benchmark planners",
    "Benchmark planners and networks.",
    (
        Command(
            "run",
            "run planners on problems and record every call",
            "Run planners on the same problems, in turns, each planner in a process of its own. Results are "
            "lines of JSON in the folder. Ctrl-C or a crash loses at most the running calls; run the same "
            "command again to continue; with a longer --time-limit it repeats only calls that could improve.",
            "bench:run_run",
            (
                (
                    "--planners NAME,...",
                    "names that `planner list` shows, or all. NAME:SETTING=VALUE:SETTING=VALUE changes "
                    "settings, or until=first|converged|time_limit, objective=length|time and clearance=M of "
                    "the calls; NAME@FOLDER uses other weights. Example: "
                    "aorrtc:range=0.5,diffusion@runs/mine",
                    names,
                ),
                (
                    "--problems SET,...",
                    f"{', '.join(FAMILIES)}, each also with _nontrivial; or files or folders of problems; "
                    "with --preset, sets in addition to its own",
                    names,
                    (),
                ),
                (
                    "--preset NAME",
                    "a stored comparison with its planners, limits and seeds (benchmarks/README.md): "
                    "equal_time, learning, durations, anytime or restarts",
                ),
                ("--out FOLDER !", "folder for problems and results"),
                ("--time-limit S", "time limit of a call [s] (default: 1)", positive),
                ("--seeds N", "calls per problem, with different seeds (default: 1)", count),
                ("--count N", "problems per set (default: 100; all of a folder)", count),
                (
                    "--equal-time",
                    "call planners that end early again until the time limit is used up, and report the best "
                    "of these calls in extra rows, to compare lengths",
                ),
                CPU_TIME,
                HALF_OF_CORES,
                CLUSTER,
                IMPORT,
            ),
        ),
        Command(
            "report",
            "write tables, plots and replays of a run",
            "Write report.md with its plots as .svg, the same report as index.html, and replays.html "
            "(motions in 3D), and print the table of each problem set.",
            "bench:run_report",
            (
                ("folder FOLDER", "folder of `robotdiffuse bench run`"),
                (
                    "--limits S,...",
                    "time limits [s] (default: the run's, and those of 0.1, 1, 10, 60 below its longest)",
                    positives,
                ),
                ("--planners NAME,...", "planners to include (default: all)", names),
                ("--out OUT", "folder to write to (default: FOLDER)"),
                ("--no-replays", "do not write replays.html"),
                IMPORT,
            ),
        ),
        Command(
            "confirm",
            "check the motions of a run with PyBullet",
            "Check every solved motion of `bench run` with PyBullet, on meshes, as a second validator. The "
            "exit status is 1 if it finds a collision.",
            "bench:run_confirm",
            (
                ("folder FOLDER", "folder of `bench run`"),
                ("--count N", "check only the first N problems of each set (default: all)", count),
                IMPORT,
            ),
        ),
    ),
)
TABLE_1 = (
    ("--out FOLDER !", "folder for problems, results, page"),
    ("--problems N", "non-trivial problems for each kind of goal (default: 60)", count),
    ("--time-limit S", "time limit of a call [s] (default: 10)", positive),
    (
        "--paper-weights FOLDER",
        "weights of `train planner --config paper` or `--config points`, whose single samples get two rows, "
        "with and without guidance (default: no such rows; a note says how to train the weights)",
    ),
    ("--data FOLDER", "data set, for a row of its nearest motions"),
    CPU_TIME,
    HALF_OF_CORES,
    CLUSTER,
)
REPRODUCE = Command(
    "reproduce",
    "make the paper's tables and figures again, and show the printed ones beside them",
    "Draw the paper's problems, plan, validate, and write one page. Ctrl-C stops; run the same command "
    "again to continue.",
    (
        Command(
            "table1",
            "planners on ROP, with poses and with configurations as goals",
            "Write table1.md in the folder; `bench report` and `bench confirm` work on this folder too.",
            "bench:run_table1",
            TABLE_1,
        ),
        Command(
            "table2",
            "train and compare the rows of the ablation",
            "Train every row of the paper's Table 2 on the same number of samples, test it on the same "
            "held-out problems, and write table2.md in the folder.",
            "bench:run_table2",
            (
                ("--data DATA !", "data set of `data generate`"),
                ("--out FOLDER !", "folder for networks and page"),
                ("--samples N", "training samples per row (default: 300000)", count),
                (
                    "--encoder-samples N",
                    "point clouds to train the frozen encoder on (default: 300000)",
                    count,
                ),
                ("--problems N", "held-out problems (default: 500)", count),
                ("--family NAME", "family of these problems (default: rop)"),
                ("--rows NAME,...", "rows to train (default: all ten)", names),
                ("--seeds N", "training runs of each row, with different seeds (default: 1)", count),
                (*ALL_CORES, os.cpu_count() or 1),
            ),
        ),
        Command(
            "figures",
            "denoising, success over time, motions of two planners",
            "Write figures.md and its pictures in the folder of `reproduce table1`. Calls that this folder "
            "lacks are made first.",
            "bench:run_figures",
            TABLE_1,
        ),
    ),
    below="parts",
)
