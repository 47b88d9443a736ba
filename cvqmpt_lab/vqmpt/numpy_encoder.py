"""Encoder of the scene transformer in numpy: embeddings of a cloud, of starts and of goals.

It computes the same as the torch module `scene_transformer`, which explains the model; tests
compare both. The dictionary's codes attend to a cloud once, when it is encoded. Starts and goals
attend later to the tokens of the encoded cloud. `numpy_decoder` predicts sequences of codes.
"""

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.base.heap import drop_smallest, push
from cvqmpt_lab.base.jit import entry, kernel
from cvqmpt_lab.robot.kinematics import link_poses
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.vqmpt.config import SceneTransformerConfig
from cvqmpt_lab.vqmpt.numpy_layers import Block, Layers, Linear, gelu, relu, softplus
from cvqmpt_lab.vqmpt.transformer_inputs import Ends, arcs_of
from cvqmpt_lab.vqmpt.weights import TRANSFORMER, StoredModel, robot_signature


@dataclass(frozen=True, eq=False)
class EncodedScene:
    """Encoding of a scene, which does not depend on start and goal; see `scene_transformer`."""

    # keys (k, 4, t), multiplied by (2 beta p, 1), and values (t, 4 m + 5): v, V, |c|^2, -2 c, 1
    tokens: tuple[np.ndarray, np.ndarray]
    keys: np.ndarray  # (N, d), keys of the codes, for pointers
    parts: np.ndarray  # (N, e), inputs of P(edge free) at the edge's ends
    entered: np.ndarray  # (N, d), embedded codes as inputs of the causal transformer
    arc_cost: np.ndarray  # (N, w) [rad], length - w log P(free) of the edge to each neighbour
    landmarks: tuple[tuple[np.ndarray, np.ndarray], ...]  # keys and values for each block


class SceneNetwork:
    """The scene transformer's layers for one robot: encodes scenes, starts and goals."""

    def __init__(self, model: StoredModel, robot: Robot) -> None:
        """Copy the weights; InvalidInputError if they do not fit the robot or the configuration."""
        model.require_part(TRANSFORMER)
        model.robot.require_same(robot_signature(robot))
        if model.config.transformer is None:
            raise InvalidInputError(
                "the model has a transformer, but its configuration describes none"
            )
        self.config: SceneTransformerConfig = model.config.transformer
        self.robot = robot
        sizes = self.config.sizes
        self.nodes, self.edges = _roadmap(model, self.config)
        self.neighbour, self._edge_of_arc = arcs_of(len(self.nodes), self.edges)
        ends = self.nodes[self.edges]
        self._length = np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1)  # (E,) [rad]
        entries = 40 * len(self.nodes)  # size of the queue of `shortest_paths`
        self._heap = np.empty(entries), np.empty(entries, dtype=np.int32)
        d, e, heads, values = sizes.width, sizes.edge_width, sizes.heads, sizes.values
        points = len(self.config.body.points)
        read = points * (values + 1)  # numbers that all body points read
        layers = Layers(model, TRANSFORMER)  # not stored, since it holds all arrays of the model
        widths = {
            "scene.points.0": (3, 64),
            "scene.points.2": (64, 64),
            "scene.points.4": (64, 128),
            "scene.join": (128 + 3 + 6 * self.config.position_waves, d),
            "look.embed.0": (self.config.features, 2 * d),
            "look.embed.2": (2 * d, d),
            "look.mix.0": (read + d, 2 * d),
            "look.mix.2": (2 * d, d),
            "look.value": (d, 4 * values),
            "look.bias": (d, points),
            "part": (d, e),
            "middle": (d, e),
            "edge": (e, 1),
            "link": (e, 1),
            "enter": (d, d),
            "key": (d, d),
            "out": (d, d),
            "gate": (d, 1),
            "goal_key": (d, d),
        }
        self.linear = {name: layers.linear(name, *sides) for name, sides in widths.items()}
        norms = ("scene.norm", "look.own_norm", "look.norm", "norm")
        self.norm = {name: layers.norm(name, d) for name in norms}
        shapes = {
            "own": (len(self.nodes), d),
            "own_key": (len(self.nodes), d),
            "own_edge": (len(self.edges), e),
            "edge_prior": (len(self.edges),),
            "kind": (3, d),
            "place": (self.config.max_codes + 2, d),
            "goal_bias": (1,),
            "look.sharpness": (points,),
        }
        self.array = {name: layers.array(name, *shape) for name, shape in shapes.items()}
        self._scene_block = Block(layers, "scene.block", d, 8, 4 * d)
        blocks = range(sizes.layers)
        self.blocks = [Block(layers, f"blocks.{k}", d, heads, 4 * d) for k in blocks]
        self.reads = [
            Block(layers, f"reads.{k}", d, heads, 2 * d, context=True) for k in blocks[:-1]
        ]
        # this layer is split: what it adds for the embeddings of codes is the same in every scene
        weight, bias = self.linear.pop("look.mix.0")
        self._mix_read = weight[:read].copy()
        self._mix_own = Linear(weight[read:].copy(), bias)
        self._sharpness = np.exp(self.array["look.sharpness"])  # (k,), beta [1 / m^2]
        # the nodes of the codes are the same in every scene, so their inputs are computed once
        self._node_inputs = self._inputs(self.nodes, self.array["own"])

    def _inputs(self, q: np.ndarray, own: np.ndarray | None = None) -> tuple[np.ndarray, ...]:
        """Compute the inputs of geometric attention that do not depend on the scene.

        Args:
            q: (u, n) [rad or m].
            own: (u, d), learned addition to the embeddings of codes; None for other configurations.

        Returns:
            Embeddings (u, d); body points p (u, k, 3) [m]; queries (2 beta p, 1) (k, u, 4); the
            part of the mixing layer that depends on the embeddings (u, 2 d). All are float32.
        """
        body = self.config.body
        rotation, translation = link_poses(
            self.robot.kinematics, np.ascontiguousarray(q, dtype=float)
        )
        rows = np.array(body.points) + 1  # pose row 0 is the world
        rotated = np.matmul(rotation[:, rows], body.offsets[:, :, None])[..., 0]
        positions = rotated + translation[:, rows]
        lower, upper = np.array(self.config.lower), np.array(self.config.upper)
        scaled = 2.0 * (q - lower) / (upper - lower) - 1.0
        parts = [scaled, np.sin(q), np.cos(q), positions.reshape(len(q), -1)]
        features = np.concatenate(parts, axis=1).astype(np.float32)
        points = np.ascontiguousarray(positions, dtype=np.float32)
        embedding = self.linear["look.embed.2"](gelu(self.linear["look.embed.0"](features)))
        if own is not None:
            embedding += own
        queries = np.ones((points.shape[1], len(points), 4), dtype=np.float32)
        scale = (np.float32(2.0) * self._sharpness)[:, None, None]
        queries[..., :3] = scale * points.transpose(1, 0, 2)
        return embedding, points, queries, self._mix_own(self.norm["look.own_norm"](embedding))

    def _attend(
        self, tokens: tuple[np.ndarray, np.ndarray], inputs: tuple[np.ndarray, ...]
    ) -> np.ndarray:
        """Compute embeddings (u, d) by geometric attention to a scene's tokens.

        tokens: see `EncodedScene`; inputs: see `_inputs`.
        """
        keys, values = tokens
        embedding, points, queries, own = inputs
        k, u, m = len(queries), len(points), self.config.sizes.values
        read = np.empty((k, u, values.shape[1]), dtype=np.float32)
        scores = np.empty((u, len(values)), dtype=np.float32)
        for j in range(k):
            np.matmul(queries[j], keys[j], out=scores)
            # avoids overflow; `gather_reads` normalises the weights
            scores -= scores.max(axis=1, keepdims=True)
            np.exp(scores, out=scores)
            np.matmul(scores, values, out=read[j])
        mixed = np.empty((u, k * (m + 1)), dtype=np.float32)
        gather_reads(read, points, mixed)
        hidden = mixed @ self._mix_read
        hidden += own
        attended = self.linear["look.mix.2"](gelu(hidden))
        attended += embedding
        return self.norm["look.norm"](attended)

    def _tokens(
        self, centres: np.ndarray, offsets: np.ndarray, batch: int = 16
    ) -> tuple[np.ndarray, np.ndarray]:
        """Compute keys and values of groups of points, see `EncodedScene`.

        batch: number of groups at a time, so that they fit the processor's cache.
        """
        first, second, third = (self.linear[f"scene.points.{k}"] for k in (0, 2, 4))
        shape = np.empty((len(centres), len(third.bias)), dtype=np.float32)
        for begin in range(0, len(centres), batch):
            part = offsets[begin : begin + batch]
            x = relu(second(relu(first(part.reshape(-1, 3) * np.float32(5.0)))))
            x = (x @ third.weight).reshape(*part.shape[:2], -1)
            np.max(x, axis=1, out=shape[begin : begin + batch])
        shape += third.bias
        waves = (np.pi * 2.0 ** np.arange(self.config.position_waves)).astype(np.float32)
        angle = (centres[..., None] * waves).reshape(len(centres), -1)
        x = np.concatenate([shape, centres, np.sin(angle), np.cos(angle)], axis=1)
        x = self.linear["scene.join"](x)
        block = self._scene_block
        tokens = self.norm["scene.norm"](block.attend(x, *block.keys_values(x)))
        squared = np.einsum("ti,ti->t", centres, centres)
        keys = np.empty((len(self._sharpness), 4, len(centres)), dtype=np.float32)
        keys[:, :3] = centres.T
        bias = self.linear["look.bias"](tokens).T
        keys[:, 3] = bias - self._sharpness[:, None] * squared
        # with the column of ones, the sum of the weights is computed along with the values
        ones = np.ones((len(centres), 1), dtype=np.float32)
        value = self.linear["look.value"](tokens)
        values = [value, squared[:, None], np.float32(-2.0) * centres, ones]
        return keys, np.concatenate(values, axis=1)

    def encode(self, centres: np.ndarray, offsets: np.ndarray) -> EncodedScene:
        """Encode a scene for all codes.

        Args:
            centres: (t, 3) [m], see `group_points`.
            offsets: (t, m, 3) [m], see `group_points`.
        """
        tokens = self._tokens(centres, offsets)
        codes = self._attend(tokens, self._node_inputs)
        parts = self.linear["part"](codes)
        pairs = np.take(parts, self.edges[:, 0], axis=0)
        pairs += np.take(parts, self.edges[:, 1], axis=0)
        pairs += self.array["own_edge"]
        odds = self.linear["edge"](relu(pairs))[:, 0] + self.array["edge_prior"]
        # log P(free) = -softplus(-odds)
        cost = self._length + self.config.collision_cost * softplus(-odds)
        # attention to every stride-th code costs less than attention to all
        landmarks = codes[:: self.config.sizes.stride]
        return EncodedScene(
            tokens,
            self.linear["key"](codes) + self.array["own_key"],
            parts,
            self.entered(codes, 2),
            cost[self._edge_of_arc],
            tuple(read.keys_values(landmarks) for read in self.reads),
        )

    def ends(self, scene: EncodedScene, q: np.ndarray) -> Ends:
        """Embed starts or goals q (u, n) [rad], and predict P(free) of motions to nearby codes."""
        links = self.config.sizes.links
        squares = ((q[:, None] - self.nodes) ** 2).sum(-1)
        near = np.argpartition(squares, links - 1, axis=1)[:, :links]
        midpoints = 0.5 * (q[:, None] + self.nodes[near])
        states = np.concatenate([q, midpoints.reshape(-1, q.shape[1])])
        embeddings = self._attend(scene.tokens, self._inputs(states))
        embedding = embeddings[: len(q)]
        middle = self.linear["middle"](embeddings[len(q) :]).reshape(*near.shape, -1)
        middle += self.linear["part"](embedding)[:, None]
        middle += scene.parts[near]
        odds = self.linear["link"](relu(middle).reshape(-1, middle.shape[-1])).reshape(near.shape)
        length = np.sqrt(np.take_along_axis(squares, near, axis=1))
        return Ends(embedding, near, length + self.config.collision_cost * softplus(-odds))

    def cost_to_go(self, scene: EncodedScene, ends: Ends) -> np.ndarray:
        """Cost V (u, N) [rad] of the shortest path from every code to each end.

        It is at most `SceneTransformerConfig.unreached_cost`.
        """
        V = np.full((len(ends.near), len(self.nodes)), np.inf)
        np.put_along_axis(V, ends.near, ends.cost, axis=1)
        shortest_paths(self.neighbour, scene.arc_cost, V, *self._heap)
        return np.minimum(V, self.config.unreached_cost)

    def entered(self, embeddings: np.ndarray, kind: int) -> np.ndarray:
        """Map embeddings (u, d) to inputs of the causal transformer.

        kind: 0 for goals, 1 for starts, 2 for codes.
        """
        return self.linear["enter"](embeddings) + self.array["kind"][kind]


def _roadmap(model: StoredModel, config: SceneTransformerConfig) -> tuple[np.ndarray, np.ndarray]:
    """Read nodes (N, n) float64 [rad] and edges (E, 2) int64, which must fit the dictionary."""
    count, codes = config.n_nodes, model.config.dictionary.n_codes
    if count != codes:
        raise InvalidInputError(
            f"{TRANSFORMER} is for {count} codes, the dictionary has {codes}; train it again"
        )
    for name in ("lower", "upper"):
        if not np.allclose(getattr(config, name), getattr(model.robot, name), atol=1e-6, rtol=0.0):
            raise InvalidInputError(
                f"{TRANSFORMER} was made with other {name} limits than its weights' robot; train "
                "it again"
            )
    nodes = model.array(TRANSFORMER, "nodes", count, config.joint_dim)
    edges = model.parts[TRANSFORMER].get("edges")
    if edges is None or edges.shape != (config.n_edges, 2) or edges.dtype.kind not in "iu":
        found = "missing" if edges is None else f"{edges.shape} of {edges.dtype}"
        raise InvalidInputError(
            f"{TRANSFORMER} does not fit its configuration: edges is {found}, expected "
            f"({config.n_edges}, 2)"
        )
    if edges.min() < 0 or edges.max() >= count or (edges[:, 0] == edges[:, 1]).any():
        raise InvalidInputError(
            f"{TRANSFORMER} has edges that do not join two of its {count} nodes"
        )
    return nodes, edges.astype(np.int64)


def compiled_groups(points: np.ndarray, groups: int, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Divide points (m, 3) float32 [m] into groups like `group_points`, in compiled code."""
    points = points[np.arange(max(len(points), size + 1)) % len(points)]
    centres = np.empty((groups, 3), np.float32)
    offsets = np.empty((groups, size, 3), np.float32)
    to_chosen, to_centre = np.empty((2, len(points)), np.float32)
    transposed = np.ascontiguousarray(points.T)
    fill_groups(transposed, centres, offsets, to_chosen, to_centre, np.empty(size, np.int64))
    return centres, offsets


@entry
def fill_groups(
    points: Annotated[np.ndarray, "float32 3 p"],
    centres: Annotated[np.ndarray, "float32 groups 3"],
    offsets: Annotated[np.ndarray, "float32 groups size 3"],
    to_chosen: Annotated[np.ndarray, "float32 p"],
    to_centre: Annotated[np.ndarray, "float32 p"],
    members: Annotated[np.ndarray, "int64 size"],
):
    """Divide points into groups like `transformer_inputs.group_points`.

    Args:
        points: coordinates [m].
        centres: written, centres of the groups [m].
        offsets: written, points of each group relative to its centre [m].
        to_chosen: work array, squared distances to the nearest centre.
        to_centre: work array, squared distances to the last centre.
        members: work array, the points of a group.
    """
    count, size = points.shape[1], members.shape[0]
    for i in range(count):
        to_chosen[i] = np.float32(np.inf)
    centre = 0
    for g in range(centres.shape[0]):
        x, y, z = points[0, centre], points[1, centre], points[2, centre]
        centres[g, 0], centres[g, 1], centres[g, 2] = x, y, z
        for i in range(count):
            a, b, c = points[0, i] - x, points[1, i] - y, points[2, i] - z
            to_centre[i] = a * a + b * b + c * c
            to_chosen[i] = to_centre[i] if to_centre[i] < to_chosen[i] else to_chosen[i]
        # start with the first points, and replace the farthest member by each nearer point
        for i in range(size):
            members[i] = i
        worst = _farthest(to_centre, members)
        for i in range(size, count):
            if to_centre[i] < to_centre[members[worst]]:
                members[worst] = i
                worst = _farthest(to_centre, members)
        centre = 0
        for i in range(count):
            if to_chosen[i] > to_chosen[centre]:
                centre = i
        for k in range(size):
            for axis in range(3):
                offsets[g, k, axis] = points[axis, members[k]] - centres[g, axis]


@kernel
def _farthest(to_centre, members):
    """Index of the farthest member."""
    worst = 0
    for k in range(1, members.shape[0]):
        if to_centre[members[k]] > to_centre[members[worst]]:
            worst = k
    return worst


@entry
def gather_reads(
    read: Annotated[np.ndarray, "float32 k u columns"],
    points: Annotated[np.ndarray, "float32 u k 3"],
    mixed: Annotated[np.ndarray, "float32 u numbers"],
):
    """Normalise what body points p read from the tokens j: sum_j w_j (v_j + V_j p), and a distance.

    The distance is 5 sqrt(sum_j w_j |p - c_j|^2 + 1e-4).

    Args:
        read: sums over tokens with unnormalised weights; the last column is the weights' sum.
        points: body points p [m].
        mixed: written, m values and the distance of each body point.
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


@entry
def shortest_paths(
    neighbour: Annotated[np.ndarray, "int32 nodes w"],
    arc_cost: Annotated[np.ndarray, "nodes w"],
    cost: Annotated[np.ndarray, "ends nodes"],
    heap: Annotated[np.ndarray, "queue"],
    heap_node: Annotated[np.ndarray, "int32 queue"],
):
    """Compute costs of shortest paths between each end and every node, by Dijkstra's algorithm.

    Args:
        neighbour: node at the end of each arc, padded with the node itself.
        arc_cost: costs of the arcs [rad].
        cost: costs of the links from each end to nodes, inf if there is none [rad]; they are
            overwritten by the costs of shortest paths.
        heap: work array, costs in the queue.
        heap_node: work array, nodes in the queue.
    """
    for end in range(cost.shape[0]):
        known, size = cost[end], 0
        for i in range(cost.shape[1]):
            if known[i] < np.inf:
                push(heap, heap_node, size, known[i], i)
                size += 1
        while size > 0:
            least, here = heap[0], np.int64(heap_node[0])
            drop_smallest(heap, heap_node, size)
            size -= 1
            # a shorter path to this node was found after the entry was added
            if least > known[here]:
                continue
            for arc in range(neighbour.shape[1]):
                there = np.int64(neighbour[here, arc])
                if there == here:
                    break
                more = least + arc_cost[here, arc]
                if more < known[there] and size < heap.shape[0]:
                    known[there] = more
                    push(heap, heap_node, size, more, there)
                    size += 1
