"""The points themselves as the code of a scene, for the denoiser `cross_attention`, which attends to them."""

from jaxtyping import Float
from torch import Tensor

from robotdiffuse.learning.encoders.base import Encoder, fp32
from robotdiffuse.learning.encoders.settings import PointsSettings


class Points(Encoder):
    """z = the coordinates of all points [m]. It has no weights."""

    settings: PointsSettings

    def forward(self, cloud: Float[Tensor, "batch points 3"]) -> Float[Tensor, "batch code"]:
        with fp32(cloud):
            return self.code_of_ordered(self.arrange(cloud.float()))

    def code_of_ordered(self, cloud: Float[Tensor, "batch cloud 3"]) -> Float[Tensor, "batch code"]:
        return cloud.flatten(1)
