"""Stage 1 as a whole: waypoint -> latent -> code -> Gaussian."""

from dataclasses import dataclass

from torch import Tensor, nn

from cvqmpt_lab.models.config import ModelConfig
from cvqmpt_lab.models.dictionary.gaussian_decoder import GaussianDecoder, Gaussians
from cvqmpt_lab.models.dictionary.quantizer import Quantized, Quantizer
from cvqmpt_lab.models.dictionary.trajectory_encoder import TrajectoryEncoder, WaypointEncoder


@dataclass(frozen=True, eq=False)
class DictionaryOutput:
    """The Gaussian of every waypoint and the quantization it came from."""

    gaussians: Gaussians
    quantized: Quantized


class Dictionary(nn.Module):
    """Encoder, quantizer and decoder; the last two are what planning uses."""

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        sizes, options = config.dictionary.transformer, config.dictionary
        self.encoder: nn.Module
        if options.encoder == "transformer":
            self.encoder = TrajectoryEncoder(config.configuration_dim, options.n_position, sizes)
        else:
            self.encoder = WaypointEncoder(config.configuration_dim, sizes)
        self.quantizer = Quantizer(options.n_codes, options.code_dim, sizes.d_model)
        self.decoder = GaussianDecoder(
            sizes.d_model, sizes.d_inner, config.joint_dim, options.decoder_dropout
        )

    def forward(self, waypoints: Tensor) -> DictionaryOutput:
        """Encode and decode trajectories.

        Parameters
        ----------
        waypoints
            (b, t, configuration_dim): normalised joints in [0, 1], then features [m], if any. Padded
            waypoints are treated like any other; mask them in the losses.
        """
        quantized = self.quantizer(self.encoder(waypoints))
        return DictionaryOutput(self.decoder(quantized.quantized), quantized)

    def encode(self, waypoints: Tensor) -> Tensor:
        """Codes (b, t) int64 of waypoints (b, t, configuration_dim)."""
        return self.quantizer.nearest(self.quantizer.project(self.encoder(waypoints)))

    def decode(self, z: Tensor) -> Gaussians:
        """Gaussians (...) of code vectors z (..., code_dim), which need not be in the dictionary.

        Differentiable in z; what the latent optimizer moves (paper, algorithm 2).
        """
        return self.decoder(self.quantizer.output_linear_map(z))

    def code_gaussians(self, codes: Tensor | None = None) -> Gaussians:
        """Gaussians of codes (...), or of the whole dictionary (n_codes,)."""
        vectors = self.quantizer.embedding.weight
        return self.decode(vectors if codes is None else vectors[codes])
