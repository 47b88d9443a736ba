"""Decoder of the scene transformer in numpy: codes step by step, from an encoded scene.

It stores attention keys and values of earlier codes. After a code it computes logits only for the
code's neighbours on the roadmap and for the goal token, since other classes are impossible.
"""

import numpy as np

from cvqmpt_lab.vqmpt.beam_search import log_softmax
from cvqmpt_lab.vqmpt.numpy_encoder import EncodedScene, SceneNetwork
from cvqmpt_lab.vqmpt.numpy_layers import softplus
from cvqmpt_lab.vqmpt.transformer_inputs import Ends


class SequenceDecoder:
    """A `StepDecoder` from one start to k goals; class N, the number of codes, is the goal token.

    With the cost to go V, the logit of successor i of code j is

        t . k(e_i) - g A_i,    A_i = min(max(cost(j, i) + V_i - V_j, 0), max_advantage).
    """

    def __init__(
        self, network: SceneNetwork, scene: EncodedScene, start: np.ndarray, goals: np.ndarray
    ) -> None:
        """Embed start and goals, and compute the costs to go.

        Args:
            network: the scene transformer.
            scene: the encoded scene.
            start: (n,) [rad or m].
            goals: (k, n) [rad or m].
        """
        self._network, self._scene = network, scene
        self._max_advantage = np.float32(network.config.max_advantage)
        ends = network.ends(scene, np.vstack([start[None], goals]))
        self._start = Ends(*(part[:1] for part in ends))
        goal_ends = Ends(*(part[1:] for part in ends))
        self.V = network.cost_to_go(scene, goal_ends).astype(np.float32)  # (k, N) [rad]
        # costs of the links from codes to goals [rad], inf if there is none
        self._link = np.full(self.V.shape, np.inf, dtype=np.float32)
        np.put_along_axis(self._link, goal_ends.near, goal_ends.cost.astype(np.float32), axis=1)
        self._goal_keys = network.linear["goal_key"](goal_ends.embedding)
        self._prefix = (
            network.entered(goal_ends.embedding, 0),
            network.entered(self._start.embedding, 1),
        )
        self._caches: list[np.ndarray | None] = [None] * len(network.blocks)
        self._place = 0  # position of the next token
        self._goal = np.arange(len(goals))  # index of each row's goal

    def start(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the codes near the start (k, l) and their log-probabilities."""
        goal, start = self._prefix
        # goal and start are the same in all hypotheses, so they are decoded once for each goal
        self._step(goal)
        pointer, gate = self._step(np.repeat(start, len(goal), axis=0))
        near = self._start.near[0]
        cost = self._start.cost[0].astype(np.float32) + self.V[:, near]
        advantage = np.minimum(cost - cost.min(axis=1, keepdims=True), self._max_advantage)
        logits = pointer @ self._scene.keys[near].T - gate * advantage
        return np.broadcast_to(near, logits.shape), log_softmax(logits)

    def advance(self, parents: np.ndarray, codes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Append codes to prefixes; return successors (r, w + 1) and their log-probabilities."""
        network, scene = self._network, self._scene
        goal = self._goal[parents]
        self._goal = goal
        # keys and values follow their hypothesis when the beam is reordered
        self._caches = [None if cache is None else cache[parents] for cache in self._caches]
        pointer, gate = self._step(scene.entered[codes])
        successors = network.neighbour[codes]
        here = self.V[goal, codes][:, None]
        there = self.V[goal[:, None], successors]
        advantage = scene.arc_cost[codes].astype(np.float32) + there - here
        logits = np.empty((len(codes), successors.shape[1] + 1), dtype=np.float32)
        logits[:, :-1] = np.matmul(scene.keys[successors], pointer[:, :, None])[..., 0]
        logits[:, :-1] -= gate * np.clip(advantage, np.float32(0.0), self._max_advantage)
        logits[:, :-1][successors == codes[:, None]] = -np.inf  # padding
        # the goal token is possible only after a code that is linked to the goal
        link = self._link[goal, codes][:, None]
        linked = np.isfinite(link)
        advantage = np.where(linked, link, 0.0) - here
        penalty = gate * np.clip(advantage, np.float32(0.0), self._max_advantage)
        to_goal = np.einsum("rd,rd->r", pointer, self._goal_keys[goal])[:, None]
        to_goal = to_goal + network.array["goal_bias"]
        logits[:, -1:] = np.where(linked, to_goal - penalty, -np.inf)
        goal_class = np.full((len(codes), 1), len(network.nodes), dtype=successors.dtype)
        return np.concatenate([successors, goal_class], axis=1), log_softmax(logits)

    def _step(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Decode each row's next token x (r, d); return pointers t (r, d) and gates g (r, 1)."""
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
