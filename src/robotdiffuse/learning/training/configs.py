"""Named settings of planner training: the paper's, the compact ones that ship, the rows of its Table 2, and
the prior of MPD and EDMP (see `planning.baselines.guided_prior`).

The rows share everything but what they compare, and a size that a CPU can train. Unlike `paper` they diffuse
48 waypoints in patches of 4, as residuals to the straight line, with smooth noise: fewer samples teach more.
Only the row that predicts the noise has the paper's white noise: smooth noise has next to nothing of the high
frequencies, so the least error there, divided by the little signal of the last levels, is what is sampled.
Their networks see no clearances, as the paper's: these would make up for what an encoder loses.
"""

from typing import Any, NamedTuple

from robotdiffuse.core.errors import InputError, unknown_name
from robotdiffuse.learning.denoisers.transformer import TransformerSettings
from robotdiffuse.learning.denoisers.unet import UNetSettings
from robotdiffuse.learning.diffusion import ScheduleSettings
from robotdiffuse.learning.training.config import PlannerTraining
from robotdiffuse.learning.training.losses import LossSettings

JOINT = LossSettings()
JOINT_POINT = LossSettings(point=0.3, waypoints=4)
JOINT_POINT_COLLISION = LossSettings(point=0.3, collision=0.05, begin=0.3, waypoints=4)
"""The paper gives no weights; these make the three losses of one size when predictions are 5 cm off."""

_ROW = {"sees_clearances": False, "condition_drop": 0.1, "losses": JOINT_POINT_COLLISION}


class Config(NamedTuple):
    description: str
    changes: dict[str, Any]
    """To the fields of PlannerTraining."""


CONFIGS: dict[str, Config] = {
    "compact": Config(
        "what ships: 48 waypoints, 1.7 M parameters, sees clearances and their gradients",
        {
            "minutes": None,
            "samples": 2_400_000,
            "sees_gradients": True,
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
            "turns": 0,
            "target": "absolute",
            "smooth_noise": False,
            "sampler": "ddpm",
            "sampling_steps": None,
            "denoiser_settings": TransformerSettings.paper_size(),
            **_ROW,
        },
    ),
    "table2_pointnet": Config("encoder PointNet, trained along", {**_ROW, "encoder": "pointnet"}),
    "table2_dgcnn": Config("encoder DGCNN, trained along", {**_ROW, "encoder": "dgcnn"}),
    "table2_completing": Config(
        "encoder completing_autoencoder, frozen", {**_ROW, "encoder": "completing_autoencoder"}
    ),
    "table2_unet": Config("temporal U-Net", {**_ROW, "denoiser": "unet"}),
    "table2_transformer": Config("encoder-decoder transformer", {**_ROW, "denoiser": "encoder_decoder"}),
    "table2_decoder_only": Config("decoder-only transformer", {**_ROW, "denoiser": "decoder_only"}),
    "table2_noise": Config(
        "noise instead of x_0 is predicted", {**_ROW, "objective": "noise", "smooth_noise": False}
    ),
    "table2_joint": Config("L_joint alone", {**_ROW, "losses": JOINT}),
    "table2_joint_point": Config("L_joint and L_point", {**_ROW, "losses": JOINT_POINT}),
    "table2_jpc": Config("L_joint, L_point and L_collision", _ROW),
    "trajectory_prior": Config(
        "the prior of MPD and EDMP, which sees no scene: temporal U-Net, T = 255, noise predicted",
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
            "sees_clearances": False,
            "smooth_noise": False,
            "weight_limit": None,
            "validation_problems": 24,
        },
    ),
}


def planner_training(name: str, given: dict[str, Any]) -> PlannerTraining:
    """The settings of a config, and what is given beside it, which wins.

    Raises InputError for an unknown name, listing the known.
    """
    if name not in CONFIGS:
        raise unknown_name("config", name, CONFIGS)
    changes = CONFIGS[name].changes | given
    if "encoder" not in changes:
        raise InputError(f"config {name} needs an encoder: give a folder with a trained one")
    if given.get("minutes") is not None:
        changes["samples"] = None
    elif given.get("samples") is not None:
        changes["minutes"] = None
    return PlannerTraining(**changes)
