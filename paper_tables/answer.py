"""The answer to "Is the paper replicated?" in one line: yes, no or in part, for each question."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

from cvqmpt_lab.paper_tables.claims import Comparison, JudgedClaim
from cvqmpt_lab.paper_tables.rule import Word

YES, IN_PART, NO, OPEN = "yes", "in part", "no", "undecided"
ORDER = ("Time", "Length", "Accuracy", "Algorithm 2")
GOOD = {Word.REPLICATED, Word.SMALLER}
BAD = {Word.SAME, Word.OPPOSITE}


class Part(NamedTuple):
    """The answer to one question."""

    question: str
    word: str  # YES, IN_PART, NO or OPEN
    here: str  # number of the first comparison, without its interval
    paper: str


def answer_word(comparisons: Sequence[Comparison]) -> str:
    """Return the answer that the comparisons of a sentence give together.

    YES: all are replicated. IN_PART: some are, or have a smaller effect, or do so for some time of
    networks. NO: none is, and some have no effect or the opposite one. OPEN: nothing is decided.
    """
    words = [{item.word, *item.others, *item.words.values()} for item in comparisons]
    if words and all({item.word, *item.others} == {Word.REPLICATED} for item in comparisons):
        return YES
    if any(each & GOOD for each in words):
        return IN_PART
    return NO if any(each & BAD for each in words) else OPEN


def answer_parts(claims: Iterable[JudgedClaim]) -> list[Part]:
    """Return the answers of the claims that give one and have rows, in `ORDER`."""
    found = []
    for item in claims:
        if item.claim.answers and item.deciding:
            first = item.deciding[0]
            word = answer_word(item.deciding)
            found.append(Part(item.claim.answers, word, first.number, first.cells[0]))
    return sorted(found, key=lambda part: ORDER.index(part.question))


def whole_word(parts: Sequence[Part]) -> str:
    """Return the answer to all questions together."""
    words = {part.word for part in parts} or {OPEN}
    if len(words) == 1:
        return words.pop()
    return IN_PART if words & {YES, IN_PART} else NO
