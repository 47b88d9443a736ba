"""Beam search: the most probable sequence of codes (paper, eqn. prob_eqn),

    P(h_1 ... h_n | M) = prod_i pi(h_i | h_1 ... h_(i-1), M),

with pi the autoregressive model and M the context of scene, start and goal. The sequence ends with the goal token.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from cvqmpt_lab.errors import InvalidInputError


class StepDecoder(Protocol):
    """What a search asks a sequence model: prefixes of codes, one a row, that grow by one code a step.

    Classes are the codes, then the start token (never predicted), then the goal token. Rows of one query (start and
    goal) lie together, queries in their order, equally many rows each. Logits are float32.
    """

    def start(self) -> np.ndarray:
        """Logits (queries, n_classes) of the first code; called once, before `advance`."""

    def advance(self, parents: np.ndarray, codes: np.ndarray) -> np.ndarray:
        """Replace the rows and return the logits (rows, n_classes) of what follows them.

        parents (rows,) int64: the earlier row, of the same query, that each new row continues; codes (rows,) int64:
        what it adds. The number of rows is chosen at the first step and stays.
        """


@dataclass(frozen=True)
class CodeSequence:
    """A predicted sequence."""

    codes: tuple[int, ...]  # without start and goal token
    finished: bool  # the goal token was predicted before the length limit; without it the codes lead nowhere
    log_probability: float  # of the codes, and of the goal token when finished [nats]
    score: float  # what the search ranked by; the log probability unless `published`


@dataclass(frozen=True, eq=False)
class _Beams:
    """The hypotheses of q queries, k each."""

    codes: np.ndarray  # (q, k, t) int64
    score: np.ndarray  # (q, k)
    log_probability: np.ndarray  # (q, k) [nats]

    def sequence(self, query: int, rank: int, goal: int) -> CodeSequence:
        """One hypothesis up to its goal token; a finished one may have been padded with further ones."""
        codes = self.codes[query, rank].tolist()
        return CodeSequence(
            tuple(code for code in codes if code != goal),
            goal in codes,
            float(self.log_probability[query, rank]),
            float(self.score[query, rank]),
        )


def beam_search(
    decoder: StepDecoder, *, beams: int = 3, max_length: int = 50, published: bool = False
) -> list[CodeSequence]:
    """Search the most probable sequence of each query, all queries in one batch.

    A hypothesis that predicts the goal token stays among the beams as it is; since extending the others only lowers
    them, the search of a query ends when such a one ranks first. A beam never repeats its last code. At the length
    limit the best hypothesis that is finished is returned; when none is, the best one, with `finished` False. The
    first prediction is never the goal token, and none is the start token.

    beams: hypotheses kept per query, K. max_length: predicted tokens at most, the goal token included (published
    code: 50 for CVQ-MPT, 30 for Opt-CVQ-MPT). published: score as the authors' code does, by the logarithm of the
    first probability, then sums of plain probabilities; the last code of any beam is forbidden to all of them; the
    search ends at the first step in which any beam predicts the goal token, and returns the best of those. Not copied
    is that their code then reads embeddings that were not reordered with the beams.
    """
    if max_length < 1:
        raise InvalidInputError(f"sequences of {max_length} tokens; give at least 1")
    logits = decoder.start()
    if not np.isfinite(logits).all():
        raise InvalidInputError("predicted logits are not finite; start, goal or weights hold NaN")
    log_p = _log_probabilities(logits, (len(logits),))
    log_p[:, -1] = -np.inf
    queries, most, goal = len(log_p), log_p.shape[1] - 2, log_p.shape[1] - 1
    if not 1 <= beams <= most:
        raise InvalidInputError(f"{beams} beams; give 1 to {most}")
    codes, score = _largest(log_p, beams)
    hypotheses = _Beams(codes[..., None], score, score)
    first_row = beams * np.arange(queries)[:, None]
    parents = np.arange(queries).repeat(beams)
    best = [0] * queries
    found: dict[int, CodeSequence] = {}
    for _ in range(max_length - 1):
        latest = hypotheses.codes[..., -1].ravel()
        logits = decoder.advance(parents, np.where(latest == goal, 0, latest))
        hypotheses, rank_of = _extend(hypotheses, _log_probabilities(logits, (queries, beams)), published)
        parents = (rank_of + first_row).ravel()
        for query, ended in enumerate((hypotheses.codes[..., -1] == goal).tolist()):
            best[query] = ended.index(True) if True in ended else 0
            if (True in ended if published else ended[0]) and query not in found:
                found[query] = hypotheses.sequence(query, best[query], goal)
        if len(found) == queries:
            break
    return [
        found[query] if query in found else hypotheses.sequence(query, best[query], goal) for query in range(queries)
    ]


def _extend(hypotheses: _Beams, log_p: np.ndarray, published: bool) -> tuple[_Beams, np.ndarray]:
    """Best continuations and the ranks (q, k) they continue; log_p (q, k, classes), overwritten."""
    queries, beams, classes = log_p.shape
    latest = hypotheses.codes[..., -1]
    query = np.arange(queries)[:, None]
    if published:
        gain = np.exp(log_p)
        gain.swapaxes(1, 2)[query, latest] = -np.inf
    else:
        ended = latest == classes - 1
        if ended.any():  # a finished hypothesis goes on as it is, at no cost
            log_p[ended] = -np.inf
            log_p[ended, -1] = 0.0
        log_p[query, np.arange(beams), np.where(ended, classes - 2, latest)] = -np.inf
        gain = log_p
    flat, score = _largest((hypotheses.score[..., None] + gain).reshape(queries, -1), beams)
    rank, code = np.divmod(flat, classes)
    log_probability = hypotheses.log_probability[query, rank] + log_p[query, rank, code]
    codes = np.concatenate((hypotheses.codes[query, rank], code[..., None]), axis=2)
    return _Beams(codes, score, log_probability), rank


def _largest(values: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Columns and values (q, count) of the largest in each row (q, n), largest first; ties by column."""
    columns = np.sort(np.argpartition(values, -count, axis=1)[:, -count:], axis=1)
    row = np.arange(len(values))[:, None]
    columns = columns[row, np.argsort(-values[row, columns], axis=1, kind="stable")]
    return columns, values[row, columns]


def _log_probabilities(logits: np.ndarray, rows: tuple[int, ...]) -> np.ndarray:
    """Log probabilities (*rows, classes), the start token left out."""
    log_p = logits - logits.max(axis=1, keepdims=True)
    log_p -= np.log(np.exp(log_p).sum(axis=1, keepdims=True))
    log_p[:, -2] = -np.inf
    return log_p.reshape(*rows, -1)
