"""The scene transformer at planning time: from a cloud, a start and goals to sequences of codes.

scene = predictor.encode(cloud)
nearest = goals[predictor.rank(scene, start, goals)[:3]]
sequences = predictor.sequences(scene, start, nearest)

In numpy and compiled, the same mathematics as the torch module `scene_transformer`, which explains
it; tests compare both. The codes of the dictionary attend to a new cloud once; starts and goals
attend to the tokens that are kept of it. Codes are decoded step by step, all hypotheses of all
goals in one batch, with attention keys and values of earlier codes kept, and logits for the
roadmap's successors alone; other classes are impossible.
"""

import hashlib
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from cvqmpt_lab.caches import LruCache
from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.robot.kinematics import link_poses
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.sensing.virtual import CameraSettings, thinned
from cvqmpt_lab.vqmpt.beam_search import CodeSequence, beam_search, log_softmax
from cvqmpt_lab.vqmpt.codebook import require_own_dictionary
from cvqmpt_lab.vqmpt.config import SceneTransformerConfig, checked_cloud
from cvqmpt_lab.vqmpt.published_predictor import SCENES, checked_ends
from cvqmpt_lab.vqmpt.scene_arrays import (
    LONGEST,
    NOWHERE,
    RISK,
    UNREACHED,
    WAVES,
    WORST,
    Block,
    Layers,
    Linear,
    arcs_of,
    gelu,
    relu,
    softplus,
)
from cvqmpt_lab.vqmpt.scene_kernels import HEAP_ENTRIES, fill_groups, gather_reads, shortest_paths
from cvqmpt_lab.vqmpt.weights import TRANSFORMER as PART
from cvqmpt_lab.vqmpt.weights import StoredModel, robot_signature


class SceneTokens(NamedTuple):
    """Tokens of a scene, as body points p of the arm attend to them."""

    keys: np.ndarray  # (k, 4, t), multiplied with (2 beta p, 1)
    values: np.ndarray  # (t, 4 m + 5): v, V, |c|^2, -2 c and 1


@dataclass(frozen=True, eq=False)
class EncodedScene:
    """What does not depend on start and goal; see `scene_transformer.Scenes`."""

    tokens: SceneTokens
    codes: np.ndarray  # (N, d), embeddings
    keys: np.ndarray  # (N, d), compared with pointers
    parts: np.ndarray  # (N, e), what edges are judged by
    entered: np.ndarray  # (N, d), embeddings as the causal transformer takes them
    node_odds: np.ndarray  # (N,), log odds of P(code free)
    edge_odds: np.ndarray  # (E,), log odds of P(edge free)
    arc_cost: np.ndarray  # (2 E,) float64 [rad], length - w log P(free)
    arc_table: np.ndarray  # (N, w) [rad], the same by node, 0 where there is no arc
    landmarks: tuple[tuple[np.ndarray, np.ndarray], ...]  # keys and values for each block


class Ends(NamedTuple):
    """Starts or goals (u): their embeddings, and the codes near them."""

    embedding: np.ndarray  # (u, d)
    near: np.ndarray  # (u, l)
    cost: np.ndarray  # (u, l), length - w log P(free) of the motion to each [rad]


def compiled_groups(points: np.ndarray, groups: int, size: int) -> tuple[np.ndarray, np.ndarray]:
    """As `scene_arrays.group_points`, of points (m, 3) float32."""
    points = points[np.arange(max(len(points), size + 1)) % len(points)]
    centres, offsets = np.empty((groups, 3), np.float32), np.empty((groups, size, 3), np.float32)
    away, near = np.empty((2, len(points)), np.float32)
    transposed, chosen = np.ascontiguousarray(points.T), np.empty(size, np.int64)
    fill_groups(transposed, centres, offsets, away, near, chosen)
    return centres, offsets


class SceneNetwork:
    """The scene transformer's layers for one robot."""

    def __init__(self, model: StoredModel, robot: Robot) -> None:
        """Take over the weights; InvalidInputError if they do not fit the robot or their sizes."""
        model.require_part(PART)
        model.robot.require_same(robot_signature(robot))
        if model.config.transformer is None:
            raise InvalidInputError(
                "the model has a transformer, but its configuration describes none"
            )
        self.config: SceneTransformerConfig = model.config.transformer
        self.robot = robot
        self.nodes, self.edges = _roadmap(model, self.config)
        self.arcs = arcs_of(len(self.nodes), self.edges)
        ends = self.nodes[self.edges]
        self._length = np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1)
        entries = HEAP_ENTRIES * len(self.nodes)
        self._heap = np.empty(entries), np.empty(entries, dtype=np.int32)
        layers = Layers(model, PART)  # not kept: it holds all arrays that were read
        self._take_scene_layers(layers)
        self._take_roadmap_layers(layers)
        self._take_causal_layers(layers)
        features, points = self._configurations(self.nodes)
        embedding = self._embed[1](gelu(self._embed[0](features)))
        # kept, since the nodes of the codes are the same in every scene
        embedding += layers.array("own", len(self.nodes), self.config.sizes.width)
        self._node_inputs = embedding, points, self._queries(points), self._own(embedding)

    def _take_scene_layers(self, layers: Layers) -> None:
        """Layers from points to tokens, and from those to embeddings."""
        sizes, points = self.config.sizes, len(self.config.body.points)
        d, values = sizes.width, sizes.values
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
        read = points * (values + 1)  # numbers that body points read
        weight, bias = layers.linear("look.mix.0", read + d, 2 * d)
        # the weights are split, so that what codes add without a scene is computed once
        self._mix_read, self._mix_own = weight[:read].copy(), Linear(weight[read:].copy(), bias)
        self._mix = layers.linear("look.mix.2", 2 * d, d)
        self._own_norm, self._norm = layers.norm("look.own_norm", d), layers.norm("look.norm", d)
        self._value = layers.linear("look.value", d, 4 * values)
        self._bias = layers.linear("look.bias", d, points)
        self._sharpness = np.exp(layers.array("look.sharpness", points))

    def _take_roadmap_layers(self, layers: Layers) -> None:
        """Layers from embeddings to log odds."""
        d, e = self.config.sizes.width, self.config.sizes.edge_width
        count, edges = self.config.n_nodes, self.config.n_edges
        self._node = layers.linear("node", d, 1)
        self._node_prior = layers.array("node_prior", count)
        self._part, self._middle = layers.linear("part", d, e), layers.linear("middle", d, e)
        self._own_edge = layers.array("own_edge", edges, e)
        self._edge, self._edge_prior = (
            layers.linear("edge", e, 1),
            layers.array("edge_prior", edges),
        )
        self._link = layers.linear("link", e, 1)

    def _take_causal_layers(self, layers: Layers) -> None:
        """Layers over goal, start and codes so far."""
        sizes, count = self.config.sizes, self.config.n_nodes
        d, heads = sizes.width, sizes.heads
        self._enter, self._kind = layers.linear("enter", d, d), layers.array("kind", 3, d)
        self.place = layers.array("place", LONGEST + 2, d)
        blocks = range(sizes.layers)
        self.blocks = [Block(layers, f"blocks.{k}", d, heads, 4 * d) for k in blocks]
        self.reads = [
            Block(layers, f"reads.{k}", d, heads, 2 * d, context=True) for k in blocks[:-1]
        ]
        self._key, self._own_key = layers.linear("key", d, d), layers.array("own_key", count, d)
        self._out_norm, self._out = layers.norm("norm", d), layers.linear("out", d, d)
        self._gate, self.goal_key = layers.linear("gate", d, 1), layers.linear("goal_key", d, d)
        self.goal_bias = float(layers.array("goal_bias", 1)[0])

    def _configurations(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Features (u, f) and body points (u, k, 3) [m] of configurations q (u, n), float32."""
        body = self.config.body
        rotation, translation = link_poses(
            self.robot.kinematics, np.ascontiguousarray(q, dtype=float)
        )
        rows = np.array(body.points) + 1  # pose row 0 is the world
        turned = np.matmul(rotation[:, rows], body.offsets[:, :, None])[..., 0]
        points = turned + translation[:, rows]
        lower, upper = np.array(self.config.lower), np.array(self.config.upper)
        scaled = 2.0 * (q - lower) / (upper - lower) - 1.0
        parts = [scaled, np.sin(q), np.cos(q), points.reshape(len(q), -1)]
        features = np.concatenate(parts, axis=1).astype(np.float32)
        return features, np.ascontiguousarray(points, dtype=np.float32)

    def _queries(self, points: np.ndarray) -> np.ndarray:
        """(k, u, 4): (2 beta p, 1) of body points (u, k, 3)."""
        queries = np.ones((points.shape[1], len(points), 4), dtype=np.float32)
        scale = (np.float32(2.0) * self._sharpness)[:, None, None]
        queries[..., :3] = scale * points.transpose(1, 0, 2)
        return queries

    def _own(self, embedding: np.ndarray) -> np.ndarray:
        """What embeddings (u, d) add to the mixture (u, 2 d)."""
        return self._mix_own(self._own_norm(embedding))

    def _attend(
        self,
        tokens: SceneTokens,
        embedding: np.ndarray,
        points: np.ndarray,
        queries: np.ndarray,
        own: np.ndarray,
    ) -> np.ndarray:
        """Embeddings (u, d) of configurations after geometric attention to a scene's tokens."""
        k, u, m = len(queries), len(points), self.config.sizes.values
        read = np.empty((k, u, tokens.values.shape[1]), dtype=np.float32)
        scores = np.empty((u, tokens.values.shape[0]), dtype=np.float32)
        for j in range(k):
            np.matmul(queries[j], tokens.keys[j], out=scores)
            # against overflow; the weights are normalised when the sums are gathered
            scores -= scores.max(axis=1, keepdims=True)
            np.exp(scores, out=scores)
            np.matmul(scores, tokens.values, out=read[j])
        mixed = np.empty((u, k * (m + 1)), dtype=np.float32)
        gather_reads(read, points, mixed)
        hidden = mixed @ self._mix_read
        hidden += own
        attended = self._mix(gelu(hidden))
        attended += embedding
        return self._norm(attended)

    def _embeddings(self, tokens: SceneTokens, q: np.ndarray) -> np.ndarray:
        """Embeddings (u, d) of any configurations q (u, n)."""
        features, points = self._configurations(q)
        embedding = self._embed[1](gelu(self._embed[0](features)))
        return self._attend(tokens, embedding, points, self._queries(points), self._own(embedding))

    def _tokens(self, centres: np.ndarray, offsets: np.ndarray, batch: int = 16) -> SceneTokens:
        """Tokens of groups of points; so many groups at once stay in the processor's cache."""
        first, second, third = self._points
        shape = np.empty((len(centres), len(third.bias)), dtype=np.float32)
        for begin in range(0, len(centres), batch):
            some = offsets[begin : begin + batch]
            x = relu(second(relu(first(some.reshape(-1, 3) * np.float32(5.0)))))
            x = (x @ third.weight).reshape(*some.shape[:2], -1)
            np.max(x, axis=1, out=shape[begin : begin + batch])
        shape += third.bias
        angle = (centres[..., None] * self._waves).reshape(len(centres), -1)
        x = self._join(np.concatenate([shape, centres, np.sin(angle), np.cos(angle)], axis=1))
        block = self._scene_block
        tokens = self._scene_norm(block.attend(x, *block.keys_values(x)))
        squared = np.einsum("ti,ti->t", centres, centres)
        keys = np.empty((len(self._sharpness), 4, len(centres)), dtype=np.float32)
        keys[:, :3] = centres.T
        keys[:, 3] = self._bias(tokens).T - self._sharpness[:, None] * squared
        # the column of ones makes the sum of the weights one of the values read
        ones = np.ones((len(centres), 1), dtype=np.float32)
        read = [self._value(tokens), squared[:, None], np.float32(-2.0) * centres, ones]
        return SceneTokens(keys, np.concatenate(read, axis=1))

    def encode(self, centres: np.ndarray, offsets: np.ndarray) -> EncodedScene:
        """Encode a scene, given as groups of points (see `group_points`), for all codes."""
        tokens = self._tokens(centres, offsets)
        codes = self._attend(tokens, *self._node_inputs)
        parts = self._part(codes)
        pairs = np.take(parts, self.edges[:, 0], axis=0)
        pairs += np.take(parts, self.edges[:, 1], axis=0)
        pairs += self._own_edge
        edge_odds = self._edge(relu(pairs))[:, 0] + self._edge_prior
        # log P(free) = -softplus(-odds)
        cost = (self._length + RISK * softplus(-edge_odds))[self.arcs.edge]
        arc_table = np.zeros(self.arcs.table.shape, dtype=np.float32)
        arc_table.reshape(-1)[self.arcs.slot] = cost
        # every so many-th code stands for its neighbours: attention to all costs more
        landmarks = codes[:: self.config.sizes.stride]
        return EncodedScene(
            tokens,
            codes,
            self._key(codes) + self._own_key,
            parts,
            self.entered(codes, 2),
            self._node(codes)[:, 0] + self._node_prior,
            edge_odds,
            cost,
            arc_table,
            tuple(read.keys_values(landmarks) for read in self.reads),
        )

    def ends(self, scene: EncodedScene, q: np.ndarray) -> Ends:
        """Embed starts or goals q (u, n) [rad], and judge the motions to the codes near them."""
        links = self.config.sizes.links
        squares = ((q[:, None] - self.nodes) ** 2).sum(-1)
        near = np.argpartition(squares, links - 1, axis=1)[:, :links]  # links need no order
        half_way = 0.5 * (q[:, None] + self.nodes[near])
        states = np.concatenate([q, half_way.reshape(-1, q.shape[1])])
        embeddings = self._embeddings(scene.tokens, states)
        embedding, middle = embeddings[: len(q)], self._middle(embeddings[len(q) :])
        middle = middle.reshape(*near.shape, -1)
        middle += self._part(embedding)[:, None]
        middle += scene.parts[near]
        odds = self._link(relu(middle).reshape(-1, middle.shape[-1])).reshape(near.shape)
        length = np.sqrt(np.take_along_axis(squares, near, axis=1))
        return Ends(embedding, near, length + RISK * softplus(-odds))

    def cost_to_go(self, scene: EncodedScene, ends: Ends) -> np.ndarray:
        """V (u, N) [rad]: cost of the shortest path from every code to each end, <= UNREACHED."""
        V = np.full((len(ends.near), len(self.nodes)), np.inf)
        np.put_along_axis(V, ends.near, ends.cost, axis=1)
        shortest_paths(self.arcs.first, self.arcs.neighbour, scene.arc_cost, V, *self._heap)
        return np.minimum(V, UNREACHED)

    def entered(self, embeddings: np.ndarray, kind: int) -> np.ndarray:
        """Embeddings (u, d) of goals (0), starts (1) or codes (2) for the causal transformer."""
        return self._enter(embeddings) + self._kind[kind]

    def pointers(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pointers t (r, d), scaled, and gates g (r, 1) of tokens x (r, d)."""
        x = self._out_norm(x)
        pointer = self._out(x)
        pointer *= np.float32(pointer.shape[1] ** -0.5)
        return pointer, softplus(self._gate(x))


def _roadmap(model: StoredModel, config: SceneTransformerConfig) -> tuple[np.ndarray, np.ndarray]:
    """Nodes (N, n) float64 [rad] and edges (E, 2) int64, which must fit the dictionary."""
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


class SequenceDecoder:
    """A `StepDecoder` from one start to k goals; class N, the number of codes, is the goal token.

    The logits of successor i of code j, with V the cost to go to the goal, are

        t . k(e_i) - g A_i,    A_i = min(max(cost(j, i) + V_i - V_j, 0), WORST).
    """

    def __init__(
        self, network: SceneNetwork, scene: EncodedScene, start: np.ndarray, goals: np.ndarray
    ) -> None:
        """Embed the start (n,) and goals (k, n) [rad], and find the costs to go."""
        self._network, self._scene = network, scene
        ends = network.ends(scene, np.vstack([start[None], goals]))
        self._start, ends = Ends(*(part[:1] for part in ends)), Ends(*(part[1:] for part in ends))
        self.V = network.cost_to_go(scene, ends).astype(np.float32)  # (k, N) [rad]
        self._link = np.full(self.V.shape, np.inf, dtype=np.float32)
        np.put_along_axis(self._link, ends.near, ends.cost.astype(np.float32), axis=1)
        self._goal_keys = network.goal_key(ends.embedding)
        self._prefix = (
            network.entered(ends.embedding, 0),
            network.entered(self._start.embedding, 1),
        )
        self._caches: list[np.ndarray | None] = [None] * len(network.blocks)
        self._place = 0  # of the next token
        self._goal = np.arange(len(goals))  # of each row

    def start(self) -> tuple[np.ndarray, np.ndarray]:
        """Codes (k, l) near the start and their log-probabilities."""
        goal, start = self._prefix
        # the prefix is the same in all hypotheses, so it is decoded once per goal
        self._step(goal)
        pointer, gate = self._step(np.repeat(start, len(goal), axis=0))
        near = self._start.near[0]
        cost = self._start.cost[0].astype(np.float32) + self.V[:, near]
        excess = np.minimum(cost - cost.min(axis=1, keepdims=True), np.float32(WORST))
        logits = pointer @ self._scene.keys[near].T - gate * excess
        return np.broadcast_to(near, logits.shape), log_softmax(logits)

    def advance(self, parents: np.ndarray, codes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Replace the rows; successors (r, w + 1) of the codes, and log-probabilities."""
        network, scene = self._network, self._scene
        arcs, goal = network.arcs, self._goal[parents]
        self._goal = goal
        # keys and values follow their hypothesis when the beam is reordered
        self._caches = [None if cache is None else cache[parents] for cache in self._caches]
        pointer, gate = self._step(scene.entered[codes])
        table, here = arcs.table[codes], self.V[goal, codes][:, None]
        excess = scene.arc_table[codes] + self.V[goal[:, None], table] - here
        logits = np.empty((len(codes), table.shape[1] + 1), dtype=np.float32)
        logits[:, :-1] = np.matmul(scene.keys[table], pointer[:, :, None])[..., 0]
        logits[:, :-1] -= gate * np.clip(excess, np.float32(0.0), np.float32(WORST))
        logits[:, :-1][arcs.padding[codes]] = -np.inf
        link = self._link[goal, codes][:, None]  # the goal token needs a link to the goal
        leads = np.isfinite(link)
        excess = np.where(leads, link, 0.0) - here
        extra = gate * np.clip(excess, np.float32(0.0), np.float32(WORST))
        to_goal = np.einsum("rd,rd->r", pointer, self._goal_keys[goal])[:, None]
        to_goal = to_goal + np.float32(network.goal_bias)
        logits[:, -1:] = np.where(leads, to_goal - extra, -np.inf)
        goal_class = np.full((len(codes), 1), len(arcs.table), dtype=table.dtype)
        return np.concatenate([table, goal_class], axis=1), log_softmax(logits)

    def _step(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pointers and gates after the next token of each row, x (r, d)."""
        network, landmarks = self._network, self._scene.landmarks
        x = x + network.place[self._place]
        self._place += 1
        for number, block in enumerate(network.blocks):
            x, self._caches[number] = block.append(x, self._caches[number])
            if number < len(landmarks):
                x = network.reads[number].attend(x, *landmarks[number])
        return network.pointers(x)


class SceneTransformerPredictor:
    """A trained scene transformer for one robot."""

    def __init__(self, model: StoredModel, robot: Robot) -> None:
        """Take over the weights; InvalidInputError if robot, dictionary or sizes do not fit."""
        self.robot, self.network = robot, SceneNetwork(model, robot)
        require_own_dictionary(model)
        self._scenes = LruCache[EncodedScene](SCENES)

    def encode(
        self, cloud: np.ndarray, use_cache: bool = True, most_points: int = 1024
    ) -> EncodedScene:
        """Encode a point cloud. Cached for the latest clouds.

        Args:
            cloud: (m, 3) [m, robot base frame]; no points are an empty scene.
            use_cache: False to encode it again.
            most_points: of a cloud in training; larger ones are thinned evenly.

        Raises:
            InvalidInputError: `checked_cloud` refuses the cloud, or no point is within reach.
        """
        points = _near_points(cloud)
        key = hashlib.sha256(points.tobytes()).hexdigest()
        return self._scenes.get(key, lambda: self._encoded(points, most_points), use_cache)

    def _encoded(self, points: np.ndarray, most_points: int) -> EncodedScene:
        sizes = self.network.config.sizes
        if len(points) == 0:
            points = np.array([NOWHERE], dtype=np.float32)  # far below the robot, as in training
        if len(points) > most_points:
            settings = CameraSettings.like_training(most_points, noise=0.0)
            points = thinned(points, settings, np.random.default_rng(0)).astype(np.float32)
        return self.network.encode(*compiled_groups(points, sizes.groups, sizes.group_size))

    def sequences(
        self, scene: EncodedScene, start: np.ndarray, goals: np.ndarray, beams: int = 3
    ) -> list[CodeSequence]:
        """The likeliest sequence to each goal; arguments and errors as of `hypotheses`."""
        return [found[0] for found in self.hypotheses(scene, start, goals, beams, every=False)]

    def hypotheses(
        self,
        scene: EncodedScene,
        start: np.ndarray,
        goals: np.ndarray,
        beams: int = 3,
        every: bool = True,
    ) -> list[list[CodeSequence]]:
        """The hypotheses to each goal, likeliest first, once all or the best are finished.

        Args:
            scene: of `encode`.
            start: (n,) [rad or m].
            goals: (k, n) [rad or m].
            beams: K, hypotheses kept for each goal.
            every: go on until all hypotheses are finished, not only the best.

        Raises:
            InvalidInputError: a start or goal is outside the joint limits, or beams is wrong.
        """
        start, goals = checked_ends(self.robot, start, goals)
        decoder = SequenceDecoder(self.network, scene, start, goals)
        return beam_search(decoder, beams=beams, max_length=LONGEST + 1, every=every)

    def goal_costs(self, scene: EncodedScene, start: np.ndarray, goals: np.ndarray) -> np.ndarray:
        """Cost (k,) [rad] of the shortest path over the roadmap from start (n,) to goals (k, n).

        A motion costs length - w log P(free). No sequence is decoded. Errors as of `hypotheses`.
        """
        start, goals = checked_ends(self.robot, start, goals)
        ends = self.network.ends(scene, np.vstack([start[None], goals]))
        own = Ends(*(part[:1] for part in ends))
        from_start = self.network.cost_to_go(scene, own)[0]
        return (from_start[ends.near[1:]] + ends.cost[1:]).min(axis=1)

    def rank(self, scene: EncodedScene, start: np.ndarray, goals: np.ndarray) -> np.ndarray:
        """Rows (k,) of goals (k, n) by increasing `goal_costs`."""
        return np.argsort(self.goal_costs(scene, start, goals), kind="stable")


def _near_points(
    cloud: np.ndarray,
    centre: tuple[float, float, float] = (0.0, 0.0, 0.33),
    farthest: float = 1.6,
) -> np.ndarray:
    """Points (p, 3) float32 of a cloud (m, 3) as near as in training, all in [m]."""
    if np.shape(cloud) == (0, 3):
        return np.empty((0, 3), dtype=np.float32)
    # a cloud needs two points to be checked for its extent; one is valid here
    points = checked_cloud(np.repeat(cloud, 2, axis=0) if np.shape(cloud) == (1, 3) else cloud)
    offset = points - np.array(centre, dtype=np.float32)
    near = np.einsum("pi,pi->p", offset, offset) <= farthest**2
    if not near.any():
        raise InvalidInputError(
            f"none of the cloud's {len(points)} points is within {farthest:g} m of {centre}: give "
            "it in metres, in the frame of the robot's base"
        )
    return points if near.all() else points[near]
