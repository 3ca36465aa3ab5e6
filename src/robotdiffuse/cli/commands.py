"""All commands with their options, by topic. The module of a command is imported when it runs."""

from inspect import signature

from robotdiffuse.cli.arguments import (
    ADDRESS,
    IGNORE_JOINTS,
    IMPORT,
    INDEX,
    PROBLEM,
    RESULT,
    SEED,
    SHELLS,
    TOKEN,
    VIEW,
    Command,
    Group,
    address,
    assignment,
    count,
    megabytes,
    natural,
    not_negative,
    pair,
    port,
    positive,
)
from robotdiffuse.cli.study_commands import BENCH, DATA, REPRODUCE, TRAIN
from robotdiffuse.planning import described_arguments, plan

_DESCRIPTIONS = described_arguments()
REQUEST = tuple(
    (
        f"--{name.replace('_', '-')} {name.upper()}",
        # `python -OO` leaves docstrings out
        _DESCRIPTIONS.get(name, "").replace("None:", "Default:")
        + ("" if argument.default is None else f" Default: {argument.default}."),
    )
    for name, argument in signature(plan).parameters.items()
    if name != "problem" and argument.kind is argument.POSITIONAL_OR_KEYWORD
)
"""The options that are arguments of `rd.plan`, as its docstring describes them."""
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
                "weights of a learned planner: a folder of `robotdiffuse train`, or panda_points for the "
                "bundled network without clearances as inputs (default: the robot's weights)",
            ),
            (
                "--set NAME=VALUE *",
                "a setting of the planner; see `robotdiffuse planner info NAME`; repeatable",
                {"dest": "settings"},
            ),
            *REQUEST,
            (
                "--unknown POLICY",
                "policy for space that the problem's views do not show: optimistic (free), padded, predicted "
                "or occupied (default: the problem's; else predicted if the network covers the arm's reach, "
                "otherwise padded)",
            ),
            IGNORE_JOINTS,
            (
                "--next-view",
                "propose the camera pose that shows the most of the unknown space that the motion crosses",
            ),
            (
                "--blend R",
                "pass the problem's waypoints without stopping, within this distance: in rad for "
                "configurations, in m for poses (default: the problem's, or stop)",
                positive,
            ),
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
        "explore:run_demo",
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
        "cameras have seen. One is at its tip; another, beside the arm, takes a single image. Shapes named "
        "floor are known. Each motion is validated in the true scene. Exit status: 0 at the goal, 1 not, "
        "2 bad input.",
        "explore:run_explore",
        (
            PROBLEM,
            (
                "--policy POLICY",
                "strict: only through space that was seen free; probabilistic: where the stated confidence "
                "is high; strict_then_probabilistic (default: strict)",
            ),
            ("--confidence P", "minimum confidence for policy probabilistic (default: 0.98)", float),
            (
                "--see-goal",
                "go to a goal only if cameras saw that the arm's surface will be in free space there (policy "
                "strict)",
            ),
            ("--time-limit S", "time limit of each search [s] (default: 1)", float),
            ("--noise", "simulate the noise of depth cameras"),
            SEED,
            (
                "--out FILE *",
                "replay with what was known at each time (.html), or pictures of up to 6 steps (.png); "
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
            IMPORT,
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
            ("--time-limit S", "time limit of each plan (default: 1 s)", positive),
            *ADDRESS,
            IMPORT,
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
            ("--host HOST", "address to listen on (default: 127.0.0.1)"),
            ("--port PORT", "port; 0 for any free one (default: 8000)", port),
            ("--workers N", "processes that plan (default: one per core)", count),
            (
                "--queue N",
                "requests that may wait for a worker; further ones are answered with 429 (default: 16)",
                natural,
            ),
            ("--max-time-limit S", "largest time limit of a request (default: 10 s)", positive),
            ("--max-request-size MB", "largest size of a request (default: 8 MB)", megabytes),
            (
                "--max-worker-memory MB",
                "memory of a worker, at least 512; requests that need more are refused (default: 2048 MB)",
                megabytes,
            ),
            IMPORT,
        ),
    ),
)
CHECKS = (
    Command(
        "verify",
        "validate a motion from any source",
        "Validate a motion from any planner: a RobotDiffuse result, a CSV table, a ROS 2 bag, MCAP, and JSON "
        "or YAML with a ROS JointTrajectory or MoveIt RobotTrajectory. Exit status: 0 valid, 1 not valid, "
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
            IMPORT,
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
                "Re-check a certificate with code that shares little more than data types with the "
                "validator. Exit status: 0 if it holds, 1 if not, 2 for bad input.",
                "verify:run_check",
                (
                    ("file FILE", "certificate of `robotdiffuse verify --certificate`"),
                    (
                        "--problem FILE",
                        "problem file to check it for (default: the problem in the certificate)",
                    ),
                    IMPORT,
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
                "share robot and scene",
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
            IMPORT,
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
            IMPORT,
        ),
    ),
    Command(
        "export",
        "write a result for ROS 2, Foxglove or Rerun",
        "Validate the motion of a result file again, and write it for other programs: .mcap (a scene that "
        "Foxglove opens, with ROS 2 messages), .rosbag2 (a ROS 2 bag, a folder), .rrd (Rerun), .yaml (a ROS "
        "2 JointTrajectory), .csv and .json.",
        "verify:run_export",
        (
            RESULT,
            ("--out FILE * !", "file to write; repeatable"),
            (
                "--rate HZ",
                "resample the motion at this rate for a controller, and validate the resampled motion",
                float,
            ),
            IMPORT,
        ),
    ),
    Command(
        "publish",
        "publish a result to ROS through rosbridge",
        "Validate the motion of a result file again, and publish it as a ROS JointTrajectory.",
        "verify:run_publish",
        (
            RESULT,
            ("--to HOST[:PORT] !", "rosbridge server (port: 9090)", address),
            ("--topic NAME", "topic to publish on (default: /joint_trajectory)", None, "/joint_trajectory"),
            ("--timeout S", "timeout of the connection (default: 5 s)", positive, 5.0),
            IMPORT,
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
                (("robot ROBOT", "a bundled or added name, a prepared folder, a URDF or a MuJoCo model"),),
            ),
            Command(
                "add",
                "prepare a robot from its URDF",
                "Prepare a robot for planning: fit covering spheres to the collision meshes of its URDF, "
                "find the pairs of links that need no collision check, and write a folder that problems can "
                "name.",
                "robot:run_add",
                (
                    (
                        "urdf URDF",
                        "URDF of an arm, MuJoCo model, or xacro file; compiling xacro runs the code in it",
                    ),
                    ("--name NAME", "name that problems use (default: the URDF's)"),
                    ("--out FOLDER", "folder to write (default: one in the user's folder of robots)"),
                    (
                        "--group NAME",
                        "SRDF group or arm to plan for; 'both' or 'all' takes several arms as one robot "
                        "(default: the only arm)",
                    ),
                    ("--base LINK", "first link of the arm (default: the root)"),
                    ("--tip LINK", "last link of the arm (default: the link where a gripper begins)"),
                    ("--lock JOINT=VALUE *", "lock a joint at a value [rad or m]; repeatable", assignment),
                    (
                        "--srdf FILE",
                        "SRDF with groups, poses, passive joints and allowed pairs of links (default: the "
                        "SRDF beside the URDF, but its pairs are ignored)",
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
                        pair,
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
            "Print a script that completes commands and options. To use it, add this line to ~/.bashrc: "
            'eval "$(robotdiffuse completion bash)" (for zsh: to ~/.zshrc, with zsh in place of bash).',
            "completion:run_completion",
            (("shell", "the shell", {"choices": SHELLS}),),
        ),
    ),
}
"""Commands by topic."""
