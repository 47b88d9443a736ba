"""The scene transformer at planning time, in numpy: same mathematics as `scene_transformer`, which trains it.

A new cloud is looked at from every code once. Codes of a sequence are then decoded step by step: attention keys and
values of earlier codes are kept, and logits are computed for the roadmap's ways on alone; other classes are impossible.
Tests compare all of it with torch.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from cvqmpt_lab.robot.kinematics import link_poses
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.vqmpt.sampler import CodeGraph, cheapest_ways
from cvqmpt_lab.vqmpt.weights import StoredModel, robot_signature

PART = "transformer"
RISK, UNREACHED, WORST, WAVES, LONGEST = 3.0, 30.0, 10.0, 5, 13  # as in `scene_transformer`
IMPOSSIBLE = -1e9  # logit of what is no way on
EPSILON = 1e-5  # of layer norms
QUEUE = 40  # entries of the queue a node


class Linear(NamedTuple):
    """x W^T + b."""

    weight: np.ndarray  # (inputs, outputs)
    bias: np.ndarray  # (outputs,)

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """Map (..., inputs) to (..., outputs)."""
        y = x @ self.weight
        y += self.bias
        return y


def gelu(x: np.ndarray) -> np.ndarray:
    """X Phi(x), in its form with tanh."""
    inner = x * x
    inner *= np.float32(0.7978845608 * 0.044715)
    inner += np.float32(0.7978845608)
    inner *= x
    np.tanh(inner, out=inner)
    inner += 1.0
    inner *= x
    inner *= np.float32(0.5)
    return inner


def softplus(x: np.ndarray) -> np.ndarray:
    """log(1 + e^x)."""
    return np.logaddexp(np.float32(0.0), x)


def softmax(x: np.ndarray) -> np.ndarray:
    """Over the last axis, in place."""
    x -= x.max(axis=-1, keepdims=True)
    np.exp(x, out=x)
    x /= x.sum(axis=-1, keepdims=True)
    return x


class Norm(NamedTuple):
    """Layer norm."""

    gain: np.ndarray  # (d,)
    offset: np.ndarray  # (d,)

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """Map (..., d) to the same shape."""
        y = x - x.mean(axis=-1, keepdims=True)
        y *= 1.0 / np.sqrt(
            np.einsum("...i,...i->...", y, y)[..., None] / np.float32(x.shape[-1]) + np.float32(EPSILON)
        )
        y *= self.gain
        y += self.offset
        return y


class Weights:
    """Layers by name."""

    def __init__(self, arrays: dict[str, np.ndarray]) -> None:
        self.arrays = arrays

    def linear(self, name: str) -> Linear:
        """A linear layer."""
        return Linear(np.ascontiguousarray(self.arrays[f"{name}.weight"].T), self.arrays[f"{name}.bias"])

    def norm(self, name: str) -> Norm:
        """A layer norm."""
        return Norm(self.arrays[f"{name}.weight"], self.arrays[f"{name}.bias"])


class Block:
    """Attention and a feed-forward block, as `scene_transformer.Block`."""

    def __init__(self, weights: Weights, name: str, heads: int) -> None:
        self.heads = heads
        self.norm, self.context_norm, self.inner_norm = (
            weights.norm(f"{name}.{which}") for which in ("norm", "context_norm", "inner_norm")
        )
        self.query, self.key_value, self.out, self.first, self.second = (
            weights.linear(f"{name}.{which}") for which in ("query", "key_value", "out", "first", "second")
        )

    def split(self, x: np.ndarray) -> np.ndarray:
        """(..., t, d) as (..., heads, t, d / heads)."""
        return np.moveaxis(x.reshape(*x.shape[:-1], self.heads, -1), -2, -3)

    def keys_values(self, normalised: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Keys and values (..., heads, t, d / heads) of tokens (..., t, d)."""
        k, v = np.split(self.key_value(normalised), 2, axis=-1)
        return self.split(k), self.split(v)

    def __call__(
        self, x: np.ndarray, keys: np.ndarray, values: np.ndarray, y: np.ndarray | None = None
    ) -> np.ndarray:
        """Map x (..., t, d), attending to all keys and values; y: x normalised, where that is known."""
        q = self.split(self.query(self.norm(x) if y is None else y))
        scores = q @ np.swapaxes(keys, -1, -2)
        scores *= np.float32(q.shape[-1] ** -0.5)
        heads = np.moveaxis(softmax(scores) @ values, -3, -2)
        x = x + self.out(heads.reshape(x.shape))
        x += self.second(gelu(self.first(self.inner_norm(x))))
        return x


@dataclass(frozen=True, eq=False)
class EncodedScene:
    """What is known of a scene, whatever start and goal; see `scene_transformer.Scenes`."""

    centres: np.ndarray  # (t, 3) [m]
    value: np.ndarray  # (t, 4 m + 4), read by body points
    bias: np.ndarray  # (k, t)
    codes: np.ndarray  # (N, d)
    keys: np.ndarray  # (N, d)
    parts: np.ndarray  # (N, e)
    node_odds: np.ndarray  # (N,)
    edge_odds: np.ndarray  # (E,)
    landmarks: tuple[tuple[np.ndarray, np.ndarray], ...]  # keys and values of each block that reads landmarks
    entered: np.ndarray  # (N, d), embeddings as the transformer takes them
    graph: CodeGraph


class SceneTransformerArrays:
    """A trained scene transformer for one robot."""

    def __init__(self, model: StoredModel, robot: Robot) -> None:
        """Take over its weights; InvalidInputError where they are missing or of another robot."""
        model.require_part(PART)
        model.robot.require_same(robot_signature(robot))
        self.config, self.robot = model.config.transformer, robot
        arrays = dict(model.parts[PART])
        w, sizes = Weights(arrays), self.config.sizes
        self.nodes, self.edges = arrays["nodes"].astype(np.float64), arrays["edges"]
        self._points = [w.linear(f"scene.points.{k}") for k in (0, 2, 4)]
        self._join, self._scene_block = w.linear("scene.join"), Block(w, "scene.block", 8)
        self._scene_norm = w.norm("scene.norm")
        self._embed = [w.linear(f"look.embed.{k}") for k in (0, 2)]
        self._mix = [w.linear(f"look.mix.{k}") for k in (0, 2)]
        self._own_norm, self._look_norm = w.norm("look.own_norm"), w.norm("look.norm")
        self._value, self._bias = w.linear("look.value"), w.linear("look.bias")
        self._sharpness = np.exp(arrays["look.sharpness"])
        self._node, self._part, self._middle, self._edge, self._link = (
            w.linear(name) for name in ("node", "part", "middle", "edge", "link")
        )
        self._enter, self._out, self._key, self._goal_key, self._gate = (
            w.linear(name) for name in ("enter", "out", "key", "goal_key", "gate")
        )
        self._norm = w.norm("norm")
        self._blocks = [Block(w, f"blocks.{k}", sizes.heads) for k in range(sizes.layers)]
        self._reads = [Block(w, f"reads.{k}", sizes.heads) for k in range(sizes.layers - 1)]
        self._arrays = arrays
        self._waves = (np.pi * 2.0 ** np.arange(WAVES)).astype(np.float32)
        features, self._node_points = self._configurations(self.nodes)
        self._node_embedding = self._embedded(features) + arrays["own"]
        self._node_normed = self._own_norm(self._node_embedding)
        self._tables()

    def _tables(self) -> None:
        """Arcs of the roadmap, for `cheapest_ways` and as a padded table of ways on."""
        count, edges = len(self.nodes), self.edges
        arcs = np.concatenate([edges, edges[:, ::-1]])
        order = np.lexsort((arcs[:, 1], arcs[:, 0]))
        first = np.searchsorted(arcs[order, 0], np.arange(count + 1))
        length = np.linalg.norm(self.nodes[edges[:, 0]] - self.nodes[edges[:, 1]], axis=1)
        self._length = length.astype(np.float32)
        self._graph = CodeGraph(
            self.nodes,
            np.ones(count),
            first.astype(np.int32),
            arcs[order, 1].astype(np.int32),
            (order % len(edges)).astype(np.int32),
            np.empty(len(edges)),
            RISK,
            np.empty(QUEUE * count),
            np.empty(QUEUE * count, dtype=np.int32),
        )
        degree = np.diff(first)
        column = np.arange(len(arcs)) - np.repeat(first[:-1], degree)
        self._neighbour = np.full((count, degree.max()), -1)
        self._edge_to = np.zeros_like(self._neighbour)
        row = arcs[order, 0]
        self._neighbour[row, column], self._edge_to[row, column] = arcs[order, 1], order % len(edges)

    def _configurations(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Features (u, f) and body points (u, k, 3) [m] of configurations q (u, n), float32."""
        body = self.config.body
        rotation, translation = link_poses(self.robot.kinematics, np.ascontiguousarray(q, dtype=float))
        rows = np.array(body.points) + 1  # pose row 0 is the world
        points = np.einsum("ukij,kj->uki", rotation[:, rows], body.offsets) + translation[:, rows]
        lower, upper = np.array(self.config.lower), np.array(self.config.upper)
        scaled = 2.0 * (q - lower) / (upper - lower) - 1.0
        features = np.concatenate([scaled, np.sin(q), np.cos(q), points.reshape(len(q), -1)], axis=1)
        return features.astype(np.float32), points.astype(np.float32)

    def _embedded(self, features: np.ndarray) -> np.ndarray:
        return self._embed[1](gelu(self._embed[0](features)))

    def _looked(
        self, scene: EncodedScene, embedding: np.ndarray, points: np.ndarray, normed: np.ndarray | None = None
    ) -> np.ndarray:
        """Embeddings (u, d) of configurations with body points (u, k, 3) that have looked at a scene."""
        u, k, m = len(points), points.shape[1], self.config.sizes.values
        mixed = np.empty((u, k * (m + 1)), dtype=np.float32)
        for j in range(k):
            p = np.ascontiguousarray(points[:, j])
            scores = (np.float32(2.0) * self._sharpness[j] * p) @ scene.centres.T
            scores += scene.bias[j]
            scores -= scores.max(axis=1, keepdims=True)
            np.exp(scores, out=scores)
            read = scores @ scene.value
            read /= read[:, -1:]  # the last column of values is 1
            own = slice(j * (m + 1), j * (m + 1) + m)
            mixed[:, own] = read[:, :m] + np.einsum("uam,ua->um", read[:, m : 4 * m].reshape(u, 3, m), p)
            away = read[:, 4 * m] + np.einsum("ua,ua->u", read[:, 4 * m + 1 : 4 * m + 4] + p, p)
            mixed[:, own.stop] = 5.0 * np.sqrt(np.maximum(away, 0.0) + np.float32(1e-4))
        normed = self._own_norm(embedding) if normed is None else normed
        hidden = gelu(self._mix[0](np.concatenate([mixed, normed], axis=1)))
        return self._look_norm(embedding + self._mix[1](hidden))

    def encode(self, centres: np.ndarray, offsets: np.ndarray) -> EncodedScene:
        """Look at a scene, given as groups of points (see `grouped_points`), from every code."""
        relu = lambda x: np.maximum(x, 0.0, out=x)  # noqa: E731
        x = relu(self._points[0](offsets.reshape(-1, 3) * np.float32(5.0)))
        shape = self._points[2](relu(self._points[1](x))).reshape(*offsets.shape[:2], -1).max(axis=1)
        angle = (centres[..., None] * self._waves).reshape(len(centres), -1)
        tokens = self._join(np.concatenate([shape, centres, np.sin(angle), np.cos(angle)], axis=1))
        block = self._scene_block
        tokens = self._scene_norm(block(tokens, *block.keys_values(block.norm(tokens))))
        squared = np.einsum("ti,ti->t", centres, centres)[:, None]
        value = np.concatenate([self._value(tokens), squared, -2.0 * centres, np.ones_like(squared)], axis=1)
        bias = self._bias(tokens).T - self._sharpness[:, None] * squared.T
        none = np.empty(0, dtype=np.float32)
        bare = EncodedScene(centres, value, bias, none, none, none, none, none, (), none, self._graph)
        codes = self._looked(bare, self._node_embedding, self._node_points, self._node_normed)
        parts = self._part(codes)
        pairs = np.take(parts, self.edges[:, 0], axis=0)
        pairs += np.take(parts, self.edges[:, 1], axis=0)
        pairs += self._arrays["own_edge"]
        edge_odds = self._edge(relu(pairs))[:, 0] + self._arrays["edge_prior"]
        landmarks = codes[:: self.config.sizes.stride]
        return replace(
            bare,
            codes=codes,
            keys=self._key(codes) + self._arrays["own_key"],
            parts=parts,
            node_odds=self._node(codes)[:, 0] + self._arrays["node_prior"],
            edge_odds=edge_odds,
            landmarks=tuple(read.keys_values(read.context_norm(landmarks)) for read in self._reads),
            entered=self._enter(codes) + self._arrays["kind"][2],
            graph=self._graph._replace(nll=softplus(-edge_odds).astype(np.float64)),
        )

    def ends(self, scene: EncodedScene, q: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Of starts or goals q (u, n) [rad]: embeddings (u, d), codes near (u, l) and cost to each (u, l) [rad]."""
        squares = ((q[:, None] - self.nodes) ** 2).sum(-1)
        near = np.argpartition(squares, self.config.sizes.links, axis=1)[:, : self.config.sizes.links]
        half_way = 0.5 * (q[:, None] + self.nodes[near])
        features, points = self._configurations(np.concatenate([q, half_way.reshape(-1, q.shape[1])]))
        looked = self._looked(scene, self._embedded(features), points)
        seen, middle = looked[: len(q)], looked[len(q) :].reshape(*near.shape, -1)
        x = self._middle(middle) + self._part(seen)[:, None] + scene.parts[near]
        odds = self._link(np.maximum(x, 0.0))[..., 0]
        length = np.sqrt(np.take_along_axis(squares, near, axis=1))
        return seen, near, length + RISK * softplus(-odds)

    def cost_to_go(self, scene: EncodedScene, near: np.ndarray, cost: np.ndarray) -> np.ndarray:
        """V (g, N) [rad]: cost of the cheapest way from every code to goals, whose links are near, cost (g, l)."""
        V, parent = (
            np.full((len(near), len(self.nodes)), UNREACHED),
            np.empty(len(self.nodes), dtype=np.int32),
        )
        for row, codes, costs in zip(V, near, cost, strict=True):
            row[codes] = np.minimum(costs, UNREACHED)
            cheapest_ways(scene.graph, row, parent)
        return V

    def decoder(self, scene: EncodedScene, start: np.ndarray, goals: np.ndarray) -> "SequenceDecoder":
        """What `beam_search` asks for sequences from start (n,) to each of goals (k, n) [rad]."""
        return SequenceDecoder(self, scene, start, goals)


class SequenceDecoder:
    """Step-by-step logits of a start and k goals, a `beam_search.StepDecoder`."""

    def __init__(
        self, model: SceneTransformerArrays, scene: EncodedScene, start: np.ndarray, goals: np.ndarray
    ) -> None:
        self._model, self._scene = model, scene
        seen, near, cost = model.ends(scene, np.vstack([start[None], goals]))
        self._near, self._cost = near, cost
        self.V = model.cost_to_go(scene, near[1:], cost[1:])  # (k, N) [rad]
        self._link = np.full((len(goals), len(model.nodes)), np.inf)
        np.put_along_axis(self._link, near[1:], cost[1:], axis=1)
        arrays, enter = model._arrays, model._enter
        self._goal_key = model._goal_key(seen[1:])
        goal, first = enter(seen[1:]) + arrays["kind"][0], enter(seen[:1]) + arrays["kind"][1]
        self._prefix = np.stack([goal, np.broadcast_to(first, goal.shape)], axis=1) + arrays["place"][:2]
        self._kept: list[tuple[np.ndarray, np.ndarray]] = []
        self._goal = np.arange(len(goals))  # of each row

    def start(self) -> np.ndarray:
        """Logits (k, N + 2) of the first code."""
        model, x = self._model, self._prefix
        for number, block in enumerate(model._blocks):
            y = block.norm(x)
            keys, values = block.keys_values(y)
            self._kept.append((keys, values))
            # The goal's token attends to itself alone.
            alone = block(x[:, :1], keys[:, :, :1], values[:, :, :1], y[:, :1])
            x = np.concatenate([alone, block(x[:, 1:], keys, values, y[:, 1:])], axis=1)
            x = self._read(number, x)
        pointer, gate = self._pointer(x[:, 1])
        near, first = self._near[0], self._cost[0] + self.V[:, self._near[0]]
        logits = np.full((len(x), len(model.nodes) + 2), IMPOSSIBLE, dtype=np.float32)
        excess = np.minimum(first - first.min(axis=1, keepdims=True), WORST)
        logits[:, near] = pointer @ self._scene.keys[near].T + model._arrays["way"] - gate * excess
        return logits

    def advance(self, parents: np.ndarray, codes: np.ndarray) -> np.ndarray:
        """Logits (rows, N + 2) of what follows codes (rows,), which continue the rows `parents`."""
        model, scene = self._model, self._scene
        self._goal = self._goal[parents]
        place = self._kept[0][0].shape[2]
        if place >= len(model._arrays["place"]):
            raise IndexError(f"sequences of more than {LONGEST} codes")
        x = (scene.entered[codes] + model._arrays["place"][place])[:, None]
        for number, block in enumerate(model._blocks):
            y = block.norm(x)
            new = block.keys_values(y)
            keys, values = (
                np.concatenate([kept[parents], added], axis=2)
                for kept, added in zip(self._kept[number], new, strict=True)
            )
            self._kept[number] = keys, values
            x = self._read(number, block(x, keys, values, y))
        pointer, gate = self._pointer(x[:, 0])
        neighbour, edge = model._neighbour[codes], model._edge_to[codes]
        here, way = self.V[self._goal, codes], model._arrays["way"]
        arcs = model._length[edge] + RISK * scene.graph.nll[edge]
        advantage = arcs + self.V[self._goal[:, None], neighbour] - here[:, None]
        odds = np.einsum("rd,rwd->rw", pointer, scene.keys[neighbour])
        odds += way - gate * np.clip(advantage, 0.0, WORST)
        logits = np.full((len(codes), len(model.nodes) + 2), IMPOSSIBLE, dtype=np.float32)
        logits[np.arange(len(codes))[:, None], neighbour] = np.where(
            neighbour < 0, IMPOSSIBLE, odds
        )  # padding: -1
        link = self._link[self._goal, codes]
        leads = np.isfinite(link)
        extra = np.clip(np.where(leads, link, 0.0) - here, 0.0, WORST)
        to_goal = np.einsum("rd,rd->r", pointer, self._goal_key[self._goal]) + model._arrays["goal_bias"]
        logits[:, -2] = IMPOSSIBLE
        logits[:, -1] = np.where(leads, to_goal + way - gate[:, 0] * extra, IMPOSSIBLE)
        return logits

    def _read(self, number: int, x: np.ndarray) -> np.ndarray:
        """Let tokens x (rows, t, d) attend to the landmarks, where there is a block for it."""
        reads = self._model._reads
        return x if number >= len(reads) else reads[number](x, *self._scene.landmarks[number])

    def _pointer(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pointers (rows, d), scaled, and gates (rows, 1) of tokens (rows, d)."""
        x = self._model._norm(x)
        pointer = self._model._out(x)
        pointer *= np.float32(pointer.shape[-1] ** -0.5)
        return pointer, softplus(self._model._gate(x))
