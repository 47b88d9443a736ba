"""Own rows beside the paper's numbers and the committed rows, also where these are few problems."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from cvqmpt_lab.paper_tables.claims import Comparison, JudgedClaim, points
from cvqmpt_lab.paper_tables.evidence import Evidence
from cvqmpt_lab.paper_tables.statements import CLAIMS, Claim
from cvqmpt_lab.paper_tables.within import FEWEST_PROBLEMS, MARGIN
from cvqmpt_lab.paper_tables.writers import Lines, estimate


class Judged(NamedTuple):
    """Results directories by name, and the claims judged by them."""

    found: Mapping[str, Evidence]
    claims: Sequence[JudgedClaim]


COUNTS = ("n_projections", "n_newton_iterations", "n_state_checks")
UNTESTABLE = "not testable"


def beside_lines(own: Sequence[JudgedClaim], committed: Sequence[JudgedClaim]) -> Lines:
    """Return a line per sentence: the paper's number, that of own rows, and that of committed rows.

    The numbers are those of the first comparison of the sentence.
    """
    lines = [["sentence", "paper", "here, with interval", "committed"]]
    for item, known in zip(own, committed, strict=True):
        first = known.comparisons[0] if known.comparisons else None
        paper = first.cells[0] if first else "–"
        told = f"{first.number}, {known.word}" if first else known.word
        lines.append([item.claim.title, paper, here(item), told])
    return lines


def here(item: JudgedClaim) -> str:
    """Return number, interval and result of a sentence for own rows."""
    if item.claim.untestable:
        return UNTESTABLE
    if not item.comparisons:
        return "not run"
    first = item.comparisons[0]
    if first.shown is None or first.shown.estimate is None:
        return "no problem that both solved"
    number = points(first.shown) if first.gain else estimate(first.shown)
    return f"{number}, {few_word(item.claim, first) if first.few else item.word}"


def few_word(claim: Claim, comparison: Comparison) -> str:
    """Return what the interval of few problems says about a sentence; this is no verdict."""
    interval = comparison.few
    assert interval is not None
    if interval.low is not None and interval.high is not None:
        if comparison.gain:
            bound = -MARGIN if claim.similar else 0.0
            above, below = interval.low > bound, interval.high < bound
        else:
            above, below = interval.high < 1.0, interval.low > 1.0
        if above or below:
            return "as the paper says" if above else "opposite"
    return f"{comparison.count} cannot decide"


def explained(own: Sequence[JudgedClaim]) -> str:
    """Return what the numbers of `beside_lines` mean, in one paragraph."""
    text = (
        "Ratios are those of the planners that the sentence names, of cost, path length or "
        "duration; below 1 is what the paper says. pt: percentage points of solved problems. "
        "Committed: the number of the committed rows, and the verdict on the whole sentence."
    )
    if any(item.few for judged in own for item in judged.comparisons):
        text += (
            f" Fewer than {FEWEST_PROBLEMS} problems give no verdict: their 95 % interval "
            "(Student) may lie on the paper's side, on the opposite one, or cannot decide."
        )
    return text


def repeated(found: Mapping[str, Evidence], committed: Mapping[str, Evidence]) -> str:
    """Return how many runs repeat the committed run of the same problem, or "".

    Only suites of the paper's sentences are compared, whose limits are counts and no seconds.
    """
    names = {name for claim in CLAIMS for name in claim.suites} & {*found} & {*committed}
    known = {row.key: row for name in names for row in committed[name].rows}
    both = [(row, known[row.key]) for name in names for row in found[name].rows if row.key in known]
    if not both:
        return ""
    pairs = [[(getattr(a, x) or 0, getattr(b, x) or 0) for x in COUNTS] for a, b in both]
    same = sum(a.solved == b.solved for a, b in both)
    exact = sum(all(a == b for a, b in counts) for counts in pairs)
    near = sum(all(abs(a - b) <= 0.01 * b for a, b in counts) for counts in pairs)
    return (
        f"Compared with the committed rows of the same {len(both)} runs, {same} have the same "
        f"result (solved or not), {exact} exactly the same counts of projections, Newton steps and "
        f"state checks, and {near} the same within 1 %. Other versions of packages "
        "or another arithmetic (`cvqmpt doctor`) shift counts a little."
    )
