"""VQ-MPT's sequence model on a dictionary's graph: which codes lead from a start to a goal, given what eyes see.

Autoregressive as the paper's (eqn. prob_eqn): P(next code | code, goal, scene) over a code's neighbours and the goal,
and a beam search for the likeliest sequences. What the network is told of each way on is in
`kernels.search.code_graph.ways_on`.
"""

from dataclasses import dataclass

import numpy as np

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.kernels.search import code_graph, code_sequences
from cvqmpt_lab.kernels.search.code_graph import FEATURES, CodeGraph, CodeQuestion
from cvqmpt_lab.planning.code_graph import SeenGraph
from cvqmpt_lab.planning.small_network import SmallNetwork

ROOM = 64  # ways on from a node at most
QUEUE = 40  # entries of the queue a node


@dataclass(frozen=True)
class SequenceSettings:
    """How sequences are searched."""

    beams: int = 8
    """Sequences kept at every step, and given at the end."""
    longest: int = 24
    """Codes a sequence at most."""
    entries: int = 40
    """Codes that the start leads to, the nearest ones."""
    exits: int = 20
    """Codes that lead to each goal, the nearest ones."""
    caution: float = 4.0
    """What -log P(free) counts in the cost of a way [rad]."""
    penalty: float = 0.5
    """Ways at a code that is not on the manifold count 1 + penalty * |F| times their length."""
    drift: float = 1.5
    """Codes that lie further from the manifold are not used [rad]."""


@dataclass(frozen=True, eq=False)
class CodePath:
    """One predicted sequence."""

    codes: np.ndarray
    """(k,) nodes."""
    goal: int
    """Row of the goal that it leads to."""
    log_probability: float


class SequenceSearch:
    """A start and its goals, asked of one graph; the graph's nodes may move between questions."""

    def __init__(
        self,
        seen: SeenGraph,
        network: SmallNetwork,
        cloud: np.ndarray,
        start: np.ndarray,
        goals: np.ndarray,
        settings: SequenceSettings,
        factor: np.ndarray | None = None,
    ) -> None:
        """Link start (n,) and goals (k, n) to the graph as it looks in a cloud (m, 3) [m].

        factor: (N,), see `CodeQuestion`; None for 1 everywhere.

        Raises
        ------
        InvalidInputError
            When the network does not read what ways on are described by.
        """
        if network.inputs != FEATURES:
            raise InvalidInputError(f"a sequence network reads {FEATURES} numbers; this one {network.inputs}")
        self.graph, self._network = seen.graph(cloud), network.arrays()
        self.question = _question(self.graph, start, goals, settings, factor)
        exit_node = np.repeat(
            np.arange(len(self.graph.nodes), dtype=np.int32), np.diff(self.question.exit_first)
        )
        robot = seen.eyes.robot
        code_graph.judge_ends(robot.kinematics, seen.eyes.look(cloud), self.graph, self.question, exit_node)
        self._room = _room(len(self.graph.nodes), settings)

    def likeliest(self) -> list[CodePath]:
        """The likeliest sequences, likeliest first; none where no way leads to a goal."""
        code_graph.cost_to_go(self.graph, self.question)
        room = self._room
        found = code_sequences.likeliest_sequences(self.graph, self.question, self._network, room)
        return [
            CodePath(
                room.codes[k, : room.length[k]].copy(), int(room.goal[k]), float(room.log_probability[k])
            )
            for k in range(found)
        ]


def _question(
    graph: CodeGraph,
    start: np.ndarray,
    goals: np.ndarray,
    settings: SequenceSettings,
    factor: np.ndarray | None,
) -> CodeQuestion:
    count = len(graph.nodes)
    entry = nearest_rows(graph.nodes, start[None], settings.entries)[0]
    exits = nearest_rows(graph.nodes, goals, settings.exits)
    node, goal = exits.ravel(), np.repeat(np.arange(len(goals), dtype=np.int32), exits.shape[1])
    order = np.argsort(node, kind="stable")
    return CodeQuestion(
        start=np.ascontiguousarray(start, dtype=float),
        goals=np.ascontiguousarray(goals, dtype=float),
        entry=entry,
        entry_price=np.zeros(len(entry)),
        exit_first=np.searchsorted(node[order], np.arange(count + 1)).astype(np.int32),
        exit_goal=goal[order],
        exit_price=np.zeros(len(node)),
        factor=np.ones(count) if factor is None else factor,
        caution=settings.caution,
        to_go=np.empty(count),
        straight=np.empty(count),
        heap=np.empty(QUEUE * count),
        heap_node=np.empty(QUEUE * count, dtype=np.int32),
    )


def nearest_rows(nodes: np.ndarray, ends: np.ndarray, count: int) -> np.ndarray:
    """Rows (e, count) int32 of the nodes (N, n) nearest to each of ends (e, n), in no order."""
    squares = (ends**2).sum(1)[:, None] + (nodes**2).sum(1) - 2.0 * ends @ nodes.T
    return np.argpartition(squares, count, axis=1)[:, :count].astype(np.int32)


def _room(count: int, settings: SequenceSettings) -> code_sequences.Sequences:
    beams, longest = settings.beams, settings.longest
    return code_sequences.Sequences(
        codes=np.zeros((beams, longest), dtype=np.int32),
        length=np.zeros(beams, dtype=np.int32),
        goal=np.zeros(beams, dtype=np.int32),
        log_probability=np.zeros(beams),
        alive=np.zeros((2, beams, longest), dtype=np.int32),
        alive_log_probability=np.zeros((2, beams)),
        step_parent=np.zeros(beams, dtype=np.int32),
        step_node=np.zeros(beams, dtype=np.int32),
        known=np.zeros(count + 1, dtype=np.int32),
        target=np.zeros((count + 1, ROOM), dtype=np.int32),
        score=np.zeros((count + 1, ROOM)),
        feature=np.zeros((ROOM, FEATURES)),
    )
