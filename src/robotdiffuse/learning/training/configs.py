"""Named settings of planner training: the paper's, those of the bundled weights, those of a network that sees
points of the scene, the rows of the paper's Table 2, and the prior of MPD and EDMP (see
`planning.baselines.guided_prior`).

The rows of Table 2 differ only in what they compare, and have a size that a CPU can train. Unlike `paper`
they diffuse 48 waypoints in patches of 4, as residuals to the straight line, with smooth noise, which takes
fewer samples to learn. Only the row that predicts the noise has the paper's white noise: smooth noise has
almost no high frequencies, so small errors in them, divided by the small signal of the last levels, would
dominate the samples. Clearances are no inputs of these networks, as in the paper: they would compensate for
what an encoder loses.
"""

import math
from typing import Any, NamedTuple

from robotdiffuse.core.errors import InputError, unknown_name
from robotdiffuse.learning.denoisers import TransformerSettings, UNetSettings
from robotdiffuse.learning.diffusion import ScheduleSettings
from robotdiffuse.learning.training.config import PlannerTraining
from robotdiffuse.learning.training.losses import LossSettings

JOINT = LossSettings()
JOINT_POINT = LossSettings(point=0.3, waypoints=4)
JOINT_POINT_COLLISION = LossSettings(point=0.3, collision=0.05, begin=0.3, waypoints=4)
"""The paper gives no weights; with these the three losses are of one size when predictions are 5 cm off."""

_TABLE2_ROW = {"clearance_features": False, "condition_drop": 0.1, "losses": JOINT_POINT_COLLISION}


class Config(NamedTuple):
    description: str
    changes: dict[str, Any]
    """Changes to the defaults of PlannerTraining."""


CONFIGS: dict[str, Config] = {
    "compact": Config(
        "the bundled weights: 48 waypoints, 1.7 M parameters, clearances and their gradients as inputs",
        {
            "minutes": None,
            "samples": 2_400_000,
            "clearance_gradients": True,
            "condition_drop": 0.1,
            "losses": JOINT_POINT_COLLISION,
        },
    ),
    "paper": Config(
        "the paper's: 254 waypoints, 8 layers of width 512, T = 200, batch 64, 25,000 iterations",
        {
            "minutes": None,
            "samples": 64 * 25_000,
            "batch": 64,
            "learning_rate": 3e-4,
            "waypoints": 254,
            "turned_copies": 0,
            "target": "absolute",
            "smooth_noise": False,
            "progressive": True,
            "decay_share": 0.2,
            "average": 0.999,
            "schedule": ScheduleSettings(log_snr_shift=math.log(25)),
            "sampler": "ddpm",
            "sampling_steps": None,
            "validation_problems": 100,
            "denoiser_settings": TransformerSettings.paper_size(),
            **_TABLE2_ROW,
        },
    ),
    "points": Config(
        "no clearances: waypoints attend to 32 points of the obstacles, in place of one code",
        {
            **_TABLE2_ROW,
            "minutes": None,
            "samples": 2_400_000,
            "encoder": "points",
            "denoiser": "cross_attention",
            "turned_copies": 15,
        },
    ),
    "table2_pointnet": Config("encoder PointNet, trained jointly", {**_TABLE2_ROW, "encoder": "pointnet"}),
    "table2_dgcnn": Config("encoder DGCNN, trained jointly", {**_TABLE2_ROW, "encoder": "dgcnn"}),
    "table2_unet": Config("temporal U-Net", {**_TABLE2_ROW, "denoiser": "unet"}),
    "table2_transformer": Config(
        "encoder-decoder transformer", {**_TABLE2_ROW, "denoiser": "encoder_decoder"}
    ),
    "table2_decoder_only": Config("decoder-only transformer", {**_TABLE2_ROW, "denoiser": "decoder_only"}),
    "table2_noise": Config(
        "the noise is predicted instead of x_0", {**_TABLE2_ROW, "objective": "noise", "smooth_noise": False}
    ),
    "table2_joint": Config("L_joint alone", {**_TABLE2_ROW, "losses": JOINT}),
    "table2_joint_point": Config("L_joint and L_point", {**_TABLE2_ROW, "losses": JOINT_POINT}),
    "table2_jpc": Config("L_joint, L_point and L_collision", _TABLE2_ROW),
    "trajectory_prior": Config(
        "the prior of MPD and EDMP, without the scene as input: temporal U-Net, T = 255, noise predicted",
        {
            "minutes": 40.0,
            "learning_rate": 2e-3,
            "weight_decay": 0.0,
            "encoder": None,
            "denoiser": "unet",
            "denoiser_settings": UNetSettings(32, (1, 2, 4), 5, condition_width=64),
            "schedule": ScheduleSettings(steps=255),
            "sampler": "ddpm",
            "sampling_steps": 25,
            "target": "limits",
            "objective": "noise",
            "clearance_features": False,
            "smooth_noise": False,
            "weight_limit": None,
            "validation_problems": 24,
        },
    ),
}


def planner_training(name: str, given: dict[str, Any]) -> PlannerTraining:
    """The training settings of a config, with the given changes.

    Raises InputError for an unknown name, listing the known ones, and if neither config nor changes name an
    encoder.
    """
    if name not in CONFIGS:
        raise unknown_name("config", name, CONFIGS)
    changes = CONFIGS[name].changes | given
    if "encoder" not in changes:
        raise InputError(f"config {name} needs an encoder: name a folder with a trained one")
    if given.get("minutes") is not None:
        changes["samples"] = None
    elif given.get("samples") is not None:
        changes["minutes"] = None
    return PlannerTraining(**changes)
