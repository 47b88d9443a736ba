"""The authors' beam search for a sequence of codes that is probable (paper, eqn. prob_eqn),

    P(h_1 ... h_n | M) = prod_i pi(h_i | h_1 ... h_(i-1), M),

with pi the autoregressive model and M the context of scene, start and goal. The sequence ends with
the goal token.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from cvqmpt_lab.errors import InvalidInputError


class StepDecoder(Protocol):
    """What a search asks a sequence model: prefixes of codes, one a row, that grow by one code a
    step.

    Classes are the codes, then the start token (never predicted), then the goal token. Rows of one
    query (start and goal) lie together, queries in their order, equally many rows each. Logits are
    float32.
    """

    def start(self) -> np.ndarray:
        """Logits (queries, n_classes) of the first code; called once, before `advance`."""

    def advance(self, parents: np.ndarray, codes: np.ndarray) -> np.ndarray:
        """Replace the rows and return the logits (rows, n_classes) of what follows them.

        parents (rows,) int64: the earlier row, of the same query, that each new row continues;
        codes (rows,) int64: what it adds. The number of rows is chosen at the first step and stays.
        """


@dataclass(frozen=True)
class CodeSequence:
    """A predicted sequence."""

    codes: tuple[int, ...]  # without start and goal token
    # the goal token was predicted before the length limit; without it the codes lead nowhere
    finished: bool
    score: float  # what the search ranked by


def beam_search(
    decoder: StepDecoder, *, beams: int = 3, max_length: int = 50
) -> list[CodeSequence]:
    """Search a sequence for each query as the authors' code does, all queries in one batch.

    A hypothesis is ranked by the logarithm of its first probability plus the sum of the others. The
    last code of any beam is forbidden to all of them. The search of a query ends at the first step
    in which any beam predicts the goal token, and returns the best of those; at the length limit
    the best hypothesis, with `finished` False. The first prediction is never the goal token, and
    none is the start token. Not copied is that their code then reads embeddings that were not
    reordered with the beams.

    beams: hypotheses kept per query, K. max_length: predicted tokens at most, the goal token
        included (published
    code: 50 for CVQ-MPT, 30 for Opt-CVQ-MPT).
    """
    if max_length < 1:
        raise InvalidInputError(f"sequences of {max_length} tokens; give at least 1")
    logits = decoder.start()
    if not np.isfinite(logits).all():
        raise InvalidInputError("predicted logits are not finite; start, goal or weights hold NaN")
    log_p = _log_probabilities(logits)
    log_p[:, -1] = -np.inf
    queries, classes = log_p.shape
    most, goal = classes - 2, classes - 1
    if not 1 <= beams <= most:
        raise InvalidInputError(f"{beams} beams; give 1 to {most}")
    codes, score = _largest(log_p, beams)  # (queries, beams)
    codes, query = codes[..., None], np.arange(queries)[:, None]
    parents = np.arange(queries).repeat(beams)
    found: dict[int, CodeSequence] = {}
    for _ in range(max_length - 1):
        latest = codes[..., -1]
        logits = decoder.advance(parents, np.where(latest == goal, 0, latest).ravel())
        gain = np.exp(_log_probabilities(logits)).reshape(queries, beams, classes)
        gain.swapaxes(1, 2)[query, latest] = -np.inf
        flat, score = _largest((score[..., None] + gain).reshape(queries, -1), beams)
        rank, code = np.divmod(flat, classes)
        codes = np.concatenate((codes[query, rank], code[..., None]), axis=2)
        parents = (rank + beams * query).ravel()
        for row, ended in enumerate((code == goal).tolist()):
            if True in ended and row not in found:
                best = ended.index(True)
                found[row] = CodeSequence(
                    tuple(codes[row, best, :-1].tolist()), True, float(score[row, best])
                )
        if len(found) == queries:
            break
    return [
        found[row]
        if row in found
        else CodeSequence(tuple(codes[row, 0].tolist()), False, float(score[row, 0]))
        for row in range(queries)
    ]


def _largest(values: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Columns and values (q, count) of the largest in each row (q, n), largest first;
    ties by column.
    """
    columns = np.sort(np.argpartition(values, -count, axis=1)[:, -count:], axis=1)
    row = np.arange(len(values))[:, None]
    columns = columns[row, np.argsort(-values[row, columns], axis=1, kind="stable")]
    return columns, values[row, columns]


def _log_probabilities(logits: np.ndarray) -> np.ndarray:
    """Log probabilities (rows, classes), the start token left out."""
    log_p = logits - logits.max(axis=1, keepdims=True)
    log_p -= np.log(np.exp(log_p).sum(axis=1, keepdims=True))
    log_p[:, -2] = -np.inf
    return log_p
