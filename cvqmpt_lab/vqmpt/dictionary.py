"""Stage 1 of VQ-MPT: the dictionary Z_Q = {z_1 ... z_N}, which divides the planning space.

A waypoint is encoded to a latent, the latent is replaced by the nearest code z_i, and the code is
decoded to a Gaussian over configurations, g(z_i) = N(mu, Sigma) (paper, eqn. decoder_eqn), with
Sigma = L D L^T.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.vqmpt.config import LAYER_NORM_EPSILON, ModelConfig, SerialChain, TransformerConfig


class MultiHeadAttention(nn.Module):
    """x + W_o [softmax(q_h k_h^T / sqrt(d_k)) v_h]_h, with q, k, v projected without bias.

    q is computed from the query x, k and v from the context, all after the same layer norm.
    """

    def __init__(self, sizes: TransformerConfig) -> None:
        super().__init__()
        self.n_heads = sizes.n_heads
        self.w_qs = nn.Linear(sizes.d_model, sizes.n_heads * sizes.d_k, bias=False)
        self.w_ks = nn.Linear(sizes.d_model, sizes.n_heads * sizes.d_k, bias=False)
        self.w_vs = nn.Linear(sizes.d_model, sizes.n_heads * sizes.d_v, bias=False)
        self.fc = nn.Linear(sizes.n_heads * sizes.d_v, sizes.d_model, bias=False)
        self.layer_norm = nn.LayerNorm(sizes.d_model, eps=LAYER_NORM_EPSILON)
        self.dropout = sizes.dropout

    def forward(self, query: Tensor, context: Tensor) -> Tensor:
        """Attend from a query to a context, both before normalisation.

        Args:
            query: (b, t, d_model).
            context: (b, m, d_model); the query itself in self-attention.

        Returns:
            (b, t, d_model).
        """
        context_tokens = self.layer_norm(context)
        query_tokens = context_tokens if query is context else self.layer_norm(query)
        q, k, v = (
            projection(tokens).unflatten(-1, (self.n_heads, -1)).transpose(1, 2)
            for projection, tokens in (
                (self.w_qs, query_tokens),
                (self.w_ks, context_tokens),
                (self.w_vs, context_tokens),
            )
        )
        dropout = self.dropout if self.training else 0.0
        heads = F.scaled_dot_product_attention(q, k, v, dropout_p=dropout)
        heads = heads.transpose(1, 2).flatten(2)
        return query + F.dropout(self.fc(heads), self.dropout, self.training)


class FeedForward(nn.Module):
    """x + W_2 relu(W_1 norm(x)) if `norm_first`, else norm(x + W_2 relu(W_1 x))."""

    def __init__(
        self, d_model: int, d_inner: int, dropout: float, *, norm_first: bool = True
    ) -> None:
        super().__init__()
        self.w_1 = nn.Linear(d_model, d_inner)
        self.w_2 = nn.Linear(d_inner, d_model)
        self.layer_norm = nn.LayerNorm(d_model, eps=LAYER_NORM_EPSILON)
        self.dropout = dropout
        self.norm_first = norm_first

    def forward(self, x: Tensor) -> Tensor:
        """Map (..., d_model) to the same shape."""
        inner = self.w_1(self.layer_norm(x) if self.norm_first else x).relu()
        y = x + F.dropout(self.w_2(inner), self.dropout, self.training)
        return y if self.norm_first else self.layer_norm(y)


class SelfAttentionLayer(nn.Module):
    """Self-attention of tokens, then a feed-forward block."""

    def __init__(self, sizes: TransformerConfig) -> None:
        super().__init__()
        self.slf_attn = MultiHeadAttention(sizes)
        self.pos_ffn = FeedForward(sizes.d_model, sizes.d_inner, sizes.dropout)

    def forward(self, tokens: Tensor, read: Tensor | None = None) -> Tensor:
        """Map tokens (b, t, d_model) to the same shape.

        Args:
            tokens: (b, t, d_model).
            read: (b, r, d_model), the tokens whose outputs are computed; None for all.
        """
        return self.pos_ffn(self.slf_attn(tokens if read is None else read, tokens))


class PositionTable(nn.Module):
    """Fixed encoding of position p: column 2 i has sin(p 10000^(-2 i / d)), column 2 i + 1 cos."""

    pos_table: Tensor

    def __init__(self, n_position: int, d_model: int) -> None:
        super().__init__()
        dimension = torch.arange(d_model, dtype=torch.float64)
        wavelength = 10000.0 ** (2.0 * (dimension // 2) / d_model)
        angle = torch.arange(n_position, dtype=torch.float64)[:, None] / wavelength
        table = torch.where(dimension % 2 == 0, angle.sin(), angle.cos())
        self.register_buffer("pos_table", table.float()[None])

    def forward(self, tokens: Tensor) -> Tensor:
        """Add position encodings to tokens (b, t, d_model); InvalidInputError if t is too large."""
        length, longest = tokens.shape[1], self.pos_table.shape[1]
        if length > longest:
            raise InvalidInputError(
                f"trajectory of {length} waypoints; this encoder takes {longest} at most"
            )
        return tokens + self.pos_table[:, :length]


class TrajectoryEncoder(nn.Module):
    """Transformer over a whole trajectory, as published.

    The same layer norm is applied three times: after the embedding, after the position encoding
    and at the end. As in the published code padding is attended to; only the losses mask it.
    """

    def __init__(self, input_dim: int, n_position: int, sizes: TransformerConfig) -> None:
        super().__init__()
        self.to_embedding = nn.Sequential(
            nn.Linear(input_dim, sizes.d_model), nn.ReLU(), nn.Linear(sizes.d_model, sizes.d_model)
        )
        self.position_enc = PositionTable(n_position, sizes.d_model)
        self.layer_stack = nn.ModuleList(SelfAttentionLayer(sizes) for _ in range(sizes.n_layers))
        self.layer_norm = nn.LayerNorm(sizes.d_model, eps=LAYER_NORM_EPSILON)
        self.dropout = sizes.dropout

    def forward(self, waypoints: Tensor) -> Tensor:
        """Encode waypoints (b, t, input_dim), joints in [0, 1], as latents (b, t, d_model)."""
        tokens = self.position_enc(self.layer_norm(self.to_embedding(waypoints)))
        tokens = self.layer_norm(F.dropout(tokens, self.dropout, self.training))
        for layer in self.layer_stack:
            tokens = layer(tokens)
        return self.layer_norm(tokens)


class WaypointEncoder(nn.Module):
    """Perceptron on each waypoint: the code of a configuration does not depend on its path."""

    def __init__(self, input_dim: int, sizes: TransformerConfig) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.Linear(input_dim, sizes.d_inner),
            nn.ReLU(),
            nn.Linear(sizes.d_inner, sizes.d_inner),
            nn.ReLU(),
            nn.Linear(sizes.d_inner, sizes.d_model),
            nn.LayerNorm(sizes.d_model, eps=LAYER_NORM_EPSILON),
        )

    def forward(self, waypoints: Tensor) -> Tensor:
        """Encode waypoints (..., input_dim) as latents (..., d_model)."""
        return self.layers(waypoints)


@dataclass(frozen=True, eq=False)
class Quantized:
    """Latents before and after quantization."""

    latent: Tensor  # (..., d_model)
    quantized: Tensor  # (..., d_model), latent of the nearest code
    codes: Tensor  # (...) int64, index of the nearest code


class Quantizer(nn.Module):
    """Vector quantisation: z = W_in x / |W_in x|, i = argmax_j z_j . z, result W_out z_i.

    Codes z_j have unit length: every forward call scales them in place. Call `normalise_codes`
    after the last optimizer step, before saving. The batch norm is never applied; it exists because
    published checkpoints have its buffers.
    """

    def __init__(self, n_codes: int, code_dim: int, d_model: int) -> None:
        super().__init__()
        self.input_linear_map = nn.Linear(d_model, code_dim)
        self.output_linear_map = nn.Linear(code_dim, d_model)
        # filled below: torch.randn on device "meta" would import sympy, which takes 4 s
        weight = torch.empty(n_codes, code_dim)
        self.embedding = nn.Embedding(n_codes, code_dim, _weight=weight)
        nn.init.xavier_uniform_(self.embedding.weight)
        self.batch_norm = nn.BatchNorm1d(code_dim, affine=False)
        self.normalise_codes()

    @torch.no_grad()
    def normalise_codes(self) -> None:
        """Scale every code to unit length, in place."""
        if not self.embedding.weight.is_meta:  # on device "meta" a norm would import sympy
            self.embedding.weight.copy_(F.normalize(self.embedding.weight, dim=1))

    def project(self, latent: Tensor) -> Tensor:
        """Project latents (..., d_model) to unit vectors z (..., code_dim)."""
        return F.normalize(self.input_linear_map(latent), dim=-1)

    def nearest(self, z: Tensor) -> Tensor:
        """Index (...) of the code with the largest cosine to each unit vector z (..., code_dim)."""
        with torch.no_grad():
            return (z @ self.embedding.weight.T).argmax(dim=-1)

    def forward(self, latent: Tensor) -> Quantized:
        """Quantise latents (..., d_model), with the straight-through estimator z + e - sg(z).

        Its value is the code e; its gradient reaches both the encoder (through z) and the code.
        """
        self.normalise_codes()
        z = self.project(latent)
        codes = self.nearest(z)
        # the code is not detached: codes are trained by gradient, without moving averages
        through = z + self.embedding(codes) - z.detach()
        return Quantized(latent, self.output_linear_map(through), codes)

    def lookup(self, codes: Tensor) -> Tensor:
        """Latents (..., d_model) of codes (...), the input of the decoder."""
        return self.output_linear_map(self.embedding(codes))

    def restart_codes(self, dead: Tensor, latents: Tensor) -> None:
        """Replace codes by encoded waypoints that are drawn at random.

        Args:
            dead: (n_codes,) bool, the codes to replace: not used by recent waypoints, or all.
            latents: (m, d_model), encoded waypoints; each is drawn at most once if there are
                enough.

        Raises:
            InvalidInputError: there are no latents.
        """
        indices = dead.nonzero()[:, 0]
        if len(indices) == 0:
            return
        if len(latents) == 0:
            raise InvalidInputError(
                "restart of codes from 0 latents; give at least one encoded waypoint"
            )
        # with fewer latents than codes, latents repeat
        order = torch.randperm(len(latents))
        chosen = order[torch.arange(len(indices)) % len(latents)].to(latents.device)
        with torch.no_grad():
            self.embedding.weight[indices] = self.project(latents[chosen])


@dataclass(frozen=True, eq=False)
class Gaussians:
    """A batch of Gaussians with covariance L D L^T (published code; the paper prints L D^2 L^T)."""

    mean: Tensor  # (..., n), mu, of normalised joints
    lower: Tensor  # (..., n, n), L, with ones on the diagonal
    diagonal: Tensor  # (..., n), D, positive

    @property
    def covariance(self) -> Tensor:
        """Sigma = L D L^T (..., n, n)."""
        return (self.lower * self.diagonal[..., None, :]) @ self.lower.mT

    def log_prob(self, u: Tensor) -> Tensor:
        """Log density -1/2 (|D^(-1/2) L^(-1) (u - mu)|^2 + sum log D + n log 2 pi) (...) [nats].

        Args:
            u: (..., n), normalised joints.
        """
        offset = (u - self.mean)[..., None]
        lower = self.lower.expand(*offset.shape[:-2], *self.lower.shape[-2:])
        # L is unit triangular: its determinant is 1, and L^(-1) needs no inverse
        whitened = torch.linalg.solve_triangular(lower, offset, upper=False, unitriangular=True)
        mahalanobis = (whitened[..., 0].square() / self.diagonal).sum(-1)
        n = self.mean.shape[-1]
        return -0.5 * (mahalanobis + self.diagonal.log().sum(-1) + n * math.log(2.0 * math.pi))

    def entropy(self) -> Tensor:
        """Differential entropy 1/2 (sum log D + n (1 + log 2 pi)) (...) [nats]."""
        n = self.mean.shape[-1]
        return 0.5 * (self.diagonal.log().sum(-1) + n * (1.0 + math.log(2.0 * math.pi)))


class GaussianDecoder(nn.Module):
    """The decoder g(z) = N(mu, L D L^T).

    mu = (tanh(W_mu y + b_mu) + 1) / 2, D = softplus(W_D y + b_D), L = I + lower(W_L y + b_L), where
    y is the output of a feed-forward block with layer norm.
    """

    l_index: Tensor

    def __init__(self, d_model: int, d_inner: int, joint_dim: int, dropout: float) -> None:
        super().__init__()
        self.pos_ffn = FeedForward(d_model, d_inner, dropout, norm_first=False)
        self.mu = nn.Sequential(nn.Linear(d_model, joint_dim), nn.Tanh())
        self.diag = nn.Sequential(nn.Linear(d_model, joint_dim))
        self.l = nn.Sequential(nn.Linear(d_model, joint_dim * (joint_dim - 1) // 2))
        self.register_buffer(
            "l_index", torch.tril_indices(joint_dim, joint_dim, offset=-1, device="cpu")
        )

    def forward(self, latent: Tensor) -> Gaussians:
        """Decode latents (..., d_model) to Gaussians (...)."""
        hidden = self.pos_ffn(latent)
        mean = 0.5 * (self.mu(hidden) + 1.0)
        n = mean.shape[-1]
        identity = torch.eye(n, dtype=mean.dtype, device=mean.device).expand(*mean.shape, n)
        lower = identity.flatten(-2).index_copy(
            -1, self.l_index[0] * n + self.l_index[1], self.l(hidden)
        )
        return Gaussians(mean, lower.unflatten(-1, (n, n)), F.softplus(self.diag(hidden)))


class Dictionary(nn.Module):
    """Encoder, quantizer and decoder; planning uses quantizer and decoder."""

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        options = config.dictionary
        sizes = options.transformer
        self.encoder: nn.Module
        if options.encoder == "transformer":
            self.encoder = TrajectoryEncoder(config.configuration_dim, options.n_position, sizes)
        else:
            self.encoder = WaypointEncoder(config.configuration_dim, sizes)
        self.quantizer = Quantizer(options.n_codes, options.code_dim, sizes.d_model)
        self.decoder = GaussianDecoder(
            sizes.d_model, sizes.d_inner, config.joint_dim, options.decoder_dropout
        )

    def forward(self, waypoints: Tensor) -> tuple[Gaussians, Quantized]:
        """Encode, quantise and decode waypoints, padding included; the losses must mask it.

        Args:
            waypoints: (b, t, configuration_dim), joints in [0, 1], then link positions [m] if any.
        """
        quantized = self.quantizer(self.encoder(waypoints))
        return self.decoder(quantized.quantized), quantized

    def encode(self, waypoints: Tensor) -> Tensor:
        """Return codes (b, t) int64 of waypoints (b, t, configuration_dim)."""
        return self.quantizer.nearest(self.quantizer.project(self.encoder(waypoints)))

    def decode(self, z: Tensor) -> Gaussians:
        """Decode any latent vectors z (..., code_dim), not only dictionary codes."""
        return self.decoder(self.quantizer.output_linear_map(z))


class LinkPositions:
    """Inputs of a model for configurations: normalised joints u, and positions of link points.

    u = (q - q_min) / (q_max - q_min).
    """

    def __init__(
        self,
        lower: tuple[float, ...],
        upper: tuple[float, ...],
        chain: SerialChain | None,
        device: torch.device | str = "cpu",
    ) -> None:
        """Prepare the inputs of one robot.

        Args:
            lower: (n,) joint limits [rad or m].
            upper: (n,) joint limits [rad or m].
            chain: kinematics and the k link points; None if joints are the only inputs.
            device: device of the tensors.
        """
        self._lower = torch.tensor(lower, dtype=torch.float32, device=device)
        self._range = torch.tensor(upper, dtype=torch.float32, device=device) - self._lower
        self._chain = chain
        if chain is not None:
            self._rotation = torch.tensor(chain.rotation, dtype=torch.float32, device=device)
            self._translation = torch.tensor(chain.translation, dtype=torch.float32, device=device)
            self._offsets = torch.tensor(chain.offsets, dtype=torch.float32, device=device)

    def configurations(self, u: Tensor) -> Tensor:
        """Inputs (..., n + 3 k) of normalised joints u (..., n); differentiable."""
        if self._chain is None:
            return u
        return torch.cat((u, self.positions(self._lower + u * self._range)), dim=-1)

    def positions(self, q: Tensor) -> Tensor:
        """Positions (..., 3 k) [m, robot base frame] of joints q (..., n) [rad or m]."""
        if self._chain is None:
            raise InvalidInputError("link positions need the dataset's kinematics; it has none")
        flat = q.reshape(-1, q.shape[-1])
        cosine, sine = flat.cos(), flat.sin()
        # axes (b, 3) and origin (b, 3) of the current joint frame
        x, y, z = (self._rotation[0, :, axis].expand(len(flat), 3) for axis in range(3))
        origin = self._translation[0].expand(len(flat), 3)
        positions: dict[int, Tensor] = {}
        last = max(self._chain.points)
        for joint in range(last + 1):
            if joint:
                step, shift = self._rotation[joint], self._translation[joint]
                origin = origin + x * shift[0] + y * shift[1] + z * shift[2]
                x, y, z = (x * step[0, i] + y * step[1, i] + z * step[2, i] for i in range(3))
            if joint in self._chain.sliders:
                origin = origin + z * flat[:, joint, None]
            else:
                c, s = cosine[:, joint, None], sine[:, joint, None]
                x, y = x * c + y * s, y * c - x * s
            for point, frame in enumerate(self._chain.points):
                if frame == joint:
                    offset = self._offsets[point]
                    positions[point] = origin + x * offset[0] + y * offset[1] + z * offset[2]
        stacked = torch.cat([positions[point] for point in range(len(positions))], dim=-1)
        return stacked.reshape(*q.shape[:-1], -1)
