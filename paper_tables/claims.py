"""Judge every sentence of the paper by the rows of results directories, by `rule`."""

import csv
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product
from operator import attrgetter
from pathlib import Path

import numpy as np

from cvqmpt_lab.benchmarks.results.row import (
    split_problem,
)
from cvqmpt_lab.benchmarks.results.statistics import Interval
from cvqmpt_lab.paper_tables import rule
from cvqmpt_lab.paper_tables.evidence import Evidence
from cvqmpt_lab.paper_tables.kept_draws import kept_effects, kept_within
from cvqmpt_lab.paper_tables.measures import (
    VALUES,
    Pair,
    Rows,
    Value,
    grouped,
    mean_ratio,
    paired,
    problem_mean,
)
from cvqmpt_lab.paper_tables.ompl_table import PAPER_CUTOFF_S
from cvqmpt_lab.paper_tables.rendering import published_of
from cvqmpt_lab.paper_tables.rule import Effect, Word
from cvqmpt_lab.paper_tables.statements import (
    CBIRRT,
    CLAIMS,
    CVQ,
    OPT,
    Claim,
    in_ompl,
)
from cvqmpt_lab.paper_tables.within import FEWEST_PROBLEMS, Within
from cvqmpt_lab.paper_tables.writers import Lines, estimate

# the cost of a run by the time that the network takes
COSTS = {
    "0 s, as published": "search_cost",
    "10 ms a prediction": "gpu_cost",
    "this machine": "paper_cost",
}
LENGTHS = {"length": "ompl_length", "execution": "execution_time"}


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """A sentence about one planner against one baseline."""

    planner: str
    baseline: str
    count: int  # problems
    failed: tuple[int, int]  # failed runs of the planner and of the baseline
    paper: float | None  # the paper's ratio, or its difference of shares
    word: Word
    effect: Effect | None = None  # of ratios, at the published prices and without networks
    within: Within | None = None  # of times: the shares solved within the same time
    others: tuple[Word, ...] = ()  # words within the bootstrap's error of a border
    gain: Interval | None = None  # of shares
    # the ratio or the difference of shares, where there are too few problems for a word
    few: Interval | None = None
    words: Mapping[str, Word] = field(default_factory=dict)  # by the time of networks
    pybullet: tuple[Effect, Word] | None = None  # at the prices of PyBullet's kinematics
    needed: int | None = None  # problems that would decide an inconclusive comparison
    seconds: float = 0.0  # both planners' time for a problem on this machine [s]
    # kinds without an effect: a planner solved fewer than `FEWEST_SOLVED` of their problems
    left_out: tuple[str, ...] = ()

    @property
    def told(self) -> str:
        """The word, and others that the bootstrap does not exclude."""
        return " or ".join((self.word, *self.others))

    @property
    def cells(self) -> list[str]:
        """The paper's number, both statistics and the word."""
        if self.gain is not None:
            paper = "–" if self.paper is None else points(Interval(self.paper, None, None, 0))
            return [paper, points(self.few or self.gain), "–", self.told]
        paper = "–" if self.paper is None else f"{self.paper:.2f}"
        means, geometric = ("–", "–") if self.effect is None else map(estimate, self.effect[:2])
        return [paper, estimate(self.few) if self.few else means, geometric, self.told]

    @property
    def number(self) -> str:
        """The number here without its interval, ratios with two decimals."""
        if self.shown is None or self.shown.estimate is None:
            return "–"
        middle = self.shown.estimate
        return points(Interval(middle, None, None, 0)) if self.gain else f"{middle:.2f}"

    @property
    def shown(self) -> Interval | None:
        """The ratio or the difference of shares that pages show; None: nothing can be compared."""
        return self.few or self.gain or (self.effect and self.effect.means)

    @property
    def to_decide(self) -> str:
        """Problems that would decide an inconclusive comparison, and their time on a core."""
        if self.needed is None:
            return "–"
        hours = self.needed * self.seconds / 3600.0
        return f"{self.needed} problems, {hours:.2g} core-hours"


@dataclass(frozen=True, eq=False)
class JudgedClaim:
    """A claim with its comparisons."""

    claim: Claim
    comparisons: tuple[Comparison, ...]
    evidence: tuple[Evidence, ...]

    @cached_property
    def deciding(self) -> tuple[Comparison, ...]:
        """The comparisons with the first baseline of the sentence, which give its word."""
        first = self.claim.baselines[:1]
        return tuple(item for item in self.comparisons if item.baseline in first)

    @property
    def words(self) -> tuple[Word, ...]:
        """The word of the claim, and others that the bootstrap does not exclude."""
        if self.claim.untestable or not self.deciding:
            return (Word.UNTESTABLE if self.claim.untestable else Word.NO_ROWS,)
        of_each = [(item.word, *item.others) for item in self.deciding]
        return tuple(dict.fromkeys(map(rule.weakest, product(*of_each))))

    @property
    def word(self) -> str:
        """The words as text."""
        return " or ".join(self.words)

    @property
    def to_decide(self) -> str:
        """The largest number of problems that its comparisons need, if it is inconclusive."""
        if Word.OPEN not in self.words:
            return "–"
        needed = [item for item in self.deciding if item.needed is not None]
        return max(needed, key=attrgetter("needed")).to_decide if needed else "–"


def sentence_level() -> float:
    """Return the two-sided level of an interval: Bonferroni over the judged sentences."""
    return rule.LEVEL / sum(not claim.untestable for claim in CLAIMS)


def judged_claims(found: Mapping[str, Evidence]) -> list[JudgedClaim]:
    """Judge every claim by the rows that count; found: results directories by name."""
    judged = []
    counted = {
        name: found[name].judged for claim in CLAIMS for name in claim.suites if name in found
    }
    for claim in CLAIMS:
        own = tuple(counted[name] for name in claim.suites if name in counted)
        complete = bool(own) and len(own) == len(claim.suites)
        made = comparisons(claim, own, sentence_level()) if complete else ()
        judged.append(JudgedClaim(claim, tuple(made), own))
    return judged


def comparisons(claim: Claim, own: Sequence[Evidence], level: float) -> list[Comparison]:
    """Return each planner's comparison with each baseline, where both have rows.

    Args:
        claim: claim that is judged.
        own: results directories of its suites.
        level: of intervals, two-sided.
    """
    made = []
    for planner, baseline in product(claim.planners, claim.baselines):
        parts = [both_ran(item, planner, baseline) for item in own]
        if all(parts):
            compare = _compared_shares if claim.is_share else _compared
            made.append(compare(claim, planner, baseline, parts, level))
    return made


Both = Sequence[tuple[str, Rows, Rows]]  # problem, run of the planner, run of the baseline
Sides = tuple[np.ndarray, ...]  # values of the planner, and of the baseline, by price and problem


def both_ran(evidence: Evidence, planner: str, baseline: str) -> Both:
    """Return the runs of problems that both planners tried."""
    ours, other = (evidence.runs.get(name, {}) for name in (planner, baseline))
    return [(key[0], rows, other[key]) for key, rows in ours.items() if key in other]


def _solved(run: Rows) -> bool:
    return all(row.solved for row in run)


def cost_of(run: Rows, value: Value) -> float | None:
    """Return the cost of a solved run in the paper's currency [s]; None for a failed one.

    A phase costs at most the cut-off: a run ends after the iteration that passes it.
    """
    return _size(run, lambda row: None if (x := value(row)) is None else min(x, PAPER_CUTOFF_S))


def cost_sides(runs: Both) -> np.ndarray:
    """Return costs (2, n) of the planner and of the baseline [s]; NaN: not solved."""
    costs = [[cost_of(run, VALUES["search_cost"]) for run in pair] for _, *pair in runs]
    return np.array(costs, dtype=float).T


def _size(run: Rows, value: Value) -> float | None:
    """Return the sum of a value over a solved run; None for a failed one."""
    sizes = [value(row) for row in run]
    return sum(x for x in sizes if x) if _solved(run) and None not in sizes else None


def published_number(claim: Claim, planner: str) -> float | None:
    """Return the paper's number of a planner for the measure of a claim."""
    for item in in_ompl(published_of(claim.suites[0])) if claim.suites else ():
        if item.metric == claim.paper and item.planner == planner:
            return float(item.value)
    return None


def paper_number(claim: Claim, planner: str, baseline: str) -> float | None:
    """Return the paper's ratio of a planner to a baseline, or its difference of shares."""
    ours, other = (published_number(claim, name) for name in (planner, baseline))
    if ours is None or other is None:
        return None
    return (ours - other) / 100.0 if claim.is_share else ours / other


def _unjudged(claim: Claim, planner: str, baseline: str, parts: Sequence[Both]) -> Comparison:
    """Return what a comparison has before its numbers are judged."""
    return Comparison(
        planner=planner,
        baseline=baseline,
        count=0,
        failed=_failures(parts),
        paper=paper_number(claim, planner, baseline),
        word=Word.OPEN,
        seconds=_seconds(parts),
    )


def _compared_shares(
    claim: Claim, planner: str, baseline: str, parts: Sequence[Both], level: float
) -> Comparison:
    runs = [item for part in parts for item in part]
    solved = [_solved(ours) for _, ours, _ in runs], [_solved(other) for _, _, other in runs]
    found = _unjudged(claim, planner, baseline, parts)
    gain = rule.share_gain(*solved, level)
    word = rule.share_word(gain, found.paper, claim.similar)
    needed, few = None, None
    if gain.low is None:
        few = rule.few_gain(*solved)
    if word is Word.OPEN and gain.n >= FEWEST_PROBLEMS:
        needed = max(gain.n + 1, rule.shares_needed(*solved, level))
    return replace(found, count=len(runs), word=word, gain=gain, few=few, needed=needed)


def _compared(
    claim: Claim, planner: str, baseline: str, parts: Sequence[Both], level: float
) -> Comparison:
    found = _unjudged(claim, planner, baseline, parts)
    # a number that contradicts its sentence is none
    reached = None if found.paper is None or found.paper >= 1.0 else found.paper
    timed = claim.measure == "cost"
    prices = [*COSTS.values(), "search_cost_pybullet"] if timed else [LENGTHS[claim.measure]]
    kinds = _values(claim, parts, prices)
    if not kinds:
        return found
    by_kind = {kind: kept_effects(ours, theirs, level) for kind, (ours, theirs) in kinds.items()}
    effects = _effects(claim, [*by_kind.values()], level)
    own, other = (np.concatenate(sides, axis=1) for sides in zip(*kinds.values(), strict=True))
    within: list[Within | None] = [None] * len(prices)
    if timed:
        within = [kept_within(*sides, claim.limit, level) for sides in zip(own, other, strict=True)]
    judged = list(zip(effects, within, strict=True))
    count = own.shape[1]
    words, pybullet = {}, None
    if timed:
        *judged, cheap = judged
        pybullet = cheap[0], rule.word_of(cheap[0], reached, cheap[1])
        words = {
            name: rule.word_of(made, reached, shares)
            for name, (made, shares) in zip(COSTS, judged, strict=True)
        }
    word, others = rule.word_of_prices(
        [made for made, _ in judged], reached, [shares for _, shares in judged]
    )
    effect, shares = judged[0]
    few = rule.few_ratio(own[0], other[0]) if effect.means.low is None else None
    needed = None
    if Word.OPEN in (word, *others) and effect.means.low is not None:
        needed = (
            rule.pooled_needed(effect.means, count, level)
            if claim.pooled
            else rule.problems_needed(own[0], other[0], level)
        )
        if shares is not None and not shares.not_fewer:
            needed = max(needed, shares.needed)
        needed = max(needed, count + 1)
    return replace(
        found,
        count=count,
        word=word,
        others=others,
        effect=effect,
        within=shares,
        few=few,
        words=words,
        pybullet=pybullet,
        needed=needed,
        left_out=tuple(
            kind for kind, made in by_kind.items() if claim.pooled and made[0].means.low is None
        ),
    )


def _effects(claim: Claim, by_kind: Sequence[list[Effect]], level: float) -> list[Effect]:
    """Return the effect at each price; those of kinds are pooled if the claim says so."""
    if not claim.pooled:
        return by_kind[0]
    made = []
    for effects in zip(*by_kind, strict=True):
        known = [item for item in effects if item.means.low is not None]
        unknown = Effect.of((), (), level)
        made.append(rule.pooled(known, level) if len(known) > 1 else unknown)
    return made


def _values(claim: Claim, parts: Sequence[Both], prices: Sequence[str]) -> dict[str, Sides]:
    """Return values of both planners by kind of problem, if kinds are pooled.

    Costs are of all problems that both tried, lengths of those that both solved.
    """
    timed = claim.measure == "cost"
    of_run = cost_of if timed else _size
    found: dict[str, list[list[list[float]]]] = {}
    for problem, *runs in (item for part in parts for item in part):
        sides = [[of_run(run, VALUES[price]) for price in prices] for run in runs]
        solved = [timed and not _solved(run) for run in runs]
        if any(None in side and not failed for side, failed in zip(sides, solved, strict=True)):
            continue
        kind = split_problem(problem).phase if claim.pooled else ""
        numbers = [[math.nan if x is None else x for x in side] for side in sides]
        found.setdefault(kind, []).append(numbers)
    return {kind: tuple(np.array(values).transpose(1, 2, 0)) for kind, values in found.items()}


def _seconds(parts: Sequence[Both]) -> float:
    """Return the mean time of a problem, of both planners together [s]."""
    runs = [[*ours, *other] for part in parts for _, ours, other in part]
    return sum(row.t_total_s or 0.0 for rows in runs for row in rows) / len(runs)


def _failures(parts: Sequence[Both]) -> tuple[int, int]:
    """Return the numbers of failed runs of the planner and of the baseline."""
    runs = [item for part in parts for item in part]
    return sum(not _solved(run[1]) for run in runs), sum(not _solved(run[2]) for run in runs)


def points(gain: Interval) -> str:
    """Return a difference of shares as percentage points with its interval, within ±100."""

    def shown(share: float) -> str:
        return f"{round(100.0 * min(max(share, -1.0), 1.0)):+d}".replace("-", "−").replace(
            "+0", "0"
        )

    if gain.estimate is None:
        return "–"
    inside = (
        ""
        if gain.low is None or gain.high is None
        else (f" [{shown(gain.low)}, {shown(gain.high)}]")
    )
    return f"{shown(gain.estimate)}{inside} pt"


# ---------------------------------------------------------------- beside the claims


def transfer_lines(evidence: Evidence) -> Lines:
    """Return ratios of seconds of this machine, with compiled checks; they have no words."""
    runs = grouped((row.planner, row) for row in evidence.rows)
    baselines = (CBIRRT, "birrt")
    lines = [["planner", "solved", *(f"time / {name}, geometric mean" for name in baselines)]]
    for planner, rows in runs.items():
        cells = [f"`{planner}`", f"{sum(row.solved for row in rows)} of {len(rows)}"]
        for baseline in baselines:
            pairs = paired(rows, runs.get(baseline, ()), VALUES["own_time"])
            cells.append("–" if planner == baseline else estimate(mean_ratio(pairs)))
        lines.append(cells)
    return lines


def task_lines(evidence: Evidence) -> Lines:
    """Return the paper's Table II beside means over tasks: planning in the paper's currency."""
    published = published_of(evidence.rows[0].suite)
    numbers = {(x.planner, x.metric): x.value for x in in_ompl(published)}
    metrics = {"planning_time": "planning", "execution_time": "execution", "total_time": "total"}
    heads = (f"{name} [s], {who}" for name in metrics.values() for who in ("paper", "here"))
    lines = [["planner", "tasks solved", *heads]]
    for planner, runs in evidence.runs.items():
        planning = [cost_of(run, VALUES["search_cost"]) for run in runs.values()]
        moving = [_size(run, VALUES["execution_time"]) for run in runs.values()]
        pairs = zip(planning, moving, strict=True)
        total = [a + b for a, b in pairs if a is not None and b is not None]
        cells = []
        columns: tuple[Sequence[float | None], ...] = (planning, moving, total)
        for metric, values in zip(metrics, columns, strict=True):
            mean = problem_mean([[x] for x in values if x is not None])
            cells += [str(numbers.get((planner, metric), "–")), estimate(mean)]
        tasks = f"{len(runs) - planning.count(None)} of {len(runs)}"
        lines.append([f"`{planner}`", tasks, *cells])
    return lines


def mechanism_lines(found: Mapping[str, Evidence]) -> Lines:
    """Return what Algorithm 2 changes before the search: Newton steps of a draw, and G."""
    lines = [["mechanism of Algorithm 2", "ratio, 95 %"]]
    if "place-task-ompl" in found:
        runs = grouped((row.planner, row) for row in found["place-task-ompl"].rows)
        pairs = paired(runs.get(OPT, ()), runs.get(CVQ, ()), VALUES["draw_newton_steps"])
        name = f"Newton steps to project a sample, `{OPT}` / `{CVQ}`"
        lines.append([name, estimate(mean_ratio(pairs))])
    if "histogram" in found:
        name = "G = F(q)ᵀF(q) of samples of the predicted codes, after / before the update"
        lines.append([name, estimate(mean_ratio(updated_codes(found["histogram"].folder)))])
    return lines


def updated_codes(folder: Path) -> list[Pair]:
    """Return G of predicted codes after and before the update, by problem."""
    codes = []
    with (folder / "values.csv").open(encoding="utf-8", newline="") as handle:
        for line in csv.DictReader(handle):
            after, before = float(line["g_after"]), float(line["g_before"])
            if line["code"] != "goal" and after > 0.0 < before:
                codes.append((line["problem"], (after, before)))
    return [Pair(*of_it) for of_it in grouped(codes).items()]
