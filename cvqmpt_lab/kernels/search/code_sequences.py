"""The likeliest sequences of codes from a start to a goal: beam search over what a network says of every way on."""

from typing import Annotated, NamedTuple

import numpy as np

from cvqmpt_lab.kernels.compiling import kernel
from cvqmpt_lab.kernels.entry import entry
from cvqmpt_lab.kernels.search.code_graph import CodeGraph, CodeQuestion, ways_on
from cvqmpt_lab.kernels.search.small_network import SmallNetwork, answer


class Sequences(NamedTuple):
    """Finished sequences, likeliest first, and room for a search of them."""

    codes: Annotated[np.ndarray, "int32 beams longest"]
    """Nodes, in order."""
    length: Annotated[np.ndarray, "int32 beams"]
    """Nodes in each."""
    goal: Annotated[np.ndarray, "int32 beams"]
    """Goal that each ends at."""
    log_probability: Annotated[np.ndarray, "beams"]
    """Of the whole sequence."""
    alive: Annotated[np.ndarray, "int32 2 beams longest"]
    """Unfinished ones, before and after a step."""
    alive_log_probability: Annotated[np.ndarray, "2 beams"]
    """Theirs."""
    step_parent: Annotated[np.ndarray, "int32 beams"]
    """Which one each of the next ones continues ..."""
    step_node: Annotated[np.ndarray, "int32 beams"]
    """... with which node."""
    known: Annotated[np.ndarray, "int32 rows"]
    """Ways on from each node and, last, the start; -1 where nobody has asked yet."""
    target: Annotated[np.ndarray, "int32 rows room"]
    """Where they lead, see `code_graph.ways_on`."""
    score: Annotated[np.ndarray, "rows room"]
    """Their log probabilities."""
    feature: Annotated[np.ndarray, "room 6"]
    """Work array."""


@kernel
def _ask(graph, question, network, sequences, row):
    """Let the network weigh the ways on from a row."""
    count = ways_on(graph, question, row, sequences.target[row], sequences.feature)
    sequences.known[row] = count
    score, highest = sequences.score[row], -np.inf
    for k in range(count):
        for i in range(network.features.shape[0]):
            network.features[i] = sequences.feature[k, i]
        score[k] = answer(network)
        highest = max(highest, score[k])
    total = 0.0
    for k in range(count):
        total += np.exp(score[k] - highest)
    for k in range(count):
        score[k] -= highest + np.log(total)


@kernel
def _finish(sequences, parent, length, goal, score, found, side):
    """Put a finished sequence in its place among the found ones; how many there are then."""
    beams = sequences.codes.shape[0]
    if found == beams and score <= sequences.log_probability[found - 1]:
        return found
    place = found if found < beams else found - 1
    while place > 0 and sequences.log_probability[place - 1] < score:
        for t in range(sequences.length[place - 1]):
            sequences.codes[place, t] = sequences.codes[place - 1, t]
        sequences.length[place], sequences.goal[place] = (
            sequences.length[place - 1],
            sequences.goal[place - 1],
        )
        sequences.log_probability[place] = sequences.log_probability[place - 1]
        place -= 1
    for t in range(length):
        sequences.codes[place, t] = sequences.alive[side, parent, t]
    sequences.length[place], sequences.goal[place] = length, goal
    sequences.log_probability[place] = score
    return min(found + 1, beams)


@kernel
def _offer(sequences, scores, parent, node, score, held):
    """Keep a continuation if it is among the likeliest, and the likeliest to its node; how many are held then."""
    beams = scores.shape[0]
    for k in range(held):
        if sequences.step_node[k] == node:
            if scores[k] >= score:
                return held
            for later in range(k, held - 1):
                scores[later] = scores[later + 1]
                sequences.step_node[later] = sequences.step_node[later + 1]
                sequences.step_parent[later] = sequences.step_parent[later + 1]
            held -= 1
            break
    if held == beams and score <= scores[held - 1]:
        return held
    place = held if held < beams else held - 1
    while place > 0 and scores[place - 1] < score:
        scores[place] = scores[place - 1]
        sequences.step_node[place] = sequences.step_node[place - 1]
        sequences.step_parent[place] = sequences.step_parent[place - 1]
        place -= 1
    scores[place], sequences.step_node[place], sequences.step_parent[place] = score, node, parent
    return min(held + 1, beams)


@entry
@kernel
def likeliest_sequences(
    graph: CodeGraph, question: CodeQuestion, network: SmallNetwork, sequences: Sequences
):
    """Write the likeliest sequences found; returns how many.

    Of unfinished sequences that stand at one node after equally many, the likeliest goes on. No sequence holds a
    node twice.
    """
    count, longest = graph.nodes.shape[0], sequences.codes.shape[1]
    sequences.known[:] = -1
    alive, found, side = 1, 0, 0
    sequences.alive_log_probability[0, 0] = 0.0
    for length in range(longest + 1):
        held = 0
        scores = sequences.alive_log_probability[1 - side]
        for b in range(alive):
            row = count if length == 0 else np.int64(sequences.alive[side, b, length - 1])
            if sequences.known[row] < 0:
                _ask(graph, question, network, sequences, row)
            for k in range(sequences.known[row]):
                score = sequences.alive_log_probability[side, b] + sequences.score[row, k]
                there = np.int64(sequences.target[row, k])
                if there >= count:
                    found = _finish(sequences, b, length, there - count, score, found, side)
                    continue
                worst = sequences.log_probability[found - 1] if found == sequences.codes.shape[0] else -np.inf
                if length == longest or score <= worst:
                    continue
                again = False
                for t in range(length):
                    again = again or sequences.alive[side, b, t] == there
                if not again:
                    held = _offer(sequences, scores, b, there, score, held)
        for k in range(held):
            for t in range(length):
                sequences.alive[1 - side, k, t] = sequences.alive[side, sequences.step_parent[k], t]
            sequences.alive[1 - side, k, length] = sequences.step_node[k]
        alive, side = held, 1 - side
        if alive == 0:
            break
    return found
