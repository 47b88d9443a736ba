"""Beam search for a probable sequence of codes (paper, eqn. prob_eqn).

    P(h_1 ... h_n | M) = prod_i pi(h_i | h_1 ... h_(i-1), M),

with pi the autoregressive model and M the context of scene, start and goal. The last token of a
sequence is the goal token.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from cvqmpt_lab.base.errors import InvalidInputError


class StepDecoder(Protocol):
    """Log-probabilities, float32, of what can follow prefixes of codes, one prefix a row.

    Rows of one query (start and goal) lie together, queries in their order. Classes are the codes
    and the goal token; impossible ones have -inf.
    """

    def start(self) -> tuple[np.ndarray, np.ndarray]:
        """Classes (queries, l) that can come first, and their log-probabilities; called once."""

    def advance(self, parents: np.ndarray, codes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Replace the rows; classes (rows, w), the last the goal token, and log-probabilities.

        Args:
            parents: (rows,) int64, the earlier row that each new row continues.
            codes: (rows,) int64, the code it adds.
        """


@dataclass(frozen=True)
class CodeSequence:
    """A predicted sequence."""

    codes: tuple[int, ...]  # without the goal token
    finished: bool  # ends with the goal token; if not, the codes do not lead to the goal
    score: float  # what the search ranked by


def beam_search(
    decoder: StepDecoder,
    *,
    beams: int = 3,
    max_length: int = 50,
    every: bool = False,
    published: bool = False,
) -> list[list[CodeSequence]]:
    """Hypotheses for each query, finished ones first, then by score; all queries in one batch.

    Scores are log P. A finished hypothesis stays in the beam as it is. Since going on only lowers
    the others, a query leaves the batch once its best hypothesis is finished, or every one.

    Args:
        decoder: the sequence model.
        beams: K, hypotheses kept per query.
        max_length: predicted tokens at most, the goal token included (published code: 50 for
            CVQ-MPT, 30 for Opt-CVQ-MPT).
        every: go on until every hypothesis is finished, not only the best.
        published: the rules of the authors' code. The score is the logarithm of the first
            probability plus the sum of the others; the last code of any beam is forbidden to all;
            a query ends at the first goal token of any beam. (Not copied is that their code then
            reads embeddings that were not reordered with the beams.)

    Raises:
        InvalidInputError: no such number of beams, or log-probabilities are not numbers.
    """
    classes, log_p = decoder.start()
    if np.isnan(log_p).any():
        raise InvalidInputError("predicted logits are not finite; start, goal or weights hold NaN")
    most = int(np.isfinite(log_p).sum(axis=1).min())  # only possible classes start hypotheses
    if not 1 <= beams <= most:
        raise InvalidInputError(f"{beams} beams; give 1 to {most}")
    column, score = _largest(log_p, beams)
    codes = np.take_along_axis(classes, column, axis=1)[..., None]  # (queries, beams, t)
    query, found = np.arange(len(codes)), dict[int, list[CodeSequence]]()
    parents, ended = query.repeat(beams), np.zeros(score.shape, dtype=bool)
    for _ in range(max_length - 1):
        # a finished hypothesis has no code to add; its row is ignored below
        classes, log_p = decoder.advance(parents, np.where(ended, 0, codes[..., -1]).ravel())
        gain, width = log_p.reshape(*score.shape, -1), classes.shape[1]
        if published:
            last = (classes.reshape(gain.shape)[..., None] == codes[:, None, None, :, -1]).any(-1)
            gain = np.where(last | np.isneginf(gain), -np.inf, np.exp(gain))
        gain[ended] = -np.inf  # a finished hypothesis goes on as it is, at no cost
        gain[ended, -1] = 0.0
        column, score = _largest((score[..., None] + gain).reshape(len(query), -1), beams)
        rank, column = np.divmod(column, width)
        row = beams * np.arange(len(query))[:, None] + rank
        earlier = np.take_along_axis(codes, rank[..., None], axis=1)
        codes = np.concatenate([earlier, classes[row, column][..., None]], axis=2)
        ended = codes[..., -1] == classes[0, -1]
        if published:
            done = ended.any(axis=1)
        else:
            done = ended.all(axis=1) if every else ended[:, 0]
        for one in np.flatnonzero(done).tolist():
            found[int(query[one])] = _hypotheses(codes[one], score[one], ended[one])
        query, codes, score, ended, row = (x[~done] for x in (query, codes, score, ended, row))
        if len(query) == 0:
            break
        parents = row.ravel()
    for one, which in enumerate(query.tolist()):
        found[which] = _hypotheses(codes[one], score[one], ended[one])
    return [found[which] for which in range(len(found))]


def _hypotheses(codes: np.ndarray, score: np.ndarray, ended: np.ndarray) -> list[CodeSequence]:
    """Hypotheses (beams, t) in order, each up to its first goal token."""
    sequences = []
    for one in np.argsort(~ended, kind="stable").tolist():
        row = codes[one].tolist()
        until = row.index(row[-1]) if ended[one] else len(row)
        sequences.append(CodeSequence(tuple(row[:until]), bool(ended[one]), float(score[one])))
    return sequences


def _largest(values: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Columns and values (q, count) of the largest in each row (q, n), ties by column."""
    columns = np.argsort(-values, axis=1, kind="stable")[:, :count]
    return columns, np.take_along_axis(values, columns, axis=1)


def log_softmax(logits: np.ndarray) -> np.ndarray:
    """Log-probabilities x_i - log sum_j exp(x_j) of rows (r, w), in place."""
    logits -= logits.max(axis=1, keepdims=True)
    logits -= np.log(np.exp(logits).sum(axis=1, keepdims=True))
    return logits
