"""How trajectories are sampled from a trained model; without PyTorch, so that planners load quickly."""

from dataclasses import dataclass
from typing import Annotated

from robotdiffuse.core.settings import Count, OneOf, Settings, Share
from robotdiffuse.learning.samplers import SAMPLERS


@dataclass(frozen=True)
class SamplingSettings(Settings, name="sampling"):
    samples: Count = 16
    """Trajectories per batch."""
    sampling_steps: Count | None = None
    """Calls of the denoiser per batch; None: as many as the weights name."""
    sampler: Annotated[str, OneOf(SAMPLERS)] | None = None
    """Name in `learning.samplers.SAMPLERS`; None: the one that the weights name."""
    eta: Share = 0.0
    """Fresh noise per denoising step: 0 is DDIM, 1 is ancestral sampling."""
    guided_share: Share = 0.5
    """Share of the denoising steps that are guided, the last ones: 0 none, 1 all (the paper's)."""
    guidance_scale: float = 1.0
    """Scale of classifier-free guidance: 1 takes the network's prediction as it is, more follows the
    condition further, 0 hides the condition. Other than 1 needs weights that were trained with a
    condition_drop above 0."""
