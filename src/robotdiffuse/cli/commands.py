"""All commands with their options, in one table. The module of a command is imported when it runs."""

import os
from argparse import _SubParsersAction as Commands
from dataclasses import dataclass
from typing import Any, NamedTuple

from robotdiffuse.cli.arguments import (
    address,
    assignment,
    count,
    folder,
    jerk_limit,
    names,
    natural,
    not_negative,
    option,
    port,
    positive,
    positives,
    share,
    shares,
)
from robotdiffuse.core.types import CONVERGED, OBJECTIVES, TIME, UNTIL
from robotdiffuse.problems.families import FAMILIES
from robotdiffuse.processes.ray_cluster import CLUSTERS

Rows = tuple[Any, ...]
"""Options: each row holds arguments of `option`, the last of them a dictionary if argparse needs keywords."""


class Group(NamedTuple):
    """Options below a title, or without one, of which at most one may be given."""

    title: str | None
    rows: Rows


@dataclass(frozen=True)
class Command:
    """A command, or a group of commands."""

    name: str
    help: str
    description: str
    run: "str | tuple[Command, ...]"
    """MODULE:FUNCTION of `robotdiffuse.cli`, which takes the arguments and returns the exit status, or None
    for 0; or the commands below it."""
    rows: Rows = ()
    """The options of the command, and groups of options."""
    below: str = "actions"
    """What the help calls the commands below it."""

    def add(self, commands: Commands) -> None:
        """Add the command to a parser."""
        parser = commands.add_parser(self.name, help=self.help, description=self.description)
        parser.set_defaults(run=self.run)
        for row in self.rows:
            if not isinstance(row, Group):
                option(parser, *row)
                continue
            title, rows = row
            group = parser.add_argument_group(title) if title else parser.add_mutually_exclusive_group()
            for options in rows:
                option(group, *options)
        if isinstance(self.run, tuple):
            actions = parser.add_subparsers(title=self.below, metavar=self.below[:-1].upper(), required=True)
            for command in self.run:
                command.add(actions)


PORT = 8080
TOKEN = "ROBOTDIFFUSE_TOKEN"
LOOPBACK = "127.0.0.1"
SHELLS = ("bash", "zsh")
PROBLEM = ("problem PROBLEM", "problem file")
RESULT = ("result RESULT", "result file (.json) of `robotdiffuse plan --out`")
INDEX = ("--index INDEX", "which problem of a .jsonl file (default: 0)", natural, 0)
SEED = ("--seed N", "random seed (default: 0)", natural, 0)
VIEW = ("--view", "write a replay (.html) and open it")
PANDA = ("--robot NAME", "bundled name or URDF (default: panda)")
ALL_CORES = ("--workers N", "processes (default: all cores)", count)
HALF_OF_CORES = ("--workers N", "planners that run at once (default: half of the cores)", count)
CPU_TIME = ("--cpu-time", "limits and times are CPU time, for a machine that does other work")
CLUSTER = ("--cluster", "use the Ray cluster at RAY_ADDRESS", None, None, {"choices": CLUSTERS})
IGNORE_JOINTS = (
    "--ignore-joints",
    "ignore joints of MoveIt files that the robot does not have, with a note, instead of failing",
)
IMPORT = (
    "--import MODULE *",
    "import MODULE first (also from the current folder), for example to register planners or families; "
    "repeatable",
    {"dest": "modules"},
)
ADDRESS = (
    (
        "--host ADDRESS",
        "address to listen on (default: 127.0.0.1, this machine only); on other addresses the URL of the "
        "page ends with a secret token that every visitor needs",
        None,
        LOOPBACK,
    ),
    ("--port N", f"port; 0 for any free one (default: {PORT})", port, PORT),
)
PLANNING = (
    Command(
        "plan",
        "plan a motion for a problem file",
        "Plan a motion for a problem file; every motion found is verified. Exit status: 0 "
        "solved, 1 no plan, 2 bad input.",
        "plan:run_plan",
        (
            ("problem PROBLEM", "problem file (.yaml, .json or .jsonl)"),
            INDEX,
            ("--planner NAME", "see `robotdiffuse planner list` (default: robotdiffuse)"),
            (
                "--weights FOLDER",
                "weights of a learned planner: a folder of `robotdiffuse train`, or panda_points, bundled "
                "weights without clearances as inputs (default: those trained for the robot, or bundled)",
            ),
            (
                "--set NAME=VALUE *",
                "a setting of the planner; see `robotdiffuse planner info NAME`; repeatable",
                {"dest": "settings"},
            ),
            ("--time-limit S", "time limit for planning (default: 1 s)", positive, 1.0),
            (
                "--until",
                "stop at the first motion, when more time hardly improves it (default), or at the time limit",
                None,
                CONVERGED,
                {"choices": UNTIL},
            ),
            (
                "--clearance M",
                "distance to obstacles to keep where possible, up to 0.5 m (default: the problem's, or 0.01 "
                "m)",
                not_negative,
            ),
            (
                "--unknown POLICY",
                "policy for space that the problem's views do not show: optimistic (free), padded, predicted "
                "or occupied (default: the problem's; else predicted if the network covers the arm's reach, "
                "otherwise padded)",
            ),
            IGNORE_JOINTS,
            (
                "--next-view",
                "propose a camera pose that shows most of the unknown space that the motion crosses",
            ),
            *(
                (
                    f"--{rate}-scaling X",
                    f"fraction of the robot's {rate} limits to use, from 0.001 to 1 (default: 1)",
                    share,
                    1.0,
                )
                for rate in ("velocity", "acceleration")
            ),
            (
                "--jerk J",
                "jerk limit of each joint, at least 0.01 rad/s³, or none (default: the robot's limits)",
                jerk_limit,
            ),
            (
                "--objective",
                "what searches minimize: the path's length or the motion's duration (default: time)",
                None,
                TIME,
                {"choices": OBJECTIVES},
            ),
            (
                "--blend R",
                "pass the problem's waypoints without stopping, within this distance: in rad for "
                "configurations, in m for poses (default: the problem's, or stop)",
                positive,
            ),
            SEED,
            (
                "--out FILE *",
                "file to write: result (.json), trajectory (.csv), replay (.html), picture (.png), or for "
                "other programs .mcap (Foxglove, ROS 2), .rosbag2, .rrd (Rerun) or .yaml (JointTrajectory); "
                "repeatable",
            ),
            VIEW,
            IMPORT,
        ),
    ),
    Command(
        "demo",
        "plan a bundled problem and draw the motion",
        "Plan a bundled problem with obstacles, and write demo.png and demo.html to the current folder; with "
        "--explore, observe the obstacles by cameras on the way.",
        "demo:run_demo",
        (
            Group(
                None,
                (
                    (
                        "--camera",
                        "plan with the view of one depth camera instead of the scene; demo_true.png shows "
                        "the motion in the true scene",
                    ),
                    (
                        "--explore",
                        "simulate an arm with a camera at its tip, which takes views of the shelf before it "
                        "moves to the goal; writes explore.png and explore.html",
                    ),
                ),
            ),
            (
                "--robot NAME",
                "plan with another arm, between shelves of its size; see `robotdiffuse robot list`",
            ),
        ),
    ),
    Command(
        "explore",
        "explore an unknown scene with a simulated wrist camera",
        "Simulate an arm that goes from a problem's start to its goal and knows of the scene only what depth "
        "cameras have seen: one at its tip, and one beside it that takes one image. Shapes named floor are "
        "known. Each motion is validated in the true scene. Exit status: 0 at the goal, 1 not, 2 bad input.",
        "explore:run_explore",
        (
            PROBLEM,
            (
                "--policy POLICY",
                "strict: only through space that was seen free; probabilistic: where the stated confidence "
                "is high; strict_then_probabilistic (default: strict)",
                None,
                "strict",
            ),
            ("--confidence P", "minimum confidence for policy probabilistic (default: 0.98)", float, 0.98),
            (
                "--see-goal",
                "go to a goal only if cameras saw that the arm's surface will be in free space there (policy "
                "strict)",
            ),
            ("--time-limit S", "time limit of each search [s] (default: 1)", float, 1.0),
            ("--noise", "simulate the noise of depth cameras"),
            ("--seed N", "random seed (default: 0)", int, 0),
            (
                "--out FILE *",
                "replay with what was known at each time (.html), or a strip of pictures, one a step (.png); "
                "repeatable",
            ),
            VIEW,
            (
                "--record FILE",
                "write the depth images with camera parameters, poses and joint states to this .mcap file",
            ),
            Group(
                "live page",
                (
                    (
                        "--live",
                        "serve a page that shows the exploration while it happens, until Ctrl-C; it begins "
                        "when the page is first opened",
                    ),
                    ("--speed X", "speed of the motions on the page (default: 1, real time)", positive, 1.0),
                    *ADDRESS,
                ),
            ),
        ),
    ),
    Command(
        "live",
        "plan interactively in the browser",
        "Serve an interactive page until Ctrl-C. Drag the target, the start and obstacles: the page plans "
        "again after each change, and shows at once whether the current motion is still valid. Without "
        "PROBLEM, it shows the demo problem.",
        "live:run_live",
        (
            ("problem PROBLEM", "problem file (.yaml or .json) to open", {"nargs": "?"}),
            ("--robot NAME", "instead of PROBLEM: name or URDF file of an arm"),
            ("--planner NAME", "planner; see `robotdiffuse planner list` (default: robotdiffuse)"),
            ("--time-limit S", "time limit of each plan (default: 1 s)", positive, 1.0),
            *ADDRESS,
        ),
    ),
    Command(
        "serve",
        "plan and validate over HTTP",
        "Plan and validate over HTTP until SIGTERM or Ctrl-C. Running requests then finish; waiting ones are "
        "answered with 503. The server's address in a browser lists all endpoints. A server that other "
        f"machines can reach needs a token in the environment variable {TOKEN}.",
        "serve:run",
        (
            (
                "--robot NAME *",
                "another robot that requests may name: one of `robot add`, or a URDF file; repeatable",
            ),
            ("--host HOST", "address to listen on (default: 127.0.0.1)", None, LOOPBACK),
            ("--port PORT", "port; 0 for any free one (default: 8000)", natural, 8000),
            ("--workers N", "processes that plan (default: one per core)", count),
            (
                "--queue N",
                "requests that may wait for a worker; further ones are answered with 429 (default: 16)",
                natural,
                16,
            ),
            ("--max-time-limit S", "largest time limit of a request (default: 10 s)", positive, 10.0),
            ("--max-request-size MB", "largest size of a request (default: 8 MB)", count, 8),
            (
                "--max-worker-memory MB",
                "memory of a worker, at least 512; requests that need more are refused (default: 2048 MB)",
                count,
                2048,
            ),
        ),
    ),
)
CHECKS = (
    Command(
        "verify",
        "validate a motion from any source",
        "Validate a motion from any planner: a RobotDiffuse result, CSV, JSON, YAML of a ROS "
        "JointTrajectory or MoveIt RobotTrajectory, a ROS 2 bag or MCAP. Exit status: 0 valid, 1 not valid, "
        "2 bad input.",
        "verify:run_verify",
        (
            ("motion MOTION", "file (.json, .csv, .yaml, .mcap), or the folder of a ROS 2 bag"),
            Group(
                None,
                (
                    ("--problem FILE", "problem file (default: the problem in the result or .mcap file)"),
                    (
                        "--scene FILE",
                        "MoveIt planning scene, instead of a problem; start and goal are those of the "
                        "motion; needs --robot",
                    ),
                ),
            ),
            INDEX,
            ("--robot NAME", "bundled name or URDF, with --scene"),
            IGNORE_JOINTS,
            ("--topic NAME", "topic to read if the bag or MCAP file has several"),
            ("--all", "print all violations, not only the first"),
            (
                "--certificate FILE.json",
                "write a proof that the motion is valid, for `robotdiffuse certificate check`",
            ),
        ),
    ),
    Command(
        "certificate",
        "re-check a certificate of a motion",
        "Re-check the certificate of a motion.",
        (
            Command(
                "check",
                "re-check a certificate, without search",
                "Re-check a certificate with code that shares nothing with the validator. Exit status: 0 if "
                "it holds, 1 if not, 2 for bad input.",
                "verify:run_check",
                (
                    ("file FILE", "certificate of `robotdiffuse verify --certificate`"),
                    (
                        "--problem FILE",
                        "problem file to check it for (default: the problem in the certificate)",
                    ),
                ),
            ),
        ),
    ),
    Command(
        "view",
        "draw results and problems as a replay (.html) or a picture (.png)",
        "Draw the motions of one result file, or of several in one picture. For a problem file, or a result "
        "without a motion, draw the start, the goal and the links that collide. Without --out, write a page "
        "and open it in the browser.",
        "view:run_view",
        (
            (
                "results RESULT",
                "result file (.json) of `robotdiffuse plan --out`, or a problem file; several results must "
                "be of one problem",
                {"nargs": "+"},
            ),
            (
                "--out FILE *",
                "replay (.html) or picture (.png); repeatable (default: the name of RESULT with .html)",
            ),
            (
                "--shell M",
                "with several results: thickness of a layer that pictures show around the arm as a safety "
                "distance [m] (default: 0, none)",
                not_negative,
                0.0,
            ),
        ),
    ),
    Command(
        "simulate",
        "replay a result in the PyBullet simulator",
        "Replay the motion of a result file in PyBullet with position control, and print tracking errors and "
        "contacts. Exit status: 0 no contacts, 1 contacts, 2 bad input.",
        "view:run_simulate",
        (
            RESULT,
            ("--out FILE *", "replay (.html) or picture (.png) of the simulated motion; repeatable"),
        ),
    ),
    Command(
        "export",
        "write a result for ROS 2, Foxglove or Rerun",
        "Validate the motion of a result file again, and write it for other programs: .mcap (a scene that "
        "Foxglove opens, with ROS 2 messages), .rosbag2 (a ROS 2 bag, a folder), .rrd (Rerun), .yaml (a ROS "
        "2 JointTrajectory), .csv and .json.",
        "export:run_export",
        (
            RESULT,
            ("--out FILE * !", "file to write; repeatable"),
            (
                "--rate HZ",
                "resample the motion at this rate for a controller, and validate the resampled motion",
                float,
            ),
        ),
    ),
    Command(
        "publish",
        "publish a result to ROS through rosbridge",
        "Validate the motion of a result file again, and publish it as a ROS JointTrajectory.",
        "export:run_publish",
        (
            RESULT,
            ("--to HOST[:PORT] !", "rosbridge server (port: 9090)", address),
            ("--topic NAME", "topic to publish on (default: /joint_trajectory)", None, "/joint_trajectory"),
            ("--timeout S", "timeout of the connection (default: 5 s)", positive, 5.0),
        ),
    ),
)
ROBOTS = (
    Command(
        "robot",
        "list, show or prepare robots",
        "List or show robots, or prepare a new one.",
        (
            Command(
                "list",
                "list the robots that problems can name",
                "List the bundled robots and those added by `robot add`.",
                "robot:run_list",
            ),
            Command(
                "info",
                "show joints, limits and collision model",
                "Show joints, limits and collision model of a robot.",
                "robot:run_info",
                (("robot ROBOT", "a bundled name, a prepared folder or a URDF file"),),
            ),
            Command(
                "add",
                "prepare a robot from its URDF",
                "Prepare a robot for planning: fit covering spheres to the collision meshes of its URDF, "
                "find the pairs of links that need no collision check, and write a folder that problems can "
                "name.",
                "robot:run_add",
                (
                    ("urdf URDF", "URDF of an arm, or xacro file; compiling xacro runs the code in it"),
                    ("--name NAME", "name that problems use (default: the URDF's)"),
                    ("--out FOLDER", "folder to write (default: one in the user's robots)"),
                    (
                        "--group NAME",
                        "group of the SRDF, or arm, to plan for; both or all: several arms as one robot "
                        "(default: the only arm)",
                    ),
                    ("--base LINK", "first link of the arm (default: the root)"),
                    ("--tip LINK", "last link of the arm (default: the link where a gripper begins)"),
                    ("--lock JOINT=VALUE *", "lock a joint at a value [rad or m]; repeatable", assignment),
                    (
                        "--srdf FILE",
                        "SRDF with groups, poses, passive joints and allowed pairs of links (default: the "
                        "SRDF beside the URDF, without its pairs)",
                    ),
                    (
                        "--allow LINK *",
                        "two links not to check against each other; repeatable",
                        {"nargs": 2, "metavar": ("LINK", "LINK")},
                    ),
                    (
                        "--package NAME=FOLDER *",
                        "folder of a ROS package (default: search ROS_PACKAGE_PATH, AMENT_PREFIX_PATH and "
                        "the folders above the URDF)",
                        folder,
                    ),
                    ("--limits FILE", "file of joint limits, as MoveIt's joint_limits.yaml"),
                    ("--license TEXT", "license of the URDF's geometry, to keep in the folder"),
                    SEED,
                ),
            ),
        ),
    ),
    Command(
        "planner",
        "list or show planners",
        "List the planners, or show one.",
        (
            Command(
                "list", "list the planners", "List the planners.", "completion:run_planner_list", (IMPORT,)
            ),
            Command(
                "info",
                "show the settings of a planner",
                "Show the settings of a planner, for `robotdiffuse plan --set`.",
                "completion:run_planner_info",
                (("planner NAME", "a planner that `planner list` shows"), IMPORT),
            ),
        ),
    ),
)
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
                ("--target KIND", "goal type: tip position (default) or full pose"),
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
    ("--batch N", "batch size", count),
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
                ("--workers N", "processes that generate data without --data (all cores)", count),
                (
                    "--out FOLDER",
                    f"{OUT[1]}; without --data also for the data (default: beside the user's robots)",
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
                            "what motions are relative to: residual (the straight line), absolute or limits",
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
                    "time limits [s] (default: those of the run, and 0.1, 1, 10, 60 below them)",
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
            ),
        ),
    ),
)
TABLE_1 = (
    ("--out FOLDER !", "folder for problems, results, page"),
    ("--problems N", "nontrivial problems for each kind of goal (default: 60)", count, 60),
    ("--time-limit S", "time limit of a call [s] (default: 10)", positive, 10.0),
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
                ("--seeds N", "trainings of each row, with different seeds (default: 1)", count),
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
COMMANDS = {
    "plan": PLANNING,
    "check and show": CHECKS,
    "robots and planners": ROBOTS,
    "data, training, comparisons": (DATA, TRAIN, BENCH, REPRODUCE),
    "editor and shell": (
        Command(
            "schema",
            "print the JSON schema of problem files",
            "Print the JSON schema of problem files, by which editors complete and check them.",
            "completion:run_schema",
        ),
        Command(
            "completion",
            "print a script that completes commands and options in bash or zsh",
            "Print a script that completes commands and options: "
            'eval "$(robotdiffuse completion bash)" in ~/.bashrc, or with zsh in ~/.zshrc.',
            "completion:run_completion",
            (("shell", "the shell", {"choices": SHELLS}),),
        ),
    ),
}
"""Commands by topic."""
