"""Beam search on a table of probabilities against a plain implementation."""

import numpy as np
import pytest
from refusals import refused

from cvqmpt_lab.vqmpt.beam_search import beam_search

CODES = 4
START, GOAL = CODES, CODES + 1
STEPS = 12


class TableDecoder:
    """P(next | step, last code) by query; the last code is 'none' (row 4) at first."""

    def __init__(self, tables):
        self.tables = np.asarray(tables, dtype=np.float32)

    def start(self):
        self.queries, self.prefixes = np.arange(len(self.tables)), [()] * len(self.tables)
        classes, log_p = self._log_probabilities()
        log_p[:, GOAL] = -np.inf
        return classes, log_p

    def advance(self, parents, codes):
        self.queries = np.array([self.queries[p] for p in parents])
        self.prefixes = [self.prefixes[p] + (int(c),) for p, c in zip(parents, codes, strict=True)]
        assert all(code < CODES for prefix in self.prefixes for code in prefix)
        return self._log_probabilities()

    def _log_probabilities(self):
        rows = [given(self.tables[q], p) for q, p in zip(self.queries, self.prefixes, strict=True)]
        log_p = np.log(np.array(rows))
        log_p[:, START] = -np.inf
        return np.broadcast_to(np.arange(CODES + 2), log_p.shape), log_p


def given(table, prefix):
    """P(next) after a prefix; later steps have the last step's table."""
    return table[min(len(prefix), STEPS - 1), prefix[-1] if prefix else CODES]


def tables(seed, queries=1, goal=0.15):
    shape = (queries, STEPS, CODES + 1)
    weights = np.random.default_rng(seed).dirichlet([0.5] * CODES, shape) * (0.95 - goal) + 1e-4
    both = np.concatenate((weights, np.broadcast_to([0.05, goal], (*shape, 2))), axis=-1)
    return both / both.sum(-1, keepdims=True)


def beam_by_hand(table, k, length):
    """Codes with the goal token, if it came, and score, by the rules of the published code."""
    ranked = sorted(range(CODES), key=lambda code: -given(table, ())[code])[:k]
    beams = [((code,), np.log(given(table, ())[code])) for code in ranked]
    for _ in range(length - 1):
        forbidden = {codes[-1] for codes, _ in beams}
        candidates = [
            ((*codes, code), score + given(table, codes)[code])
            for codes, score in beams
            for code in {*range(CODES), GOAL} - forbidden
        ]
        beams = sorted(candidates, key=lambda c: -c[1])[:k]
        for codes, score in beams:
            if codes[-1] == GOAL:
                return codes, score
    return beams[0]


@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize(("beams", "length"), [(1, 12), (2, 1), (2, 4), (3, 6)])
def test_beams_in_a_batch_are_searched_by_the_rules_of_the_published_code(seed, beams, length):
    table = tables(seed, queries=4, goal=0.03)
    searched = beam_search(TableDecoder(table), beams=beams, max_length=length, published=True)
    for query, (found, *_) in enumerate(searched):
        codes, score = beam_by_hand(table[query], beams, length)
        assert found.codes + (GOAL,) * found.finished == codes
        assert found.score == pytest.approx(score, abs=1e-5)


def test_what_cannot_be_searched_is_refused():
    for beams in (0, 5):
        refused(f"{beams} beams; give 1 to 4", beam_search, TableDecoder(tables(0)), beams=beams)
    refused("not finite", beam_search, TableDecoder(tables(0) * np.nan))
