"""The authors' sequence model (stage 2 of VQ-MPT): from scene, start and goal to codes.

PointNet++ set abstraction turns the point cloud into scene tokens E = e_1 ... e_n in two levels.
Each level takes farthest points as centres p_i. It summarises the ball around a centre by the
maximum of a perceptron of [x_j, p_j - p_i] over the points p_j of the ball, with features x_j.

Start and goal, embedded by a perceptron, attend to E and give the context M (two tokens). The
autoregressive transformer predicts the next code (paper, eqn. ar_prob),

    pi(h_j = i | z_(h_1) ... z_(h_(j-1)), M) = p_i,

where i is one of the N codes or the goal token.
"""

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor, nn

from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.vqmpt.beam_search import StepDecoder, log_softmax
from cvqmpt_lab.vqmpt.config import (
    LAYER_NORM_EPSILON,
    ModelConfig,
    PointCloudConfig,
    SetAbstractionConfig,
    TransformerConfig,
)
from cvqmpt_lab.vqmpt.dictionary import (
    Dictionary,
    FeedForward,
    MultiHeadAttention,
    Quantizer,
    SelfAttentionLayer,
)


class PointConvolution(nn.Module):
    """Perceptron of every edge and maximum over the edges of a centre: max_j h([x_j, p_j - p_i]).

    An edge joins a centre and a point of its ball. Each layer of h is linear, ReLU and batch norm
    in this order; its statistics are over edges.
    """

    def __init__(self, input_dim: int, widths: tuple[int, ...]) -> None:
        super().__init__()
        self.local_nn = nn.Sequential(
            *(
                nn.Sequential(nn.Linear(before, after), nn.ReLU(), nn.BatchNorm1d(after))
                for before, after in zip((input_dim + 3, *widths), widths, strict=False)
            )
        )

    def forward(self, edges: Tensor, centre: Tensor, n_centres: int) -> Tensor:
        """Reduce edges to centres.

        Args:
            edges: (e, d + 3), inputs of the perceptron.
            centre: (e,) int64, centre of each edge, ascending; every centre has an edge.
            n_centres: number of centres.

        Returns:
            (n_centres, widths[-1]).
        """
        messages = self.local_nn(edges)
        lengths = torch.bincount(centre, minlength=n_centres)
        # in float32 also where a GPU computes with half precision
        return torch.segment_reduce(messages.float(), "max", lengths=lengths, axis=0, unsafe=True)


class SetAbstraction(nn.Module):
    """One level of set abstraction."""

    def __init__(self, input_dim: int, config: SetAbstractionConfig) -> None:
        super().__init__()
        self.conv = PointConvolution(input_dim, config.widths)
        self.config = config

    def forward(self, features: Tensor, points: Tensor, chosen: Tensor) -> tuple[Tensor, Tensor]:
        """Abstract features at points to fewer centres.

        Args:
            features: (b, n, d).
            points: (b, n, 3) [m].
            chosen: (b, m) int64, indices of the points that become centres.

        Returns:
            Features (b, m, d') and centres (b, m, 3) [m].
        """
        centres = points.gather(1, chosen[..., None].expand(-1, -1, 3))
        batch, m = centres.shape[:2]
        point, centre = ball_query(points, centres, self.config.radius, self.config.max_neighbours)
        offsets = points.reshape(-1, 3)[point] - centres.reshape(-1, 3)[centre]
        edges = torch.cat((features.flatten(0, 1)[point], offsets), dim=-1)
        return self.conv(edges, centre, batch * m).unflatten(0, (batch, m)), centres


class PointCloudEncoder(nn.Module):
    """Two set abstractions of points in metres; no position encoding is added."""

    def __init__(self, config: PointCloudConfig) -> None:
        super().__init__()
        self.sa1_module = SetAbstraction(3, config.sa1)
        self.sa2_module = SetAbstraction(config.sa1.widths[-1], config.sa2)

    def forward(self, points: Tensor, order: Tensor | None = None) -> Tensor:
        """Return tokens (b, m, d) of clouds.

        Args:
            points: (b, n, 3) [m, robot base frame].
            order: (b, m') int64, indices of their farthest points, see `centre_count`; None: they
                are computed here, on the CPU.
        """
        count = centre_count(self.sa1_module.config, points.shape[1])
        if order is None:
            order = farthest_point_sampling(points, count)
        features, centres = self.sa1_module(points, points, order)
        # each point is the farthest from those before it, so the first centres are also the
        # farthest points of all centres
        first = torch.arange(centre_count(self.sa2_module.config, count), device=points.device)
        features, _ = self.sa2_module(features, centres, first.expand(len(points), -1))
        return features


def centre_count(config: SetAbstractionConfig, points: int) -> int:
    """Return the number of centres of a level with so many points."""
    return math.ceil(config.ratio * points)


def farthest_point_sampling(points: Tensor, count: int) -> Tensor:
    """Return indices (b, count) of points (b, n, 3), each the farthest from those before it.

    The first index is 0. Of equally far points the one with the lowest index is taken.
    """
    each = [farthest_points(cloud.detach().cpu().numpy(), count) for cloud in points]
    return torch.from_numpy(np.stack(each)).to(points.device)


def farthest_points(points: np.ndarray, count: int) -> np.ndarray:
    """Return indices (count,) of farthest points of a cloud (n, 3), 5 times as fast as torch."""
    axes = points.T.copy()
    indices = np.zeros(count, dtype=np.int64)
    nearest = np.full(len(points), np.inf, dtype=points.dtype)
    offsets, distance = np.empty_like(axes), np.empty_like(nearest)
    latest = 0
    for k in range(1, count):
        np.subtract(axes, axes[:, latest, None], out=offsets)
        np.multiply(offsets, offsets, out=offsets)
        np.add.reduce(offsets, axis=0, out=distance)
        np.minimum(nearest, distance, out=nearest)
        latest = int(nearest.argmax())
        indices[k] = latest
    return indices


def ball_query(
    points: Tensor,
    centres: Tensor,
    radius: float,
    max_neighbours: int,
    pairs_at_once: int = 1 << 17,
) -> tuple[Tensor, Tensor]:
    """Find the points in balls around centres; a centre that is a point is its own neighbour.

    Args:
        points: (b, n, 3) [m].
        centres: (b, m, 3) [m].
        radius: radius of the balls [m]; a point on the surface is not in the ball.
        max_neighbours: maximum number of points of a centre, lowest indices first.
        pairs_at_once: number of distances in memory on a CPU; half a megabyte fits its cache. A
            GPU computes all at once.

    Returns:
        Points (e,) and centres (e,) of the pairs, int64 indices into all clouds concatenated.
        Pairs are sorted by centre, then by point.
    """
    batch, n, m = len(points), points.shape[1], centres.shape[1]
    axes = points.mT.contiguous()
    near = torch.empty(batch, m, n, dtype=torch.bool, device=points.device)
    at_once = max(1, pairs_at_once // (batch * n)) if points.is_cpu else m
    for first in range(0, m, at_once):
        block = centres[:, first : first + at_once, :, None]
        squares = (axes[:, None, 0] - block[:, :, 0]).square_()
        for axis in (1, 2):
            squares += (axes[:, None, axis] - block[:, :, axis]).square_()
        torch.lt(squares, radius * radius, out=near[:, first : first + at_once])
    # numbers of the near pairs, row by row; on a CPU numpy is ten times as fast as torch
    flat = near.flatten()
    pairs = torch.from_numpy(np.flatnonzero(flat)) if flat.is_cpu else flat.nonzero()[:, 0]
    row, point = pairs // n, pairs % n
    sizes = torch.bincount(row, minlength=batch * m)
    rank = torch.arange(len(row), device=row.device) - (sizes.cumsum(0) - sizes)[row]
    kept = rank < max_neighbours
    row, point = row[kept], point[kept]
    return row // m * n + point, row


class CrossAttentionLayer(nn.Module):
    """Attention of queries to a context, not to each other, then a feed-forward block."""

    def __init__(self, sizes: TransformerConfig) -> None:
        super().__init__()
        self.enc_attn = MultiHeadAttention(sizes)
        self.pos_ffn = FeedForward(sizes.d_model, sizes.d_inner, sizes.dropout)

    def forward(self, query: Tensor, context: Tensor) -> Tensor:
        """Map query (b, t, d_model), given context (b, m, d_model), to the query's shape."""
        return self.pos_ffn(self.enc_attn(query, context))


class CrossAttentionContext(nn.Module):
    """Embedding of start and goal, which attend to the scene tokens, but not to each other."""

    def __init__(self, joint_dim: int, sizes: TransformerConfig) -> None:
        super().__init__()
        self.to_latent_embedding = nn.Sequential(
            nn.Linear(joint_dim, sizes.d_inner),
            nn.ReLU(),
            nn.Linear(sizes.d_inner, sizes.d_model),
            nn.Dropout(sizes.dropout),
            nn.LayerNorm(sizes.d_model),
        )
        self.layer_stack = nn.ModuleList(CrossAttentionLayer(sizes) for _ in range(sizes.n_layers))
        self.layer_norm = nn.LayerNorm(sizes.d_model, eps=LAYER_NORM_EPSILON)

    def forward(self, start_goal: Tensor, scene: Tensor) -> Tensor:
        """Compute the context M (b, t, d_model).

        Args:
            start_goal: (b, t, joint_dim), normalised joints.
            scene: (b, m, d_model), scene tokens.
        """
        tokens = self.to_latent_embedding(start_goal)
        for layer in self.layer_stack:
            tokens = layer(tokens, scene)
        return self.layer_norm(tokens)


class SceneContext(nn.Module):
    """Point cloud encoder and cross attention: the ``context_state`` of published checkpoints."""

    def __init__(
        self, joint_dim: int, point_cloud: PointCloudConfig, sizes: TransformerConfig
    ) -> None:
        super().__init__()
        self.env_encoder = PointCloudEncoder(point_cloud)
        self.context_encoder = CrossAttentionContext(joint_dim, sizes)


class AutoRegressiveModel(nn.Module):
    """Transformer without position encoding; all tokens attend to each other."""

    def __init__(self, n_classes: int, sizes: TransformerConfig) -> None:
        super().__init__()
        self.layer_stack = nn.ModuleList(SelfAttentionLayer(sizes) for _ in range(sizes.n_layers))
        self.layer_norm = nn.LayerNorm(sizes.d_model, eps=LAYER_NORM_EPSILON)
        self.class_pred = nn.Linear(sizes.d_model, n_classes)

    def forward(self, tokens: Tensor) -> Tensor:
        """Logits (b, n_classes) of the next class after tokens (b, t, d_model)."""
        *before, last = self.layer_stack
        for layer in before:
            tokens = layer(tokens)
        token = last(tokens, read=tokens[:, -1:])
        return self.class_pred(self.layer_norm(token[:, 0]))


class PublishedSequenceModel(nn.Module):
    """Context and autoregressive model.

    The input is [M_start, M_goal, S, c_1, ..., c_i] with a constant start token S. The attention is
    not causal: each prefix is a separate sample, and its last token gives the prediction. Codes
    are embedded by the dictionary's `Quantizer.lookup`, without gradient, and by a linear layer if
    the dictionary has another width.
    """

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        point_cloud, sequence = config.stage2
        self.context = SceneContext(config.joint_dim, point_cloud, sequence.context)
        self.autoregressive = AutoRegressiveModel(config.goal_class + 1, sequence.transformer)
        given, width = config.dictionary.transformer.d_model, sequence.transformer.d_model
        self.enter = nn.Identity() if given == width else nn.Linear(given, width)

    def encode_scene(
        self, clouds: Sequence[Tensor] | Tensor, order: Tensor | None = None
    ) -> Tensor:
        """Encode s clouds (n, 3) [m, robot base frame] to scene tokens (s, m, d_model).

        order: see `PointCloudEncoder.forward`.

        Raises:
            InvalidInputError: clouds have fewer than two points.
        """
        if len(clouds[0]) < 2:
            raise InvalidInputError(f"point cloud of {len(clouds[0])} points; give at least 2")
        return self.context.env_encoder(torch.stack(list(clouds)), order)

    @torch.inference_mode()
    def encode_cloud(self, points: np.ndarray) -> Tensor:
        """Encode one cloud (m, 3) float32 [m, robot base frame], for planning."""
        return self.encode_scene([torch.tensor(points)])

    def encode_context(self, scene: Tensor, start: Tensor, goal: Tensor) -> Tensor:
        """Compute the context M of starts and goals.

        Args:
            scene: (s, m, d_model), scene tokens.
            start: (b, joint_dim), normalised joints; b / s of each scene, in the scenes' order.
            goal: (b, joint_dim), likewise.

        Returns:
            (b, 2, d_model).
        """
        # starts and goals of a scene do not attend to each other, so they are one batch
        ends = torch.stack((start, goal), 1).view(len(scene), 2 * len(start) // len(scene), -1)
        return self.context.context_encoder(ends, scene).view(len(start), 2, -1)

    def prefix_logits(self, context: Tensor, codes: Tensor, quantizer: Quantizer) -> Tensor:
        """Logits of the next class after a prefix, of pi(h_j = i | h_1 ... h_(j-1), M).

        Args:
            context: (b, 2, d_model), M of `encode_context`.
            codes: (b, t) int64, h_1 ... h_t.
            quantizer: quantizer of the dictionary, which is not trained.

        Returns:
            (b, n_classes); the classes are the codes, the start token and the goal token.
        """
        with torch.no_grad():
            embedded = quantizer.lookup(codes)
        start_token = torch.full_like(context[:, :1], -1.0)
        tokens = torch.cat((context, start_token, self.enter(embedded)), dim=1)
        return self.autoregressive(tokens)

    @torch.inference_mode()
    def decoder(
        self,
        dictionary: Dictionary,
        scene: Tensor,
        start: np.ndarray | Tensor,
        goal: np.ndarray | Tensor,
    ) -> StepDecoder:
        """Return a `StepDecoder` for queries, which are grouped by scene.

        Args:
            dictionary: dictionary whose codes are predicted.
            scene: (s, m, d_model), scene tokens.
            start: (q, joint_dim), normalised joints; q / s of each scene, in the scenes' order.
            goal: (q, joint_dim), likewise.
        """
        context = self.encode_context(scene, torch.as_tensor(start), torch.as_tensor(goal))
        return _PrefixDecoder(self, dictionary.quantizer, context)


class _PrefixDecoder:
    """A `StepDecoder` that stores the prefixes and evaluates the model on each whole prefix."""

    def __init__(
        self, model: PublishedSequenceModel, quantizer: Quantizer, context: Tensor
    ) -> None:
        self._model, self._quantizer = model, quantizer
        self._context = context  # (rows, 2, d_model)
        self._codes = torch.zeros(len(context), 0, dtype=torch.int64, device=context.device)

    def start(self) -> tuple[np.ndarray, np.ndarray]:
        """Return classes and log-probabilities (queries, n_classes) of the first code."""
        classes, log_p = self._log_probabilities()
        log_p[:, -1] = -np.inf  # the goal token cannot come first
        return classes, log_p

    def advance(self, parents: np.ndarray, codes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Replace the prefixes by longer ones; see `StepDecoder.advance`."""
        rows, added = (
            torch.from_numpy(given).to(self._context.device) for given in (parents, codes)
        )
        self._context = self._context[rows]
        self._codes = torch.cat((self._codes[rows], added[:, None]), dim=1)
        return self._log_probabilities()

    @torch.inference_mode()
    def _log_probabilities(self) -> tuple[np.ndarray, np.ndarray]:
        logits = self._model.prefix_logits(self._context, self._codes, self._quantizer)
        log_p = log_softmax(logits.float().cpu().numpy())
        log_p[:, -2] = -np.inf  # the start token
        return np.broadcast_to(np.arange(log_p.shape[1]), log_p.shape), log_p
