"""Beam search for a probable sequence of codes (paper, eqn. prob_eqn).

    P(h_1 ... h_n | M) = prod_i pi(h_i | h_1 ... h_(i-1), M),

where pi is the autoregressive model and M the context of scene, start and goal. The last token of
a sequence is the goal token.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from cvqmpt_lab.base.errors import InvalidInputError


class StepDecoder(Protocol):
    """Sequence model that continues prefixes of codes step by step; each row is one prefix.

    Rows of one query (start and goal) are consecutive, and queries keep their order. Classes are
    the codes and the goal token. Log-probabilities are float32, -inf for impossible classes.
    """

    def start(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the possible first classes (queries, l) and their log-probabilities.

        Called once, before `advance`.
        """

    def advance(self, parents: np.ndarray, codes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Replace the prefixes by longer ones and return their candidate next classes.

        Args:
            parents: (rows,) int64, index of the earlier row that each new row continues.
            codes: (rows,) int64, the code that is appended to it.

        Returns:
            Classes (rows, w), the last of which is the goal token, and their log-probabilities.
        """


@dataclass(frozen=True)
class CodeSequence:
    """A predicted sequence of codes."""

    codes: tuple[int, ...]  # without the goal token
    finished: bool  # whether it ends with the goal token; else the codes do not lead to the goal
    score: float  # rank in the beam search: log P, or the published score


def beam_search(
    decoder: StepDecoder,
    *,
    beams: int = 3,
    max_length: int = 50,
    every: bool = False,
    published: bool = False,
) -> list[list[CodeSequence]]:
    """Find the most probable sequences of each query; all queries are searched in one batch.

    The score is log P. A finished hypothesis stays in the beam unchanged. Further tokens only lower
    the score of the others, so a query ends when its best hypothesis is finished (or all of them).

    Args:
        decoder: the sequence model.
        beams: K, number of hypotheses kept for each query.
        max_length: maximum number of predicted tokens, the goal token included (published code: 50
            for CVQ-MPT, 30 for Opt-CVQ-MPT).
        every: continue until every hypothesis is finished, not only the best one.
        published: follow the authors' code: the score is the logarithm of the first probability
            plus the sum of the other probabilities; the last code of each hypothesis is forbidden
            to all hypotheses; a query ends at the first goal token. One of its errors is not
            copied: after the beam is reordered, their code reads embeddings in the old order.

    Returns:
        Hypotheses of each query, the finished ones first, then by decreasing score.

    Raises:
        InvalidInputError: the number of beams is out of range, or log-probabilities are NaN.
    """
    classes, log_p = decoder.start()
    if np.isnan(log_p).any():
        raise InvalidInputError("predicted logits are not finite; start, goal or weights hold NaN")
    most = int(np.isfinite(log_p).sum(axis=1).min())  # a hypothesis begins with a possible class
    if not 1 <= beams <= most:
        raise InvalidInputError(f"{beams} beams; give 1 to {most}")
    column, score = _largest(log_p, beams)
    codes = np.take_along_axis(classes, column, axis=1)[..., None]  # (queries, beams, t)
    query = np.arange(len(codes))
    parents = query.repeat(beams)
    ended = np.zeros(score.shape, dtype=bool)
    found: dict[int, list[CodeSequence]] = {}
    for _ in range(max_length - 1):
        # a finished hypothesis adds no code: it advances by code 0, and its gain is replaced below
        classes, log_p = decoder.advance(parents, np.where(ended, 0, codes[..., -1]).ravel())
        gain = log_p.reshape(*score.shape, -1)
        width = classes.shape[1]
        if published:
            last = (classes.reshape(gain.shape)[..., None] == codes[:, None, None, :, -1]).any(-1)
            gain = np.where(last | np.isneginf(gain), -np.inf, np.exp(gain))
        # a finished hypothesis can only repeat its goal token, which leaves its score unchanged
        gain[ended] = -np.inf
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
    """Return the hypotheses (beams, t), finished ones first, each up to its first goal token."""
    sequences = []
    for one in np.argsort(~ended, kind="stable").tolist():
        row = codes[one].tolist()
        until = row.index(row[-1]) if ended[one] else len(row)
        sequences.append(CodeSequence(tuple(row[:until]), bool(ended[one]), float(score[one])))
    return sequences


def _largest(values: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return columns and values (q, count) of the largest values in each row (q, n).

    Equal values are ordered by column.
    """
    columns = np.argsort(-values, axis=1, kind="stable")[:, :count]
    return columns, np.take_along_axis(values, columns, axis=1)


def log_softmax(logits: np.ndarray) -> np.ndarray:
    """Return log-probabilities x_i - log sum_j exp(x_j) of rows (r, w), computed in place."""
    logits -= logits.max(axis=1, keepdims=True)
    logits -= np.log(np.exp(logits).sum(axis=1, keepdims=True))
    return logits
