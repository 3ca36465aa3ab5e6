"""The paper's compression auto-encoder (section Condition embedding); its encoder is PointEnet.

A perceptron on 1,400 points in a fixed order, 4200 -> 786 -> 512 -> 256 -> 60, and its mirror image. The
paper states neither the order nor the activation. Here the points are sorted along a space-filling curve, so
that a place in the order belongs to a small part of the surfaces. Sorted by x, then y, then z, its y and z
could be those of any obstacle. The activation is PReLU, as in MPNet (Qureshi et al. 2019), whose encoder has
the same form and loss.
"""

from collections.abc import Iterable
from itertools import pairwise

from jaxtyping import Float
from numpy.random import Generator
from torch import Tensor, nn

from robotdiffuse.learning.encoders.base import Autoencoder, fp32
from robotdiffuse.learning.encoders.settings import CompressionAutoencoderSettings


class CompressionAutoencoder(Autoencoder):
    """z = MLP(all points, concatenated)."""

    settings: CompressionAutoencoderSettings

    def __init__(self, settings: CompressionAutoencoderSettings) -> None:
        super().__init__(settings)
        sizes = (3 * settings.cloud, *settings.hidden, settings.code)
        self.encoder, self.decoder = _perceptron(sizes), _perceptron(sizes[::-1])

    def encode(self, cloud: Float[Tensor, "batch points 3"]) -> Float[Tensor, "batch code"]:
        with fp32(cloud):
            return self.encoder(self.arrange(cloud.float()).flatten(1))

    def code_of_ordered(self, cloud: Float[Tensor, "batch cloud 3"]) -> Float[Tensor, "batch code"]:
        return (self.encoder(cloud.flatten(1)) - self.mean) / self.scale

    def decode(self, code: Float[Tensor, "batch code"]) -> Float[Tensor, "batch cloud 3"]:
        """Reconstructed points [m], in the order of `arrange`, from z before standardisation."""
        with fp32(code):
            return self.decoder(code.float()).view(len(code), -1, 3)

    def loss(
        self, cloud: Float[Tensor, "batch points 3"], rng: Generator
    ) -> tuple[Float[Tensor, ""], dict[str, float]]:
        """The first term of l_AE: the mean over points of the squared distance to the reconstruction [m^2].

        The equation does not define K: it is taken as the number of points, and i-hat as the text's x-hat.
        The error `reconstruction` is the root of the loss [m].
        """
        with fp32(cloud):
            points = self.arrange(cloud.float())
            error = (self.decode(self.encoder(points.flatten(1))) - points).square().sum(-1).mean()
        return error, {"reconstruction": error.item() ** 0.5}

    def penalised(self) -> Iterable[Tensor]:
        """The encoder's weights.

        The equation has (theta^2_ij)^2, which literally is a sum of fourth powers. MPNet's equation has the
        square of theta^e_ij, the encoder's weights, in that place; this is taken to be meant.
        """
        return (layer.weight for layer in self.encoder if isinstance(layer, nn.Linear))


def _perceptron(sizes: tuple[int, ...]) -> nn.Sequential:
    parts = [part for a, b in pairwise(sizes) for part in (nn.Linear(a, b), nn.PReLU())]
    return nn.Sequential(*parts[:-1])
