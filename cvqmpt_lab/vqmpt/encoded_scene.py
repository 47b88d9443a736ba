"""The half of the scene transformer that looks, in numpy and compiled: same mathematics as
`scene_transformer`.

A new cloud is looked at from every code once; starts and goals look at what is kept of it. Tests
compare with torch.
"""

from dataclasses import dataclass
from typing import Annotated, NamedTuple

import numpy as np

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.jit import entry
from cvqmpt_lab.robot.kinematics import link_poses
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.vqmpt.array_layers import Block, Layers, Linear, gelu, relu, softplus
from cvqmpt_lab.vqmpt.code_arcs import QUEUE, UNREACHED, arcs_of, cheapest_ways
from cvqmpt_lab.vqmpt.config import SceneTransformerConfig
from cvqmpt_lab.vqmpt.weights import TRANSFORMER as PART
from cvqmpt_lab.vqmpt.weights import StoredModel, robot_signature

RISK, WAVES = 3.0, 5  # as in `scene_transformer`
BATCH = 16  # groups of points


class Look(NamedTuple):
    """What body points read from a scene's tokens."""

    keys: np.ndarray  # (k, 4, t), multiplied with (2 beta p, 1)
    values: np.ndarray  # (t, 4 m + 5): v, V, |c|^2, -2 c and 1


@dataclass(frozen=True, eq=False)
class EncodedScene:
    """What is known of a scene, whatever start and goal; see `scene_transformer.Scenes`."""

    look: Look
    codes: np.ndarray  # (N, d)
    keys: np.ndarray  # (N, d)
    parts: np.ndarray  # (N, e)
    entered: np.ndarray  # (N, d), embeddings as the causal transformer takes them
    node_odds: np.ndarray  # (N,)
    edge_odds: np.ndarray  # (E,)
    arc_cost: np.ndarray  # (2 E,) float64 [rad], length - w log P(free)
    arc_table: np.ndarray  # (N, w) [rad], the same by node, 0 where there is no arc
    # keys and values for each block that reads landmarks
    landmarks: tuple[tuple[np.ndarray, np.ndarray], ...]


class Ends(NamedTuple):
    """Starts or goals (u): their embeddings, and the codes near them."""

    seen: np.ndarray  # (u, d)
    near: np.ndarray  # (u, l)
    cost: np.ndarray  # (u, l), length - w log P(free) of the motion to each [rad]


class SceneLooker:
    """Encodes scenes, and starts and goals in them, for one robot."""

    def __init__(self, model: StoredModel, robot: Robot) -> None:
        """Take over the weights;
        InvalidInputError where they are missing, of another robot, or do not fit.
        """
        model.require_part(PART)
        model.robot.require_same(robot_signature(robot))
        if model.config.transformer is None:
            raise InvalidInputError(
                "the model has a transformer, but its configuration describes none"
            )
        self.config: SceneTransformerConfig = model.config.transformer
        self.robot, layers = robot, Layers(model, PART)  # not kept: layers hold all that was read
        self.nodes, self.edges = _roadmap(model, self.config)
        self._take_over(layers)
        self._kept_kinematics(layers)
        self.arcs = arcs_of(len(self.nodes), self.edges)
        ends = self.nodes[self.edges]
        self._length = np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1)
        self._heap = (
            np.empty(QUEUE * len(self.nodes)),
            np.empty(QUEUE * len(self.nodes), dtype=np.int32),
        )

    def _take_over(self, layers: Layers) -> None:
        sizes, count = self.config.sizes, self.config.n_nodes
        d, e, points = sizes.width, sizes.edge_width, len(self.config.body.points)
        self._points = [
            layers.linear(f"scene.points.{k}", *widths)
            for k, widths in ((0, (3, 64)), (2, (64, 64)), (4, (64, 128)))
        ]
        self._join = layers.linear("scene.join", 128 + 3 + 6 * WAVES, d)
        self._scene_block = Block(layers, "scene.block", d, 8, 4 * d)
        self._scene_norm = layers.norm("scene.norm", d)
        self._waves = (np.pi * 2.0 ** np.arange(WAVES)).astype(np.float32)
        self._embed = (
            layers.linear("look.embed.0", self.config.features, 2 * d),
            layers.linear("look.embed.2", 2 * d, d),
        )
        read = points * (sizes.values + 1)  # numbers that body points read
        weight, bias = layers.linear("look.mix.0", read + d, 2 * d)
        self._mix_read, self._mix_own = weight[:read].copy(), Linear(weight[read:].copy(), bias)
        self._mix = layers.linear("look.mix.2", 2 * d, d)
        self._own_norm, self._look_norm = (
            layers.norm("look.own_norm", d),
            layers.norm("look.norm", d),
        )
        self._value = layers.linear("look.value", d, 4 * sizes.values)
        self._bias = layers.linear("look.bias", d, points)
        self._sharpness = np.exp(layers.array("look.sharpness", points))
        self._node, self._node_prior = (
            layers.linear("node", d, 1),
            layers.array("node_prior", count),
        )
        self._part, self._middle = layers.linear("part", d, e), layers.linear("middle", d, e)
        self._own_edge = layers.array("own_edge", self.config.n_edges, e)
        self._edge, self._edge_prior = (
            layers.linear("edge", e, 1),
            layers.array("edge_prior", self.config.n_edges),
        )
        self._link = layers.linear("link", e, 1)
        self._enter, self._kind = layers.linear("enter", d, d), layers.array("kind", 3, d)
        blocks = range(sizes.layers - 1)
        self.reads = [
            Block(layers, f"reads.{k}", d, sizes.heads, 2 * d, context=True) for k in blocks
        ]
        self._key, self._own_key = layers.linear("key", d, d), layers.array("own_key", count, d)

    def _kept_kinematics(self, layers: Layers) -> None:
        """What nodes contribute to what they see in any scene."""
        features, points = self._configurations(self.nodes)
        self._node_queries = self._queries(points)
        self._node_points = points
        self._node_embedding = self._embedded(features)
        self._node_embedding += layers.array("own", len(self.nodes), self.config.sizes.width)
        self._node_own = self._mix_own(self._own_norm(self._node_embedding))

    def _configurations(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Features (u, f) and body points (u, k, 3) [m] of configurations q (u, n), float32."""
        body = self.config.body
        rotation, translation = link_poses(
            self.robot.kinematics, np.ascontiguousarray(q, dtype=float)
        )
        rows = np.array(body.points) + 1  # pose row 0 is the world
        points = (
            np.matmul(rotation[:, rows], body.offsets[:, :, None])[..., 0] + translation[:, rows]
        )
        lower, upper = np.array(self.config.lower), np.array(self.config.upper)
        scaled = 2.0 * (q - lower) / (upper - lower) - 1.0
        features = np.concatenate(
            [scaled, np.sin(q), np.cos(q), points.reshape(len(q), -1)], axis=1
        )
        return features.astype(np.float32), np.ascontiguousarray(points, dtype=np.float32)

    def _queries(self, points: np.ndarray) -> np.ndarray:
        """(k, u, 4): (2 beta p, 1) of body points (u, k, 3)."""
        queries = np.ones((points.shape[1], len(points), 4), dtype=np.float32)
        queries[..., :3] = (np.float32(2.0) * self._sharpness)[:, None, None] * points.transpose(
            1, 0, 2
        )
        return queries

    def _embedded(self, features: np.ndarray) -> np.ndarray:
        return self._embed[1](gelu(self._embed[0](features)))

    def _looked(
        self,
        look: Look,
        embedding: np.ndarray,
        own: np.ndarray,
        points: np.ndarray,
        queries: np.ndarray,
    ) -> np.ndarray:
        """Embeddings (u, d) of configurations that have looked; own (u, 2 d):
        what they add to the mixture.
        """
        k, u, m = len(queries), len(points), self.config.sizes.values
        read = np.empty((k, u, look.values.shape[1]), dtype=np.float32)
        scores = np.empty((u, look.values.shape[0]), dtype=np.float32)
        for j in range(k):
            np.matmul(queries[j], look.keys[j], out=scores)
            scores -= scores.max(axis=1, keepdims=True)
            np.exp(scores, out=scores)
            np.matmul(scores, look.values, out=read[j])
        mixed = np.empty((u, k * (m + 1)), dtype=np.float32)
        gather_reads(read, points, mixed)
        hidden = mixed @ self._mix_read
        hidden += own
        looked = self._mix(gelu(hidden))
        looked += embedding
        return self._look_norm(looked)

    def _seen(self, look: Look, q: np.ndarray) -> np.ndarray:
        """Embeddings (u, d) of any configurations q (u, n)."""
        features, points = self._configurations(q)
        embedding = self._embedded(features)
        own = self._mix_own(self._own_norm(embedding))
        return self._looked(look, embedding, own, points, self._queries(points))

    def _look(self, centres: np.ndarray, offsets: np.ndarray) -> Look:
        """Tokens of groups of points, as body points read them."""
        first, second, third = self._points
        shape = np.empty((len(centres), len(third.bias)), dtype=np.float32)
        # few groups at once, which stay in the processor's cache
        for begin in range(0, len(centres), BATCH):
            some = offsets[begin : begin + BATCH]
            x = relu(second(relu(first(some.reshape(-1, 3) * np.float32(5.0)))))
            np.max(
                (x @ third.weight).reshape(*some.shape[:2], -1),
                axis=1,
                out=shape[begin : begin + BATCH],
            )
        shape += third.bias
        angle = (centres[..., None] * self._waves).reshape(len(centres), -1)
        x = self._join(np.concatenate([shape, centres, np.sin(angle), np.cos(angle)], axis=1))
        block = self._scene_block
        tokens = self._scene_norm(block.attend(x, *block.keys_values(x)))
        squared = np.einsum("ti,ti->t", centres, centres)
        keys = np.empty((len(self._sharpness), 4, len(centres)), dtype=np.float32)
        keys[:, :3] = centres.T
        keys[:, 3] = self._bias(tokens).T - self._sharpness[:, None] * squared
        ones = np.ones((len(centres), 1), dtype=np.float32)
        read = [self._value(tokens), squared[:, None], np.float32(-2.0) * centres, ones]
        return Look(keys, np.concatenate(read, axis=1))

    def encode(self, centres: np.ndarray, offsets: np.ndarray) -> EncodedScene:
        """Look at a scene, given as groups of points (see `point_groups`), from every code."""
        look = self._look(centres, offsets)
        codes = self._looked(
            look, self._node_embedding, self._node_own, self._node_points, self._node_queries
        )
        parts = self._part(codes)
        pairs = np.take(parts, self.edges[:, 0], axis=0)
        pairs += np.take(parts, self.edges[:, 1], axis=0)
        pairs += self._own_edge
        edge_odds = self._edge(relu(pairs))[:, 0] + self._edge_prior
        cost = (self._length + RISK * softplus(-edge_odds))[self.arcs.edge]
        arc_table = np.zeros(self.arcs.table.shape, dtype=np.float32)
        arc_table.reshape(-1)[self.arcs.slot] = cost
        return EncodedScene(
            look,
            codes,
            self._key(codes) + self._own_key,
            parts,
            self._enter(codes) + self._kind[2],
            self._node(codes)[:, 0] + self._node_prior,
            edge_odds,
            cost,
            arc_table,
            tuple(read.keys_values(codes[:: self.config.sizes.stride]) for read in self.reads),
        )

    def ends(self, scene: EncodedScene, q: np.ndarray) -> Ends:
        """Look at a scene from starts or goals q (u, n) [rad], and half way to the codes near them."""
        links = self.config.sizes.links
        squares = ((q[:, None] - self.nodes) ** 2).sum(-1)
        near = np.argpartition(squares, links - 1, axis=1)[:, :links]
        half_way = 0.5 * (q[:, None] + self.nodes[near])
        looked = self._seen(scene.look, np.concatenate([q, half_way.reshape(-1, q.shape[1])]))
        seen, middle = looked[: len(q)], self._middle(looked[len(q) :]).reshape(*near.shape, -1)
        middle += self._part(seen)[:, None]
        middle += scene.parts[near]
        odds = self._link(relu(middle).reshape(-1, middle.shape[-1])).reshape(near.shape)
        length = np.sqrt(np.take_along_axis(squares, near, axis=1))
        return Ends(seen, near, length + RISK * softplus(-odds))

    def cost_to_go(self, scene: EncodedScene, ends: Ends) -> np.ndarray:
        """V (u, N) [rad]:
        cost of the cheapest way between every code and each end, at most UNREACHED.
        """
        V = np.full((len(ends.near), len(self.nodes)), np.inf)
        np.put_along_axis(V, ends.near, ends.cost, axis=1)
        parent = np.empty(V.shape, dtype=np.int32)
        cheapest_ways(self.arcs.first, self.arcs.neighbour, scene.arc_cost, V, parent, *self._heap)
        return np.minimum(V, UNREACHED)

    def entered(self, seen: np.ndarray, kind: int) -> np.ndarray:
        """Embeddings (u, d) of goals (kind 0) or starts (1) as the causal transformer takes them."""
        return self._enter(seen) + self._kind[kind]


def _roadmap(model: StoredModel, config: SceneTransformerConfig) -> tuple[np.ndarray, np.ndarray]:
    """Nodes (N, n) float64 [rad] and edges (E, 2) int64;
    InvalidInputError where they do not fit the dictionary.
    """
    count, codes = config.n_nodes, model.config.dictionary.n_codes
    if count != codes:
        raise InvalidInputError(
            f"{PART} is for {count} codes, the dictionary has {codes}; train it again"
        )
    for name in ("lower", "upper"):
        if not np.allclose(getattr(config, name), getattr(model.robot, name), atol=1e-6, rtol=0.0):
            raise InvalidInputError(
                f"{PART} was made with other {name} limits than its weights' robot; train it again"
            )
    nodes = model.array(PART, "nodes", count, config.joint_dim)
    edges = model.parts[PART].get("edges")
    if edges is None or edges.shape != (config.n_edges, 2) or edges.dtype.kind not in "iu":
        found = "missing" if edges is None else f"{edges.shape} of {edges.dtype}"
        raise InvalidInputError(
            f"{PART} does not fit its configuration: edges is {found}, expected "
            f"({config.n_edges}, 2)"
        )
    if edges.min() < 0 or edges.max() >= count or (edges[:, 0] == edges[:, 1]).any():
        raise InvalidInputError(f"{PART} has edges that do not join two of its {count} nodes")
    return nodes, edges.astype(np.int64)


@entry
def gather_reads(
    read: Annotated[np.ndarray, "float32 k u columns"],
    points: Annotated[np.ndarray, "float32 u k 3"],
    mixed: Annotated[np.ndarray, "float32 u numbers"],
):
    """From sums over tokens to what each body point p reads: m values v + V p, and how far the
    tokens are.

    read: sums weighted with unnormalised weights; the last column is the sum of the weights. mixed:
        m + 1 numbers of each body point.
    """
    m = (read.shape[2] - 5) // 4
    for j in range(read.shape[0]):
        for i in range(read.shape[1]):
            x, y, z = points[i, j, 0], points[i, j, 1], points[i, j, 2]
            share, begin = np.float32(1.0) / read[j, i, 4 * m + 4], j * (m + 1)
            for c in range(m):
                value = read[j, i, c] + read[j, i, m + c] * x
                value += read[j, i, 2 * m + c] * y + read[j, i, 3 * m + c] * z
                mixed[i, begin + c] = share * value
            away = read[j, i, 4 * m] + read[j, i, 4 * m + 1] * x
            away += read[j, i, 4 * m + 2] * y + read[j, i, 4 * m + 3] * z
            away = share * away + (x * x + y * y + z * z)
            mixed[i, begin + m] = np.float32(5.0) * np.sqrt(
                max(away, np.float32(0.0)) + np.float32(1e-4)
            )
