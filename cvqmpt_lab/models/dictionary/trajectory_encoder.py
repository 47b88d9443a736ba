"""Stage 1, first half: from waypoints to latent vectors, one per waypoint."""

from torch import Tensor, nn
from torch.nn import functional as F

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.models.config import EPSILON, TransformerConfig
from cvqmpt_lab.models.published.attention import SelfAttentionLayer, sinusoid_table


class PositionTable(nn.Module):
    """Fixed sinusoidal code of the position in a trajectory, kept as a buffer."""

    pos_table: Tensor

    def __init__(self, n_position: int, d_model: int) -> None:
        super().__init__()
        self.register_buffer("pos_table", sinusoid_table(n_position, d_model)[None])

    def forward(self, tokens: Tensor) -> Tensor:
        """Add the code to tokens (b, t, d_model).

        Raises
        ------
        InvalidInputError
            When the trajectory is longer than the table.
        """
        length, longest = tokens.shape[1], self.pos_table.shape[1]
        if length > longest:
            raise InvalidInputError(f"trajectory of {length} waypoints; this encoder takes {longest} at most")
        return tokens + self.pos_table[:, :length]


class TrajectoryEncoder(nn.Module):
    """Transformer over a whole trajectory (paper, section on VQ-MPT; sizes of the published code).

    One layer norm serves three times: after the embedding, after the position code and at the end.
    Padded waypoints are attended to, as in the published code; only the losses mask them.
    """

    def __init__(self, input_dim: int, n_position: int, sizes: TransformerConfig) -> None:
        super().__init__()
        self.to_embedding = nn.Sequential(
            nn.Linear(input_dim, sizes.d_model), nn.ReLU(), nn.Linear(sizes.d_model, sizes.d_model)
        )
        self.position_enc = PositionTable(n_position, sizes.d_model)
        self.layer_stack = nn.ModuleList(SelfAttentionLayer(sizes) for _ in range(sizes.n_layers))
        self.layer_norm = nn.LayerNorm(sizes.d_model, eps=EPSILON)
        self.dropout = sizes.dropout

    def forward(self, waypoints: Tensor) -> Tensor:
        """Encode waypoints (b, t, input_dim), joints normalised to [0, 1], as latents (b, t, d_model)."""
        tokens = self.position_enc(self.layer_norm(self.to_embedding(waypoints)))
        tokens = self.layer_norm(F.dropout(tokens, self.dropout, self.training))
        for layer in self.layer_stack:
            tokens = layer(tokens)
        return self.layer_norm(tokens)


class WaypointEncoder(nn.Module):
    """Perceptron on each waypoint alone: the code of a configuration does not depend on its path."""

    def __init__(self, input_dim: int, sizes: TransformerConfig) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.Linear(input_dim, sizes.d_inner),
            nn.ReLU(),
            nn.Linear(sizes.d_inner, sizes.d_inner),
            nn.ReLU(),
            nn.Linear(sizes.d_inner, sizes.d_model),
            nn.LayerNorm(sizes.d_model, eps=EPSILON),
        )

    def forward(self, waypoints: Tensor) -> Tensor:
        """Encode waypoints (..., input_dim) as latents (..., d_model)."""
        return self.layers(waypoints)
