"""Judge every sentence of the paper by the rows of results directories, by `rule`."""

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from itertools import product
from operator import attrgetter
from pathlib import Path
from typing import Any

from cvqmpt_lab.benchmarks.declarations import SUITES
from cvqmpt_lab.benchmarks.results.provenance import PROVENANCE_FILE, ProvenanceFile, sessions
from cvqmpt_lab.benchmarks.results.row import (
    PAPER_PHASES,
    RUNS_FILE,
    FailReason,
    ResultRow,
    read_rows,
    split_problem,
    without_ended,
)
from cvqmpt_lab.benchmarks.results.statistics import Interval
from cvqmpt_lab.paper_tables import rule
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
from cvqmpt_lab.paper_tables.statements import CBIRRT, CLAIMS, CVQ, IN_OMPL, OPT, Claim
from cvqmpt_lab.paper_tables.writers import Lines, estimate

# the cost of a run by the time that the network takes
COSTS = {
    "0 s, as published": "search_cost",
    "10 ms a prediction": "gpu_cost",
    "this machine": "paper_cost",
}
LENGTHS = {"length": "ompl_length", "execution": "execution_time"}


@dataclass(frozen=True, eq=False)
class Evidence:
    """A results directory."""

    folder: Path
    rows: Rows  # empty for a figure
    record: dict[str, Any]  # its provenance

    @cached_property
    def runs(self) -> dict[str, dict[tuple[str, int], Rows]]:
        """Rows of each run by planner, and by problem and seed.

        A run of a task has the rows of the phases that the paper times; a task in which another
        phase failed is left out. So are problems that could not be made.
        """
        suite = SUITES.get(self.rows[0].suite) if self.rows else None
        of_tasks = suite is not None and suite.of_tasks
        found: dict[str, dict[tuple[str, int], list[ResultRow]]] = {}
        for row in filter(attrgetter("made"), self.rows):
            problem = row.item if of_tasks else row.problem
            found.setdefault(row.planner, {}).setdefault((problem, row.seed), []).append(row)
        counted = _timed_phases if of_tasks else tuple
        return {
            planner: {key: kept for key, rows in runs.items() if (kept := counted(rows))}
            for planner, runs in found.items()
        }


def _timed_phases(task: Rows) -> Rows:
    """Return the rows of the phases that the paper times; none if another phase failed."""
    timed = [row for row in task if split_problem(row.problem).phase in PAPER_PHASES]
    others = [row for row in task if row not in timed and not row.solved]
    untimed_failure = any(row.fail_reason is not FailReason.NOT_REACHED for row in others)
    return () if untimed_failure else timed


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
    gain: Interval | None = None  # of shares
    # the ratio or the difference of shares, where there are too few problems for a word
    few: Interval | None = None
    words: Mapping[str, Word] = field(default_factory=dict)  # by the time of networks
    pybullet: tuple[Effect, Word] | None = None  # at the prices of PyBullet's kinematics
    needed: int | None = None  # problems that would decide an inconclusive comparison
    seconds: float = 0.0  # both planners' time for a problem on this machine [s]

    @property
    def cells(self) -> list[str]:
        """The paper's number, both statistics and the word."""
        if self.gain is not None:
            paper = "–" if self.paper is None else points(Interval(self.paper, None, None, 0))
            return [paper, points(self.few or self.gain), "–", str(self.word)]
        paper = "–" if self.paper is None else f"{self.paper:.2f}"
        means, geometric = ("–", "–") if self.effect is None else map(estimate, self.effect)
        return [paper, estimate(self.few) if self.few else means, geometric, str(self.word)]

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

    @property
    def word(self) -> str:
        """Word of the claim, see `rule.claim_word`."""
        if self.claim.untestable:
            return str(Word.UNTESTABLE)
        return rule.claim_word([item.word for item in self.comparisons] or [Word.NO_ROWS])


def sentence_level() -> float:
    """Return the two-sided level of an interval: Bonferroni over the judged sentences."""
    return rule.LEVEL / sum(not claim.untestable for claim in CLAIMS)


def judged_claims(found: Mapping[str, Evidence]) -> list[JudgedClaim]:
    """Judge every claim; found: results directories by name."""
    judged = []
    for claim in CLAIMS:
        own = tuple(found[name] for name in claim.suites if name in found)
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
        parts = [_runs(item, planner, baseline) for item in own]
        if all(parts):
            compare = _compared_shares if claim.is_share else _compared
            made.append(compare(claim, planner, baseline, parts, level))
    return made


Both = Sequence[tuple[str, Rows, Rows]]  # problem, run of the planner, run of the baseline


def _runs(evidence: Evidence, planner: str, baseline: str) -> Both:
    """Return the runs of problems that both planners tried."""
    ours, other = (evidence.runs.get(name, {}) for name in (planner, baseline))
    return [(key[0], rows, other[key]) for key, rows in ours.items() if key in other]


def _solved(run: Rows) -> bool:
    return all(row.solved for row in run)


def _cost(run: Rows, value: Value) -> float | None:
    """Return the cost of a run in the paper's currency [s], at most the cut-off of each phase."""
    costs = [value(row) if row.solved else PAPER_CUTOFF_S for row in run]
    return None if None in costs else sum(min(x, PAPER_CUTOFF_S) for x in costs if x is not None)


def _size(run: Rows, value: Value) -> float | None:
    """Return the sum of a value over a solved run; None for a failed one."""
    sizes = [value(row) for row in run]
    return sum(x for x in sizes if x) if _solved(run) and None not in sizes else None


def paper_number(claim: Claim, planner: str, baseline: str) -> float | None:
    """Return the paper's ratio of a planner to a baseline, or its difference of shares."""
    numbers = {
        IN_OMPL.get(item.planner, item.planner): float(item.value)
        for item in (published_of(claim.suites[0]) if claim.suites else ())
        if item.metric == claim.paper
    }
    if planner not in numbers or baseline not in numbers:
        return None
    ours, other = numbers[planner], numbers[baseline]
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
    if word is Word.OPEN and gain.n >= rule.FEWEST_PROBLEMS:
        needed = max(gain.n + 1, rule.shares_needed(*solved, level))
    return replace(found, count=len(runs), word=word, gain=gain, few=few, needed=needed)


def _compared(
    claim: Claim, planner: str, baseline: str, parts: Sequence[Both], level: float
) -> Comparison:
    found = _unjudged(claim, planner, baseline, parts)
    # a number that contradicts its sentence is none
    reached = None if found.paper is None or found.paper >= 1.0 else found.paper

    @cache
    def effect(value: str) -> Effect:
        pairs = _pairs(claim, parts, VALUES[value])
        effects = [Effect.of(*_sides(values), level) for values in pairs.values()]
        if not claim.pooled:
            return effects[0]
        known = [item for item in effects if item.means.low is not None]
        if len(known) < 2:
            return Effect.of((), (), level)
        return Effect(*(rule.pooled(side, level, level) for side in zip(*known, strict=True)))

    timed = claim.measure == "cost"
    main = COSTS["0 s, as published"] if timed else LENGTHS[claim.measure]
    values = [pair for kind in _pairs(claim, parts, VALUES[main]).values() for pair in kind]
    if not values:
        return found
    word, words, pybullet, needed = rule.word_of(effect(main), reached), {}, None, None
    few = rule.few_ratio(*_sides(values)) if effect(main).means.low is None else None
    if timed:
        words = {name: rule.word_of(effect(cost), reached) for name, cost in COSTS.items()}
        word = rule.word_on_all_hardware(words)
        cheap = effect("search_cost_pybullet")
        pybullet = cheap, rule.word_of(cheap, reached)
    if word is Word.OPEN and not claim.pooled and len(values) >= rule.FEWEST_PROBLEMS:
        sides = _sides(values)
        # an effect that excludes 1 can be too wide for a word
        sizes = rule.problems_needed(*sides, level), rule.problems_for_width(*sides, level)
        needed = max(len(values) + 1, *sizes)
    return replace(
        found,
        count=len(values),
        word=word,
        effect=effect(main),
        few=few,
        words=words,
        pybullet=pybullet,
        needed=needed,
    )


def _pairs(
    claim: Claim, parts: Sequence[Both], value: Value
) -> dict[str, list[tuple[float, float]]]:
    """Return values of both planners on each problem, by kind of problem if kinds are pooled."""
    of_run = _cost if claim.measure == "cost" else _size
    found: dict[str, list[tuple[float, float]]] = {}
    for problem, *runs in (item for part in parts for item in part):
        own, other = (of_run(run, value) for run in runs)
        if own and other:
            kind = split_problem(problem).phase if claim.pooled else ""
            found.setdefault(kind, []).append((own, other))
    return found


def _sides(pairs: Sequence[tuple[float, float]]) -> tuple[list[float], list[float]]:
    """Return the planner's values, and the baseline's."""
    return [own for own, _ in pairs], [other for _, other in pairs]


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
    numbers = {(IN_OMPL.get(x.planner, x.planner), x.metric): x.value for x in published}
    metrics = {"planning_time": "planning", "execution_time": "execution", "total_time": "total"}
    heads = (f"{name} [s], {who}" for name in metrics.values() for who in ("paper", "here"))
    lines = [["planner", "tasks", *heads]]
    for planner, runs in evidence.runs.items():
        planning = [_cost(run, VALUES["search_cost"]) for run in runs.values()]
        moving = [_size(run, VALUES["execution_time"]) for run in runs.values()]
        pairs = zip(planning, moving, strict=True)
        total = [a + b for a, b in pairs if a is not None and b is not None]
        cells = []
        columns: tuple[Sequence[float | None], ...] = (planning, moving, total)
        for metric, values in zip(metrics, columns, strict=True):
            mean = problem_mean([[x] for x in values if x is not None])
            cells += [str(numbers.get((planner, metric), "–")), estimate(mean)]
        lines.append([f"`{planner}`", str(len(runs)), *cells])
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


def profiles(found: Mapping[str, Evidence]) -> list[str]:
    """Return the profiles of rows that are too small for verdicts: all except "full"."""
    records = [session for item in found.values() for session in sessions(item.record)]
    named = dict.fromkeys(session.get("profile") for session in records)
    return [name for name in named if name and name != "full"]


def banner(found: Mapping[str, Evidence]) -> str:
    """Return a warning if a profile of the rows is too small for verdicts, else ""."""
    small = profiles(found)
    if not small:
        return ""
    return (
        f"These rows were made with --profile {', '.join(small)}, which is a quick trial: few "
        "problems and wide intervals. Verdicts on the paper need --profile full."
    )


def evidence_below(results: Path) -> dict[str, Evidence]:
    """Return the results directories below a folder, by name."""
    folders = sorted(path.parent for path in Path(results).glob(f"*/{PROVENANCE_FILE}"))
    return {folder.name: read_evidence(folder) for folder in folders}


def read_evidence(folder: Path) -> Evidence:
    """Return rows and provenance of a results directory."""
    rows = read_rows(folder / RUNS_FILE) if (folder / RUNS_FILE).is_file() else []
    return Evidence(folder, without_ended(rows), ProvenanceFile(folder).read())
