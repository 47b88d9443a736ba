"""From a cloud, a start and goals to sequences of codes h_1 ... h_n, by a sequence model.

scene = predictor.encode(cloud)
goals = predictor.by_cost(scene, start, goals)[:3]
beams = predictor.hypotheses(scene, start, goals)

The scene transformer needs no torch, the authors' network does. Codes are decoded step by step, all
hypotheses of all goals in one batch; the scene transformer keeps attention keys and values of
earlier codes, and computes logits of the roadmap's successors alone: other classes are impossible.
"""

from abc import ABC, abstractmethod
from typing import Any, ClassVar

import numpy as np

from cvqmpt_lab.base.caches import LruCache
from cvqmpt_lab.base.errors import require_installed
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.sensing.observation import CameraSettings, thinned
from cvqmpt_lab.vqmpt.beam_search import CodeSequence, beam_search, log_softmax
from cvqmpt_lab.vqmpt.codebook import ModelConfigurations, require_own_dictionary
from cvqmpt_lab.vqmpt.scene_arrays import LONGEST, NOWHERE, WORST, Ends, softplus
from cvqmpt_lab.vqmpt.scene_network import EncodedScene, SceneNetwork, fill_groups
from cvqmpt_lab.vqmpt.weights import StoredModel


class SequencePredictor(ABC):
    """A sequence model with its weights, for one robot."""

    each_code_once: ClassVar[bool]  # whether codes that sequences repeat count once

    def __init__(self, scenes: int = 8) -> None:
        self._scenes = LruCache[Any](scenes)

    def encode(self, cloud: np.ndarray, use_cache: bool = True) -> Any:
        """Encode a cloud (m, 3) [m, robot base frame]; the last few are cached."""
        points = np.ascontiguousarray(cloud, dtype=np.float32)
        return self._scenes.get(points.tobytes(), lambda: self._encoded(points), use_cache)

    @abstractmethod
    def _encoded(self, points: np.ndarray) -> Any:
        """Encode points (m, 3) float32 [m]."""

    def by_cost(self, scene: Any, start: np.ndarray, goals: np.ndarray) -> np.ndarray:
        """Goals (k, n), the cheapest first; here the nearest to the start (n,)."""
        distances = np.linalg.norm(goals - start, axis=1)
        return goals[np.argsort(distances, kind="stable")]

    @abstractmethod
    def hypotheses(
        self, scene: Any, start: np.ndarray, goals: np.ndarray, *, every: bool = False
    ) -> list[list[CodeSequence]]:
        """The beam's sequences to each goal, likeliest first.

        Args:
            scene: of `encode`.
            start: (n,) [rad or m].
            goals: (k, n) [rad or m].
            every: go on until all hypotheses are finished, not only the best.
        """


class SceneTransformerPredictor(SequencePredictor):
    """A trained scene transformer."""

    each_code_once = True

    def __init__(self, model: StoredModel, robot: Robot) -> None:
        """Take over the weights; InvalidInputError if robot, dictionary or sizes do not fit."""
        super().__init__()
        self.network = SceneNetwork(model, robot)
        require_own_dictionary(model)

    def _encoded(self, points: np.ndarray, most_points: int = 1024) -> EncodedScene:
        """Encode points; larger clouds than in training are thinned evenly."""
        sizes = self.network.config.sizes
        if len(points) == 0:
            points = np.array([NOWHERE], dtype=np.float32)  # far below the robot, as in training
        if len(points) > most_points:
            settings = CameraSettings.like_training(most_points, noise=0.0)
            points = thinned(points, settings, np.random.default_rng(0)).astype(np.float32)
        return self.network.encode(*compiled_groups(points, sizes.groups, sizes.group_size))

    def goal_costs(self, scene: EncodedScene, start: np.ndarray, goals: np.ndarray) -> np.ndarray:
        """Cost (k,) [rad] of the shortest path over the roadmap from start (n,) to goals (k, n).

        A motion costs length - w log P(free). No sequence is decoded.
        """
        ends = self.network.ends(scene, np.vstack([start[None], goals]))
        own = Ends(*(part[:1] for part in ends))
        from_start = self.network.cost_to_go(scene, own)[0]
        return (from_start[ends.near[1:]] + ends.cost[1:]).min(axis=1)

    def by_cost(self, scene: EncodedScene, start: np.ndarray, goals: np.ndarray) -> np.ndarray:
        """Goals (k, n) by increasing `goal_costs`: the way to a near one may be blocked."""
        return goals[np.argsort(self.goal_costs(scene, start, goals), kind="stable")]

    def hypotheses(
        self,
        scene: EncodedScene,
        start: np.ndarray,
        goals: np.ndarray,
        *,
        every: bool = False,
        beams: int = 3,
    ) -> list[list[CodeSequence]]:
        """As `SequencePredictor.hypotheses`; beams: K, hypotheses kept for each goal."""
        decoder = SequenceDecoder(self.network, scene, start, goals)
        return beam_search(decoder, beams=beams, max_length=LONGEST + 1, every=every)


class PublishedPredictor(SequencePredictor):
    """A trained model of the authors' architecture."""

    each_code_once = False

    def __init__(self, model: StoredModel, robot: Robot) -> None:
        """Copy a model's weights; InvalidInputError if they do not fit the robot or their sizes."""
        super().__init__()
        model.require_part("sequence_model")
        require_installed("torch", "a sequence model of kind 'published'", "train")
        from cvqmpt_lab.vqmpt.checkpoint import as_modules

        self._configurations, modules = ModelConfigurations(model, robot), as_modules(model).modules
        self._dictionary, self._network = modules["dictionary"], modules["sequence_model"]
        self._length = model.config.stage2[1].max_length

    def _encoded(self, points: np.ndarray) -> Any:
        """Scene tokens; InvalidInputError: fewer than two points."""
        return self._network.encode_cloud(points)

    def hypotheses(
        self, scene: Any, start: np.ndarray, goals: np.ndarray, *, every: bool = False
    ) -> list[list[CodeSequence]]:
        """As `SequencePredictor.hypotheses`, by the rules of the authors' beam search."""
        ends = self._configurations.normalised(np.vstack((start[None], goals))).astype(np.float32)
        starts = ends[:1].repeat(len(goals), axis=0)
        decoder = self._network.decoder(self._dictionary, scene, starts, ends[1:])
        return beam_search(decoder, max_length=self._length, every=every, published=True)


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
        self._goal_keys = network.linear["goal_key"](ends.embedding)
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
        goal = self._goal[parents]
        self._goal = goal
        # keys and values follow their hypothesis when the beam is reordered
        self._caches = [None if cache is None else cache[parents] for cache in self._caches]
        pointer, gate = self._step(scene.entered[codes])
        following, here = network.neighbour[codes], self.V[goal, codes][:, None]
        excess = scene.arc_cost[codes].astype(np.float32) + self.V[goal[:, None], following] - here
        logits = np.empty((len(codes), following.shape[1] + 1), dtype=np.float32)
        logits[:, :-1] = np.matmul(scene.keys[following], pointer[:, :, None])[..., 0]
        logits[:, :-1] -= gate * np.clip(excess, np.float32(0.0), np.float32(WORST))
        logits[:, :-1][following == codes[:, None]] = -np.inf  # padding
        link = self._link[goal, codes][:, None]  # the goal token needs a link to the goal
        leads = np.isfinite(link)
        excess = np.where(leads, link, 0.0) - here
        extra = gate * np.clip(excess, np.float32(0.0), np.float32(WORST))
        to_goal = np.einsum("rd,rd->r", pointer, self._goal_keys[goal])[:, None]
        to_goal = to_goal + network.array["goal_bias"]
        logits[:, -1:] = np.where(leads, to_goal - extra, -np.inf)
        goal_class = np.full((len(codes), 1), len(network.nodes), dtype=following.dtype)
        return np.concatenate([following, goal_class], axis=1), log_softmax(logits)

    def _step(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Scaled pointers t (r, d) and gates g (r, 1) after each row's next token, x (r, d)."""
        network, landmarks = self._network, self._scene.landmarks
        x = x + network.array["place"][self._place]
        self._place += 1
        for number, block in enumerate(network.blocks):
            x, self._caches[number] = block.append(x, self._caches[number])
            if number < len(landmarks):
                x = network.reads[number].attend(x, *landmarks[number])
        x = network.norm["norm"](x)
        pointer = network.linear["out"](x)
        pointer *= np.float32(pointer.shape[1] ** -0.5)
        return pointer, softplus(network.linear["gate"](x))


def compiled_groups(points: np.ndarray, groups: int, size: int) -> tuple[np.ndarray, np.ndarray]:
    """As `scene_arrays.group_points`, of points (m, 3) float32."""
    points = points[np.arange(max(len(points), size + 1)) % len(points)]
    centres, offsets = np.empty((groups, 3), np.float32), np.empty((groups, size, 3), np.float32)
    away, near = np.empty((2, len(points)), np.float32)
    transposed, chosen = np.ascontiguousarray(points.T), np.empty(size, np.int64)
    fill_groups(transposed, centres, offsets, away, near, chosen)
    return centres, offsets
