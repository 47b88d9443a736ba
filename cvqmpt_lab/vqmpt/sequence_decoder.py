"""The half of the scene transformer that decodes sequences, in numpy: same mathematics as
`scene_transformer`.

Codes are decoded step by step, all hypotheses of all goals in one batch: attention keys and values
of earlier codes are kept, and logits are computed for the roadmap's ways on alone; other classes
are impossible.
"""

import numpy as np

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.vqmpt.array_layers import Block, Layers, softplus
from cvqmpt_lab.vqmpt.beam_search import CodeSequence
from cvqmpt_lab.vqmpt.encoded_scene import PART, EncodedScene, Ends, SceneLooker
from cvqmpt_lab.vqmpt.weights import StoredModel

WORST, LONGEST = 10.0, 13  # as in `scene_transformer`


class CausalTransformer:
    """The layers over goal, start and codes so far, and the pointers they give."""

    def __init__(self, model: StoredModel, robot: Robot) -> None:
        """Take over the weights; errors as of `SceneLooker`."""
        self.looker = SceneLooker(model, robot)
        sizes, layers = self.looker.config.sizes, Layers(model, PART)
        d = sizes.width
        self.place = layers.array("place", LONGEST + 2, d)
        self.blocks = [
            Block(layers, f"blocks.{k}", d, sizes.heads, 4 * d) for k in range(sizes.layers)
        ]
        self._norm, self._out = layers.norm("norm", d), layers.linear("out", d, d)
        self._gate, self._goal_key = layers.linear("gate", d, 1), layers.linear("goal_key", d, d)
        self.goal_bias = float(layers.array("goal_bias", 1)[0])

    def goal_keys(self, goals: Ends) -> np.ndarray:
        """What pointers to each goal are compared with (k, d)."""
        return self._goal_key(goals.seen)

    def pointers(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pointers (r, d), scaled, and gates (r, 1) of tokens x (r, d)."""
        x = self._norm(x)
        pointer = self._out(x)
        pointer *= np.float32(pointer.shape[1] ** -0.5)
        return pointer, softplus(self._gate(x))


class SequenceDecoder:
    """Log probabilities of the ways on, from a start to k goals, prefix by prefix.

    Ways are codes, and N for the goal. Rows of one goal lie together, goals in their order.
    """

    def __init__(
        self,
        network: CausalTransformer,
        scene: EncodedScene,
        start: np.ndarray,
        goals: np.ndarray,
    ) -> None:
        """Look at the start (n,) and goals (k, n) [rad], and find the costs to go."""
        self._network, self._scene = network, scene
        looker = network.looker
        ends = looker.ends(scene, np.vstack([start[None], goals]))
        own, ends = Ends(*(part[:1] for part in ends)), Ends(*(part[1:] for part in ends))
        self._start, self.V = own, looker.cost_to_go(scene, ends).astype(np.float32)  # (k, N) [rad]
        self._link = np.full(self.V.shape, np.inf, dtype=np.float32)
        np.put_along_axis(self._link, ends.near, ends.cost.astype(np.float32), axis=1)
        self._goal_keys = network.goal_keys(ends)
        self._prefix = looker.entered(ends.seen, 0), looker.entered(own.seen, 1)
        self._kept: list[np.ndarray | None] = [None] * len(network.blocks)
        self._place = 0  # of the next token
        self._goal = np.arange(len(goals))  # of each row

    def start(self) -> tuple[np.ndarray, np.ndarray]:
        """Ways (k, l) from the start and their log probabilities."""
        goal, start = self._prefix
        self._step(goal + self._network.place[0])
        x = self._step(np.repeat(start + self._network.place[1], len(goal), axis=0))
        self._place = 2
        pointer, gate = self._network.pointers(x)
        near = self._start.near[0]
        cost = self._start.cost[0].astype(np.float32) + self.V[:, near]
        excess = np.minimum(cost - cost.min(axis=1, keepdims=True), np.float32(WORST))
        logits = pointer @ self._scene.keys[near].T - gate * excess
        return np.broadcast_to(near, logits.shape), _log_softmax(logits)

    def advance(self, parents: np.ndarray, codes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Ways (r, w + 1) and their log probabilities once the rows are `parents`, each continued
        by one of codes.

        The last way is the goal. Those that do not lead on have a log probability of -inf.
        """
        network, scene = self._network, self._scene
        arcs, goal = network.looker.arcs, self._goal[parents]
        self._goal, self._kept = (
            goal,
            [None if kept is None else kept[parents] for kept in self._kept],
        )
        x = self._step(scene.entered[codes] + network.place[self._place])
        self._place += 1
        pointer, gate = network.pointers(x)
        table, here = arcs.table[codes], self.V[goal, codes][:, None]
        excess = scene.arc_table[codes] + self.V[goal[:, None], table] - here
        logits = np.empty((len(codes), table.shape[1] + 1), dtype=np.float32)
        logits[:, :-1] = np.matmul(scene.keys[table], pointer[:, :, None])[..., 0]
        logits[:, :-1] -= gate * np.clip(excess, np.float32(0.0), np.float32(WORST))
        logits[:, :-1][arcs.padding[codes]] = -np.inf
        link = self._link[goal, codes][:, None]
        leads = np.isfinite(link)
        extra = gate * np.clip(
            np.where(leads, link, 0.0) - here, np.float32(0.0), np.float32(WORST)
        )
        to_goal = np.einsum("rd,rd->r", pointer, self._goal_keys[goal])[:, None] + np.float32(
            network.goal_bias
        )
        logits[:, -1:] = np.where(leads, to_goal - extra, -np.inf)
        ways = np.concatenate(
            [table, np.full((len(codes), 1), len(arcs.table), dtype=table.dtype)], axis=1
        )
        return ways, _log_softmax(logits)

    def _step(self, x: np.ndarray) -> np.ndarray:
        """Outputs (r, d) of the next token of each row, x (r, d)."""
        landmarks = self._scene.landmarks
        for number, block in enumerate(self._network.blocks):
            heads, self._kept[number] = block.attend_own(x, self._kept[number])
            x = block.forward(x, heads)
            if number < len(landmarks):
                x = self._network.looker.reads[number].attend(x, *landmarks[number])
        return x


def _log_softmax(logits: np.ndarray) -> np.ndarray:
    """Log probabilities (r, w), in place."""
    logits -= logits.max(axis=1, keepdims=True)
    logits -= np.log(np.exp(logits).sum(axis=1, keepdims=True))
    return logits


def likeliest_sequences(
    decoder: SequenceDecoder, beams: int, every: bool = False, longest: int = LONGEST
) -> list[list[CodeSequence]]:
    """The hypotheses to each goal, likeliest first, by a beam search over the ways; scores are log
    probabilities.

    A hypothesis that has reached the goal stays in the beam as it is. Since going on only lowers
    the others, a goal's rows are left out of the batch once its best hypothesis is finished, or
    every one. longest: codes of a sequence; at that length finished hypotheses come first.
    """
    ways, log_p = decoder.start()
    goals, links = ways.shape
    if not 1 <= beams <= links:
        raise InvalidInputError(f"{beams} beams; give 1 to {links}")
    column, score = _largest(log_p, beams)
    codes = np.take_along_axis(ways, column, axis=1)[..., None]  # (k, beams, t)
    asked, found = np.arange(goals), dict[int, list[CodeSequence]]()
    parents, ended = asked.repeat(beams), np.zeros((goals, beams), dtype=bool)
    for _ in range(longest):
        latest = np.where(ended, 0, codes[..., -1]).ravel()
        ways, log_p = decoder.advance(parents, latest)
        goal_class = int(ways[0, -1])
        log_p[ended.ravel()] = -np.inf  # a finished hypothesis goes on as it is, at no cost
        log_p[ended.ravel(), -1] = 0.0
        gain = score[..., None] + log_p.reshape(*score.shape, -1)
        column, score = _largest(gain.reshape(len(asked), -1), beams)
        rank, column = np.divmod(column, ways.shape[1])
        row = beams * np.arange(len(asked))[:, None] + rank
        codes = np.concatenate(
            [np.take_along_axis(codes, rank[..., None], axis=1), ways[row, column][..., None]],
            axis=2,
        )
        ended = codes[..., -1] == goal_class
        done = ended.all(axis=1) if every else ended[:, 0]
        for one in np.flatnonzero(done).tolist():
            found[int(asked[one])] = _sequences(codes[one], score[one], goal_class)
        going = ~done
        if not going.any():
            break
        asked, codes, score, ended, parents = (
            asked[going],
            codes[going],
            score[going],
            ended[going],
            row[going].ravel(),
        )
    else:
        for one, goal in enumerate(asked.tolist()):  # the best that is finished, else the best
            order = np.argsort(~ended[one], kind="stable")
            found[goal] = _sequences(codes[one, order], score[one, order], goal_class)
    return [found[goal] for goal in range(goals)]


def _sequences(codes: np.ndarray, score: np.ndarray, goal_class: int) -> list[CodeSequence]:
    """Hypotheses (beams, t), each up to its goal."""
    return [
        CodeSequence(tuple(code for code in row if code != goal_class), goal_class in row, p)
        for row, p in zip(codes.tolist(), score.tolist(), strict=True)
    ]


def _largest(values: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Columns and values (q, count) of the largest in each row (q, n), largest first;
    ties by column.
    """
    columns = np.argsort(-values, axis=1, kind="stable")[:, :count]
    return columns, np.take_along_axis(values, columns, axis=1)
