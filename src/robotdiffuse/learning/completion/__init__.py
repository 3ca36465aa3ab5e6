"""The occupancy completion network, which predicts obstacles where no camera saw; trained on random
scenes."""

from functools import cache
from typing import TYPE_CHECKING

from jaxtyping import Float32
from numpy import ndarray

from robotdiffuse.learning.completion.samples import pack

if TYPE_CHECKING:
    from robotdiffuse.learning.completion.network import CompletionNetwork
    from robotdiffuse.perception.observed_volume import ObservedVolume


def predict(
    volume: "ObservedVolume", network: "CompletionNetwork | None" = None
) -> Float32[ndarray, "112 112 64"]:
    """The probability that each voxel of 2 cm holds an obstacle.

    It is 0 in voxels that were seen free, and farther than 1 m from a Panda's shoulder, which training did
    not cover. The grid begins at the volume's LOW. network: None for the one that comes with the package.
    Computed in bf16 on CPUs that multiply it fast.
    """
    import torch

    from robotdiffuse.learning.training.batches import fast_bf16

    network = bundled() if network is None else network
    seen, behind = (torch.from_numpy(array)[None] for array in pack(volume))
    with torch.inference_mode(), torch.autocast("cpu", torch.bfloat16, enabled=fast_bf16()):
        return network.probabilities(seen, behind)[0].numpy()


@cache
def bundled() -> "CompletionNetwork":
    """The network that comes with the package, loaded once."""
    from robotdiffuse.learning.checkpoint import load_completion

    return load_completion()
