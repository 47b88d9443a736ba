"""Compact stage 2: causal, with the scene in every layer, start and goal also as codes, and heads."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import cast

import torch
from torch import Tensor, nn

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.models.compact.heads import CollisionHead, ConnectivityHead, RefinementHead, scene_features
from cvqmpt_lab.models.compact.transformer import CompactLayer
from cvqmpt_lab.models.config import ModelConfig
from cvqmpt_lab.models.decoding.step_decoder import rows_per_scene
from cvqmpt_lab.models.dictionary.dictionary import Dictionary
from cvqmpt_lab.models.dictionary.gaussian_decoder import Gaussians
from cvqmpt_lab.models.point_cloud.clouds import require_point_cloud
from cvqmpt_lab.models.point_cloud.encoder import PointCloudEncoder, SceneTokens, TokenLevel
from cvqmpt_lab.models.published.attention import sinusoid_table


@dataclass(frozen=True, eq=False)
class CompactScene:
    """Encoded scenes."""

    tokens: SceneTokens
    keys_values: Tensor
    """(n_layers, s, 2, heads, m, d_k): keys and values in each layer."""


@dataclass(frozen=True, eq=False)
class SequenceOutput:
    """Predictions along known sequences."""

    logits: Tensor
    """(b, t + 1, n_classes), after the start token and after each of t codes."""
    states: Tensor
    """(b, t, d_model), at each code, for the refinement head."""


class CompactSequenceModel(nn.Module):
    """P(next code | scene, start, goal, codes so far), causal in the codes.

    Configurations are given as (..., configuration_dim): normalised joints in [0, 1], then features [m].
    Tokens are [start, goal, S, c_1, ..., c_t]; c_i has a learnt embedding plus a projection of the
    configuration at its Gaussian's mean (`set_code_configurations`).
    """

    code_configurations: Tensor
    positions: Tensor

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        self.config = config
        sizes, options = config.sequence.transformer, config.sequence
        d_model, n_codes = sizes.d_model, config.dictionary.n_codes
        fine_dim, coarse_dim = config.point_cloud.sa1.widths[1], config.point_cloud.sa2.widths[1]
        self.point_cloud_encoder = PointCloudEncoder(config.point_cloud)
        self.scene_projection = nn.Sequential(nn.Linear(coarse_dim + 3, d_model), nn.LayerNorm(d_model))
        self.configuration_embedding = nn.Sequential(
            nn.Linear(config.configuration_dim, sizes.d_inner), nn.ReLU(), nn.Linear(sizes.d_inner, d_model)
        )
        self.role_embedding = nn.Embedding(3, d_model)
        self.code_embedding = nn.Embedding(n_codes, d_model)
        self.code_projection = nn.Linear(config.configuration_dim, d_model, bias=False)
        for embedding in (self.role_embedding, self.code_embedding):
            nn.init.normal_(embedding.weight, std=0.1)
        self.register_buffer("code_configurations", torch.zeros(n_codes, config.configuration_dim))
        self.register_buffer("positions", sinusoid_table(options.max_length, d_model), persistent=False)
        self.layers = nn.ModuleList(CompactLayer(sizes) for _ in range(sizes.n_layers))
        self.norm = nn.LayerNorm(d_model)
        self.class_pred = nn.Linear(d_model, config.goal_class + 1)
        head_dim = fine_dim if options.head_level == "fine" else coarse_dim
        heads = (config.configuration_dim, head_dim, sizes)
        self.refinement = RefinementHead(d_model, config.joint_dim) if options.refinement else None
        self.collision = CollisionHead(*heads) if options.collision_head else None
        self.connectivity = ConnectivityHead(*heads) if options.connectivity_head else None

    def set_code_configurations(self, configurations: Tensor) -> None:
        """Tell the model where codes are: configurations (n_codes, configuration_dim) at their means.

        Raises
        ------
        InvalidInputError
            For another shape.
        """
        if configurations.shape != self.code_configurations.shape:
            raise InvalidInputError(
                f"configurations of codes are {tuple(configurations.shape)}, "
                f"expected {tuple(self.code_configurations.shape)}"
            )
        self.code_configurations.copy_(configurations)

    def encode_scene(self, clouds: Sequence[Tensor] | Tensor) -> CompactScene:
        """Encode clouds (n, 3) [m, robot base frame], equally many points each after thinning.

        Raises
        ------
        InvalidInputError
            For clouds that `require_point_cloud` refuses, or of unequal sizes.
        """
        most = self.config.point_cloud.max_points
        thinned = []
        for cloud in clouds:
            if most is not None and len(cloud) > most:
                cloud = cloud[torch.arange(most, device=cloud.device) * len(cloud) // most]
            thinned.append(cloud)
        sizes = sorted({len(cloud) for cloud in thinned})
        if len(sizes) != 1:
            raise InvalidInputError(f"clouds of {sizes} points in one batch; give them equally many")
        points = torch.stack(thinned)
        require_point_cloud(points)
        tokens = self.point_cloud_encoder(points)
        projected = self.scene_projection(scene_features(tokens.coarse))
        keys_values = [layer.scene_keys_values(projected) for layer in self.compact_layers()]
        return CompactScene(tokens, torch.stack(keys_values))

    def compact_layers(self) -> Iterator[CompactLayer]:
        """The transformer's layers."""
        return cast(Iterator[CompactLayer], iter(self.layers))

    def forward(
        self,
        scene: CompactScene,
        start: Tensor,
        goal: Tensor,
        codes: Tensor,
        start_goal_codes: Tensor | None = None,
    ) -> SequenceOutput:
        """Predict along known sequences (teacher forcing); padding at the end needs no mask here.

        Parameters
        ----------
        scene
            s scenes; b is a multiple of s, rows grouped by scene.
        start, goal
            (b, configuration_dim).
        codes
            (b, t) int64, t < max_length.
        start_goal_codes
            (b, 2) int64, codes of start and goal; needed when the option of that name is on.
        """
        prefix = self.prefix_tokens(start, goal, start_goal_codes)
        hidden = self.run(torch.cat((prefix, self.code_tokens(codes)), 1), scene)
        return SequenceOutput(self.classify(hidden[:, 2:]), hidden[:, 3:])

    def prefix_tokens(self, start: Tensor, goal: Tensor, start_goal_codes: Tensor | None) -> Tensor:
        """Tokens (b, 3, d_model) of start, goal and start token."""
        tokens = self.configuration_embedding(torch.stack((start, goal), 1))
        if self.config.sequence.start_goal_codes:
            if start_goal_codes is None:
                raise InvalidInputError("this model needs start_goal_codes; encode them with its dictionary")
            tokens = tokens + self.embed_codes(start_goal_codes)
        start_token = torch.zeros_like(tokens[:, :1])
        return torch.cat((tokens, start_token), 1) + self.role_embedding.weight

    def embed_codes(self, codes: Tensor) -> Tensor:
        """Tokens (..., d_model) of codes (...), wherever they stand."""
        return self.code_embedding(codes) + self.code_projection(self.code_configurations[codes])

    def code_tokens(self, codes: Tensor) -> Tensor:
        """Tokens (b, t, d_model) of codes (b, t)."""
        length, most = codes.shape[1], len(self.positions)
        if length > most:
            raise InvalidInputError(f"sequence of {length} codes; this model takes {most} at most")
        return self.embed_codes(codes) + self.positions[:length]

    def run(self, tokens: Tensor, scene: CompactScene) -> Tensor:
        """Send tokens (b, t, d_model) through the layers, rows grouped by scene."""
        times = rows_per_scene(len(tokens), len(scene.tokens.coarse.centres))
        for layer, of_scene in zip(self.layers, scene.keys_values, strict=True):
            tokens = layer(tokens, of_scene.repeat_interleave(times, 0))
        return tokens

    def classify(self, states: Tensor) -> Tensor:
        """Logits (..., n_classes) at states (..., d_model)."""
        return self.class_pred(self.norm(states))

    def query_tokens(self, dictionary: Dictionary, start: Tensor, goal: Tensor) -> Tensor:
        """Prefix tokens (q, 3, d_model) of starts and goals; their codes are the dictionary's."""
        codes = None
        if self.config.sequence.start_goal_codes:
            codes = dictionary.encode(torch.stack((start, goal), 1).flatten(0, 1)[:, None]).view(-1, 2)
        return self.prefix_tokens(start, goal, codes)

    def refine(self, states: Tensor, gaussians: Gaussians) -> Gaussians:
        """Gaussians (b, t) of steps from `SequenceOutput.states` and the Gaussians (b, t) of their codes."""
        if self.refinement is None:
            raise InvalidInputError("this model has no refinement head; set sequence.refinement")
        return self.refinement(states, gaussians.mean)

    def free_logits(self, scene: CompactScene, configurations: Tensor) -> Tensor:
        """Logits (s, c) of P(free) of configurations (s, c, configuration_dim)."""
        if self.collision is None:
            raise InvalidInputError("this model has no collision head; set sequence.collision_head")
        return self.collision(configurations, self._head_level(scene))

    def connected_logits(self, scene: CompactScene, first: Tensor, second: Tensor) -> Tensor:
        """Logits (s, c) of P(straight motion free) between configurations (s, c, configuration_dim)."""
        if self.connectivity is None:
            raise InvalidInputError("this model has no connectivity head; set sequence.connectivity_head")
        return self.connectivity(first, second, self._head_level(scene))

    def _head_level(self, scene: CompactScene) -> TokenLevel:
        return scene.tokens.fine if self.config.sequence.head_level == "fine" else scene.tokens.coarse
