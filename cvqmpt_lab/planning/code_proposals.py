"""What predicted code sequences propose: Gaussians to sample from (the paper's use), and ways to walk first (ours)."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from cvqmpt_lab.distributions import GaussianMixture
from cvqmpt_lab.kernels.search.tree_growth import CONNECTED, FULL, REMOVED, enlarged, plant
from cvqmpt_lab.kernels.search.walk import UNKNOWN, move_code, walk
from cvqmpt_lab.planning.birrt import FIRST_CAPACITY, checked_tree_path
from cvqmpt_lab.planning.code_graph import SeenGraph
from cvqmpt_lab.planning.code_sequences import CodePath, SequenceSearch, SequenceSettings
from cvqmpt_lab.planning.proposal import Observation, Proposal
from cvqmpt_lab.planning.query import Query
from cvqmpt_lab.planning.result import JointPath, Timings
from cvqmpt_lab.planning.small_network import SmallNetwork

STEP = 0.2  # [rad] between the states of a walked motion; a found path is mended to the space's own
LONGEST_MOTION = 256  # states


@dataclass(frozen=True, eq=False)
class CodeProposal(Proposal):
    """A proposal that remembers the codes it was made of."""

    codes: np.ndarray = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    """(c,) of all sequences, each once."""


@dataclass(frozen=True, eq=False)
class PredictedSequences:
    """CVQ-MPT (paper, Algorithm 1): likely code sequences become a mixture; walked first where that is asked for."""

    name: str
    seen: Callable[[Query], SeenGraph]
    """The dictionary before the query's robot's eyes."""
    network: SmallNetwork
    covariances: np.ndarray
    """(N, n, n) of codes, wide enough to sample from [rad^2]."""
    settings: SequenceSettings = field(default_factory=SequenceSettings)
    uniform_share: float = 0.15
    early: bool = False
    """Codes are put on the manifold before sequences through them are judged."""
    rounds: int = 8
    """How often at most sequences are predicted anew because their codes have moved."""
    walks: int = 0
    """Sequences walked before samples are drawn, each an iteration of the budget."""

    def __call__(self, query: Query, observation: Observation) -> CodeProposal:
        """Predict, walk."""
        assert observation.cloud is not None
        clock, began = query.allowance, query.allowance.seconds
        self.seen(query).prices(observation.cloud, observation.new)
        encoded = clock.seconds
        walker, predicted = self.predicted(query, observation)
        asked, path, walked = clock.seconds, None, 0
        while path is None and predicted and walked < self.walks and not clock.spent():
            path, walked = walker.walk(predicted[0]), walked + 1
            clock.count(1)
            if path is None and walked < self.walks:
                predicted = self._likeliest(walker) or predicted
        codes = _codes_of(predicted)
        means = walker.search.graph.nodes[codes]
        ways = f"{len(predicted)} sequences of {len(codes)} codes" + (f", {walked} walked" if walked else "")
        return CodeProposal(
            GaussianMixture.equal(
                means, self.covariances[codes], query.uniform, self.uniform_share, self.name
            ),
            Timings(encode=encoded - began, predict=asked - encoded),
            ways,
            fallback="" if predicted else "no code sequence reached a goal",
            vertices=0 if path is None else int(walker.trees.size.sum()),
            path=path,
            trees=walker.trees if walked else None,
            codes=codes,
        )

    def predicted(self, query: Query, observation: Observation) -> "tuple[Walker, list[CodePath]]":
        """Likely sequences, likeliest first, and who walks them."""
        assert observation.cloud is not None
        seen = self.seen(query)
        search = SequenceSearch(
            seen,
            self.network,
            observation.cloud,
            query.start,
            query.goals,
            self.settings,
            self._factor(query, seen),
        )
        walker = Walker(query, search, self.settings.drift)
        return walker, self._likeliest(walker)

    def _factor(self, query: Query, seen: SeenGraph) -> np.ndarray:
        """How much longer ways at each code count, (N,)."""
        factor = np.ones(len(seen.roadmap.nodes))
        if query.space.dim > 0 and self.early:
            residual = query.space.problem.manifold.residual(seen.roadmap.nodes)
            factor += self.settings.penalty * np.linalg.norm(residual, axis=1)
        return factor

    def _likeliest(self, walker: "Walker") -> list[CodePath]:
        """Likely sequences; with `early`, such as lie on the manifold."""
        predicted = walker.search.likeliest()
        for _ in range(self.rounds if self.early else 0):
            if not walker.move(predicted):
                break
            predicted = walker.search.likeliest()
        return predicted


def _codes_of(predicted: list[CodePath]) -> np.ndarray:
    """Codes (c,) of sequences, each once."""
    return np.unique(np.concatenate([np.empty(0, np.int32), *(one.codes for one in predicted)]))


class Walker:
    """Walks sequences, and remembers what was found out on the way."""

    def __init__(self, query: Query, search: SequenceSearch, drift: float) -> None:
        count = len(search.graph.nodes)
        self.search, self.trees = search, plant(query.start, query.goals, FIRST_CAPACITY)
        self._space, self._arrays, self._drift = query.space, query.space.arrays._replace(step=STEP), drift
        self._state = np.full(count, UNKNOWN, dtype=np.int8)
        self._standing = np.full(count, -1, dtype=np.int64)
        self._room = np.empty((LONGEST_MOTION, len(query.start)))

    def move(self, predicted: list[CodePath]) -> bool:
        """Put the codes of sequences on the manifold; whether any was not there."""
        codes = _codes_of(predicted)
        new = codes[self._state[codes] == UNKNOWN]
        for code in new.tolist():
            move_code(self._arrays, self.search.graph, self.search.question, self._state, code, self._drift)
        return len(new) > 0

    def walk(self, predicted: CodePath) -> JointPath | None:
        """The way along a sequence, if it is free; otherwise what blocks it is not predicted again."""
        while True:
            status, blocked = walk(
                self._arrays,
                self.search.graph,
                self.search.question,
                self.trees,
                self._state,
                self._standing,
                predicted.codes,
                predicted.goal,
                self._drift,
                self._room,
            )
            self._space.reraise()
            if status != FULL:
                break
            self.trees = enlarged(self.trees)
        path = checked_tree_path(self._space, self.trees) if status == CONNECTED else None
        if status == CONNECTED and path is None:
            blocked = self._take_back(predicted)
        if blocked >= 0:
            self._block(predicted, blocked)
        return path

    def _take_back(self, predicted: CodePath) -> int:
        """Forget what stood behind a motion that has just failed its fine check; which motion of the sequence it is."""
        removed = self.trees.nodes[0, :, 0] == REMOVED
        gone = removed[self._standing[predicted.codes]]
        self._standing[(self._standing >= 0) & removed[self._standing]] = -1
        return int(np.argmax(gone)) if gone.any() else len(gone)

    def _block(self, predicted: CodePath, motion: int) -> None:
        """Make one motion of a sequence cost more than anything."""
        graph, question, codes = self.search.graph, self.search.question, predicted.codes
        if motion == 0:
            question.entry_price[question.entry == codes[0]] = np.inf
        elif motion == len(codes):
            exits = slice(*question.exit_first[codes[-1] : codes[-1] + 2])
            question.exit_price[exits][question.exit_goal[exits] == predicted.goal] = np.inf
        else:
            arcs = slice(*graph.first[codes[motion - 1] : codes[motion - 1] + 2])
            graph.price[graph.edge[arcs][graph.neighbour[arcs] == codes[motion]]] = np.inf
