"""The shipped sequence model: a causal transformer over codes with embeddings of the scene.

A point cloud is encoded to scene tokens with centres c_j. Start q_s, goal q_g and the node q_i of
every code attend to the tokens near the arm's body points p_k(q) (geometric attention),

    w_kj = softmax_j(beta_k (2 p_k . c_j - |c_j|^2) + b_k(token_j)),     sum_j w_kj (v_j + V_j p_k).

The embeddings e_i give P(code free) and P(edge free) of the dictionary's roadmap, and the cost to
go V_i: the cost of the shortest path to the goal, where an edge costs length - w log P(edge free).
A causal transformer over goal, start and the previous codes gives (paper, eqn. ar_prob)

    pi(h_j = i | z_(h_1) ... z_(h_(j-1)), M) = softmax_i(t_j . k(e_i) - g_j A_i + b_i),
    A_i = cost(h_(j-1), i) + V_i - V_(h_(j-1)) >= 0.

It is a pointer network: t_j points to the embeddings of the codes. The bonus b_i is learned; for
codes i that no edge leads to, both b_i and A_i are 0. The class N is the goal token.
"""

from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from cvqmpt_lab.vqmpt.config import SceneTransformerConfig
from cvqmpt_lab.vqmpt.dictionary import LinkPositions
from cvqmpt_lab.vqmpt.transformer_inputs import Ends, arcs_of


class Scenes(NamedTuple):
    """Encoding of s scenes, which does not depend on start and goal."""

    tokens: Tensor  # (s, t, d)
    centres: Tensor  # (s, t, 3) [m]
    codes: Tensor  # (s, N, d), embeddings of the codes
    keys: Tensor  # (s, N, d), keys of the codes, for pointers
    parts: Tensor  # (s, N, e), inputs of P(edge free) at the edge's ends
    node_odds: Tensor  # (s, N), log odds of P(code free)
    edge_odds: Tensor  # (s, E), log odds of P(edge free)


class Graph(NamedTuple):
    """Tables of the roadmap."""

    positions: Tensor  # (N, k, 3) [m], body points of the nodes
    features: Tensor  # (N, f), inputs of the nodes
    neighbour: Tensor  # (N, w) int64, neighbours of each node, padded with the node itself
    edge: Tensor  # (N, w) int64, the edge to each neighbour
    padding: Tensor  # (N, w), inf for padding, else 0
    length: Tensor  # (E,) [rad], length of each edge


class Block(nn.Module):
    """x <- x + attention(norm(x)), to a context if given, then x <- x + W_2 gelu(W_1 norm(x))."""

    def __init__(self, width: int, heads: int, inner: int) -> None:
        super().__init__()
        self.heads = heads
        self.norm, self.context_norm, self.inner_norm = (nn.LayerNorm(width) for _ in range(3))
        self.query, self.key_value = nn.Linear(width, width), nn.Linear(width, 2 * width)
        self.out = nn.Linear(width, width)
        self.first, self.second = nn.Linear(width, inner), nn.Linear(inner, width)

    def forward(self, x: Tensor, context: Tensor | None = None, causal: bool = False) -> Tensor:
        """Map tokens x (b, t, d) to the same shape.

        Args:
            x: (b, t, d).
            context: (b, m, d), tokens that are attended to; None for x itself.
            causal: tokens attend only to themselves and to earlier ones.
        """
        y = self.norm(x)
        attended = y if context is None else self.context_norm(context)
        q = self.query(y).unflatten(-1, (self.heads, -1)).transpose(1, 2)
        k, v = self.key_value(attended).unflatten(-1, (2, self.heads, -1)).permute(2, 0, 3, 1, 4)
        if causal:  # with about ten tokens, plain products are faster than torch's fused kernel
            scores = q @ k.transpose(2, 3) * q.shape[-1] ** -0.5
            mask = torch.ones(q.shape[2], q.shape[2], dtype=torch.bool, device=x.device).triu(1)
            heads = scores.masked_fill(mask, -torch.inf).softmax(-1) @ v
        else:
            heads = F.scaled_dot_product_attention(q, k, v)
        x = x + self.out(heads.transpose(1, 2).flatten(2))
        return x + self.second(F.gelu(self.first(self.inner_norm(x)), approximate="tanh"))


class SceneEncoder(nn.Module):
    """Set abstraction of groups of points to scene tokens, then self-attention of the tokens."""

    waves: Tensor

    def __init__(self, width: int) -> None:
        super().__init__()
        self.points = nn.Sequential(
            nn.Linear(3, 64), nn.ReLU(), nn.Linear(64, 64), nn.ReLU(), nn.Linear(64, 128)
        )
        waves = SceneTransformerConfig.position_waves
        self.join = nn.Linear(128 + 3 + 6 * waves, width)
        self.block, self.norm = Block(width, 8, 4 * width), nn.LayerNorm(width)
        self.register_buffer("waves", torch.pi * 2.0 ** torch.arange(waves), persistent=False)

    def forward(self, centres: Tensor, offsets: Tensor) -> Tensor:
        """Encode groups of points to tokens (s, t, d).

        Args:
            centres: (s, t, 3) [m].
            offsets: (s, t, m, 3) [m], the points around each centre, relative to it.
        """
        shape = self.points(offsets * 5.0).amax(2)
        angle = (centres[..., None] * self.waves).flatten(2)
        x = self.join(torch.cat((shape, centres, angle.sin(), angle.cos()), -1))
        return self.norm(self.block(x))


class GeometricAttention(nn.Module):
    """Embedding of configurations by attention to tokens near body points; see the module."""

    def __init__(self, config: SceneTransformerConfig) -> None:
        super().__init__()
        points, width, values = len(config.body.points), config.sizes.width, config.sizes.values
        self.values = values
        self.embed = nn.Sequential(
            nn.Linear(config.features, 2 * width),
            nn.GELU(approximate="tanh"),
            nn.Linear(2 * width, width),
        )
        self.own_norm, self.norm = nn.LayerNorm(width), nn.LayerNorm(width)
        self.value, self.bias = nn.Linear(width, 4 * values), nn.Linear(width, points)
        self.sharpness = nn.Parameter(torch.full((points,), 60.0).log())  # initial beta [1 / m^2]
        self.mix = nn.Sequential(
            nn.Linear(points * (values + 1) + width, 2 * width),
            nn.GELU(approximate="tanh"),
            nn.Linear(2 * width, width),
        )

    def forward(
        self,
        features: Tensor,
        positions: Tensor,
        tokens: Tensor,
        centres: Tensor,
        own: Tensor | None = None,
    ) -> Tensor:
        """Embed configurations in scenes.

        Args:
            features: (s or 1, u, f).
            positions: (s or 1, u, k, 3) [m], body points p_k.
            tokens: (s, t, d).
            centres: (s, t, 3) [m], c_j.
            own: (u, d), learned addition to the embeddings of codes; None for other configurations.

        Returns:
            (s, u, d).
        """
        s, u, m = len(tokens), features.shape[1], self.values
        x = self.embed(features)
        if own is not None:
            x = x + own
        # half precision has too few digits for squared distances in metres
        with torch.autocast(tokens.device.type, enabled=False):
            tokens = tokens.float()
            squared = (centres**2).sum(-1, keepdim=True)
            # coefficients of functions that are affine in the body point
            value = torch.cat((self.value(tokens), squared, -2.0 * centres), -1)
            points = positions.float().transpose(1, 2).expand(s, -1, -1, -1)  # (s, k, u, 3)
            beta = self.sharpness.exp()[:, None, None]
            q = torch.cat((2.0 * beta * points, torch.ones_like(points[..., :1])), -1)
            bias = self.bias(tokens).transpose(1, 2)[..., None] - beta * squared[:, None]
            k = torch.cat((centres[:, None].expand(-1, len(beta), -1, -1), bias), -1)
            read = (q @ k.transpose(2, 3)).softmax(-1) @ value[:, None]  # (s, k, u, 4 m + 4)
            affine = read[..., : 4 * m].unflatten(-1, (4, m))
            near = affine[..., 0, :] + (affine[..., 1:, :] * points[..., None]).sum(-2)
            square = read[..., 4 * m] + (read[..., 4 * m + 1 :] * points).sum(-1)
            square = (square + (points**2).sum(-1)).clamp(min=0.0)  # sum_j w_kj |p_k - c_j|^2
            distance = 5.0 * (square + 1e-4).sqrt()
            read = torch.cat((near, distance[..., None]), -1).transpose(1, 2).reshape(s, u, -1)
        x = x.expand(s, -1, -1)
        return self.norm(x + self.mix(torch.cat((read.to(x.dtype), self.own_norm(x)), -1)))


class SceneTransformer(nn.Module):
    """The sequence model pi(h_j | z_(h_1) ... z_(h_(j-1)), M); see the module."""

    nodes: Tensor
    edges: Tensor

    def __init__(self, config: SceneTransformerConfig) -> None:
        super().__init__()
        self.config = config
        d, e = config.sizes.width, config.sizes.edge_width
        # layers and parameters are named as in the stored weights
        self.register_buffer("nodes", torch.zeros(config.n_nodes, config.joint_dim))
        self.register_buffer("edges", torch.zeros(config.n_edges, 2, dtype=torch.int64))
        self.scene, self.look = SceneEncoder(d), GeometricAttention(config)
        self.own, self.own_key = (
            nn.Parameter(0.02 * torch.randn(config.n_nodes, d)) for _ in range(2)
        )
        self.node, self.node_prior = nn.Linear(d, 1), nn.Parameter(torch.zeros(config.n_nodes))
        self.part, self.middle = nn.Linear(d, e), nn.Linear(d, e)
        self.own_edge = nn.Parameter(0.02 * torch.randn(config.n_edges, e))
        self.edge, self.edge_prior = nn.Linear(e, 1), nn.Parameter(torch.zeros(config.n_edges))
        self.link = nn.Linear(e, 1)
        self.kind = nn.Parameter(0.02 * torch.randn(3, d))
        self.place = nn.Parameter(0.02 * torch.randn(config.max_codes + 2, d))
        self.enter = nn.Linear(d, d)
        self.blocks = nn.ModuleList(
            Block(d, config.sizes.heads, 4 * d) for _ in range(config.sizes.layers)
        )
        self.reads = nn.ModuleList(
            Block(d, config.sizes.heads, 2 * d) for _ in range(config.sizes.layers - 1)
        )
        self.norm, self.out, self.key = nn.LayerNorm(d), nn.Linear(d, d), nn.Linear(d, d)
        self.goal_key, self.goal_bias = nn.Linear(d, d), nn.Parameter(torch.zeros(1))
        self.gate = nn.Linear(d, 1)
        self.way = nn.Parameter(torch.tensor(5.0))  # bonus b_i of codes that an edge leads to
        # at the beginning of training, g_j is the same for all prefixes
        nn.init.zeros_(self.gate.weight)
        nn.init.constant_(self.gate.bias, 1.5)
        nn.init.constant_(self.link.bias, 3.0)

    def set_roadmap(self, nodes: np.ndarray, edges: np.ndarray) -> None:
        """Set the nodes (N, n) [rad] and edges (E, 2) of the dictionary's roadmap."""
        self.nodes.copy_(torch.from_numpy(nodes))
        self.edges.copy_(torch.from_numpy(edges.astype(np.int64)))

    @cached_property
    def graph(self) -> Graph:
        """Tables of the roadmap, computed at the first use."""
        arcs = arcs_of(len(self.nodes), self.edges.cpu().numpy())
        neighbour, edge = (torch.from_numpy(table).long().to(self.nodes.device) for table in arcs)
        padded = neighbour == torch.arange(len(neighbour), device=neighbour.device)[:, None]
        padding = torch.zeros(padded.shape, device=padded.device).masked_fill(padded, torch.inf)
        with torch.no_grad():
            features, positions = self.configurations(self.nodes[None])
            length = (self.nodes[self.edges[:, 0]] - self.nodes[self.edges[:, 1]]).norm(dim=1)
        return Graph(positions[0], features[0], neighbour, edge, padding, length)

    def configurations(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Compute features (s, u, f) and body points (s, u, k, 3) [m] of q (s, u, n) [rad]."""
        limits, body = (self.config.lower, self.config.upper), self.config.body
        positions = LinkPositions(*limits, body, q.device).positions(q)
        lower, upper = (q.new_tensor(limit) for limit in limits)
        scaled = 2.0 * (q - lower) / (upper - lower) - 1.0
        features = torch.cat((scaled, q.sin(), q.cos(), positions), -1)
        return features, positions.unflatten(-1, (-1, 3))

    def encode(self, centres: Tensor, offsets: Tensor) -> Scenes:
        """Encode scenes for all codes.

        Args:
            centres: (s, t, 3) [m], see `group_points`.
            offsets: (s, t, m, 3) [m], see `group_points`.
        """
        tokens, graph = self.scene(centres, offsets), self.graph
        codes = self.look(graph.features[None], graph.positions[None], tokens, centres, self.own)
        parts = self.part(codes).float()
        pairs = parts[:, self.edges[:, 0]] + parts[:, self.edges[:, 1]] + self.own_edge
        return Scenes(
            tokens,
            centres,
            codes,
            self.key(codes) + self.own_key,
            parts,
            self.node(codes)[..., 0].float() + self.node_prior,
            self.edge(pairs.relu())[..., 0].float() + self.edge_prior,
        )

    def ends(self, scenes: Scenes, q: Tensor) -> Ends:
        """Embed starts or goals q (s, u, n) [rad]; predict P(free) of motions to nearby codes."""
        s = len(q)
        embedding = self.look(*self.configurations(q), scenes.tokens, scenes.centres)
        length, near = torch.cdist(q, self.nodes[None].expand(s, -1, -1)).topk(
            self.config.sizes.links, largest=False
        )
        odds = self.link_odds(scenes, q, near, embedding)
        return Ends(embedding, near, length + self.config.collision_cost * F.softplus(-odds))

    def link_odds(
        self, scenes: Scenes, q: Tensor, near: Tensor, embedding: Tensor | None = None
    ) -> Tensor:
        """Log odds (s, u, l) that straight motions from configurations to codes are free.

        Args:
            scenes: result of `encode`.
            q: (s, u, n) [rad], the configurations.
            near: (s, u, l) int64, the codes.
            embedding: (s, u, d), embeddings of q; None to compute them.
        """
        if embedding is None:
            embedding = self.look(*self.configurations(q), scenes.tokens, scenes.centres)
        midpoints = (0.5 * (q[:, :, None] + self.nodes[near])).flatten(1, 2)
        middle = self.look(*self.configurations(midpoints), scenes.tokens, scenes.centres)
        x = self.middle(middle).float().unflatten(1, near.shape[1:])
        x = x + self.part(embedding).float()[:, :, None]
        x = x + _rows(scenes.parts, near)
        return self.link(x.relu())[..., 0].float()

    @torch.no_grad()
    def cost_to_go(self, scenes: Scenes, goals: Ends, rounds: int = 14) -> Tensor:
        """Cost V (s, g, N) [rad] of the shortest path from every code to each goal.

        It is at most `SceneTransformerConfig.unreached_cost`. The Bellman-Ford algorithm,
        V_i <- min_j (cost(i, j) + V_j), runs on the GPU for all scenes and goals at once.

        Args:
            scenes: result of `encode`.
            goals: result of `ends`.
            rounds: maximum number of edges of a path.
        """
        arcs = (self.arc_costs(scenes) + self.graph.padding)[..., None]
        V = arcs.new_full((*goals.near.shape[:2], len(self.nodes)), self.config.unreached_cost)
        V = V.scatter(2, goals.near, goals.cost.float())
        V = V.transpose(1, 2).contiguous()  # (s, N, g)
        neighbour = self.graph.neighbour.flatten()
        for _ in range(rounds):
            through = V.index_select(1, neighbour).view(*arcs.shape[:3], -1) + arcs
            V, before = torch.minimum(V, through.amin(2)), V
            if torch.equal(V, before):  # all paths are shortest paths
                break
        return V.transpose(1, 2).contiguous()

    def arc_costs(self, scenes: Scenes) -> Tensor:
        """Cost (s, N, w) [rad] of the edge to every neighbour."""
        cost = self.graph.length + self.config.collision_cost * F.softplus(-scenes.edge_odds)
        return cost[:, self.graph.edge]

    def logits(self, scenes: Scenes, start: Ends, goal: Ends, V: Tensor, codes: Tensor) -> Tensor:
        """Logits t_j . k(e_i) - g_j A_i + b_i after every prefix of codes.

        Args:
            scenes: result of `encode`.
            start: starts (s, r, ...) of the r sequences of each scene.
            goal: goals (s, r, ...).
            V: (s, r, N) [rad], costs to go to these goals.
            codes: (s, r, l) int64, padded with any code.

        Returns:
            (s, r, l + 1, N + 1); class N is the goal token.
        """
        s, r, length = codes.shape
        d, graph, max_advantage = self.config.sizes.width, self.graph, self.config.max_advantage
        taken = _rows(scenes.codes, codes)
        parts = ((goal.embedding[:, :, None], 0), (start.embedding[:, :, None], 1), (taken, 2))
        x = torch.cat([self.enter(part) + self.kind[kind] for part, kind in parts], 2)
        x = x + self.place[: length + 2]
        landmarks = scenes.codes[:, :: self.config.sizes.stride]
        for number, block in enumerate(self.blocks):
            x = block(x.flatten(0, 1), causal=True).view(s, -1, d)
            if number < len(self.reads):
                x = self.reads[number](x, landmarks)
            x = x.view(s, r, length + 2, d)
        x = self.norm(x[:, :, 1:])
        pointer, gate = self.out(x), F.softplus(self.gate(x)).float()
        scale = d**-0.5
        over_codes = (pointer.flatten(1, 2) @ scenes.keys.transpose(1, 2)).float()
        over_codes = over_codes.view(s, r, length + 1, -1) * scale
        to_goal = (pointer * self.goal_key(goal.embedding)[:, :, None]).sum(-1).float()
        to_goal = to_goal * scale + self.goal_bias
        cost = start.cost + V.gather(2, start.near)
        advantage = (cost - cost.amin(-1, keepdim=True)).clamp(max=max_advantage)
        bonus = self.way - gate[:, :, 0] * advantage
        steps = [over_codes[:, :, :1].scatter_add(3, start.near[:, :, None], bonus[:, :, None])]
        goals = [to_goal[:, :, :1]]
        if length:
            here, neighbour = V.gather(2, codes), graph.neighbour[codes]
            there = V.gather(2, neighbour.flatten(2)).view(neighbour.shape)
            arcs = _rows(self.arc_costs(scenes), codes)
            advantage = (arcs + there - here[..., None]).clamp(0.0, max_advantage)
            bonus = self.way - gate[:, :, 1:] * advantage
            bonus = bonus.masked_fill(graph.padding[codes] > 0.0, 0.0)
            steps.append(over_codes[:, :, 1:].scatter_add(3, neighbour, bonus))
            links = torch.full_like(V, torch.inf).scatter(2, goal.near, goal.cost).gather(2, codes)
            linked = links.isfinite()
            advantage = (links.masked_fill(~linked, 0.0) - here).clamp(0.0, max_advantage)
            bonus = self.way - gate[:, :, 1:, 0] * advantage
            goals.append(to_goal[:, :, 1:] + bonus.masked_fill(~linked, 0.0))
        return torch.cat((torch.cat(steps, 2), torch.cat(goals, 2)[..., None]), -1)


def _rows(values: Tensor, rows: Tensor) -> Tensor:
    """Return rows (s, u, l) int64 of values (s, N, d), as (s, u, l, d)."""
    each = rows.flatten(1)[..., None].expand(-1, -1, values.shape[-1])
    return values.gather(1, each).view(*rows.shape, -1)
