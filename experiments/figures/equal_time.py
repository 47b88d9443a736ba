"""Length at equal time:
the best path by time t of methods that are restarted, or left to improve, until then.
"""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.pipeline import Solution, solve, with_sampled_goals
from cvqmpt_lab.planners import PLANNERS
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.results.statistics import (
    Interval,
    geometric_mean_interval,
    mean_of_solved,
    median_interval,
)
from cvqmpt_lab.search.result import Budget
from experiments.figures.drawing import Panel, panels_figure, save_figure, write_csv
from paper_tables.measures import REFERENCE

RESTARTED = tuple(name for name in (REFERENCE, "opt-cvq-mpt", "roadmap-cvq") if name in PLANNERS)
IMPROVED = "--optimize"
LEFT_TO_IMPROVE = (REFERENCE, "roadmap", "roadmap-cvq")
SECONDS = 0.5  # of planning and shortening, a problem and method
CUTOFF = Budget(seconds=10.0)  # of each search
WITHIN = 1.1  # of the best length known
TIMES = tuple(float(t) for t in np.geomspace(2e-3, SECONDS, 25))
NAME = "equal-time"

Trace = Sequence[tuple[float, float]]  # time [s] of a path and its length [rad], ever shorter


def restarted(problem: PlanningProblem, planner: str, seconds: float) -> Trace:
    """Search and shorten with one seed after another until the time is up;
    certificates and goals are not counted.
    """
    found: list[tuple[float, float]] = []
    spent, seed = 0.0, 0
    while spent < seconds:
        solution = solve(problem, planner, CUTOFF, seed, clearance=False)
        spent, seed = spent + _took(solution), seed + 1
        length = (
            solution.simplified.path.length if solution.solved and solution.simplified else math.inf
        )
        if length < (found[-1][1] if found else math.inf):
            found.append((spent, length))
    return found


def improved(problem: PlanningProblem, planner: str, seconds: float) -> Trace:
    """One path, and what `solve` makes of the time with `optimize`."""
    solution = solve(problem, planner, CUTOFF, 0, clearance=False, optimize=Budget(seconds=seconds))
    if not solution.solved or solution.improvement is None:
        return []
    first = _took(solution)
    return [(first + t, length) for t, length in solution.improvement.lengths]


def _took(solution: Solution) -> float:
    return solution.plan.seconds + (solution.simplified.seconds if solution.simplified else 0.0)


def best_by(trace: Trace, time: float) -> float:
    """Length [rad] of the best path found by a time [s]; infinite before the first."""
    return min((length for t, length in trace if t <= time), default=math.inf)


def time_to(trace: Trace, length: float) -> float:
    """When a path no longer than that was found [s]; infinite if never."""
    return min((t for t, found in trace if found <= length), default=math.inf)


def traces_of(problem: PlanningProblem, seconds: float) -> dict[str, Trace]:
    """What every method finds of a problem, by name."""
    problem = with_sampled_goals(problem)[0]
    return {
        **{name: restarted(problem, name, seconds) for name in RESTARTED},
        **{f"{name} {IMPROVED}": improved(problem, name, seconds) for name in LEFT_TO_IMPROVE},
    }


def draw_equal_time(problems: Sequence[PlanningProblem], folder: Path) -> list[Path]:
    """Run every method on every problem and draw;
    the first problem is run once before, so that nothing loads later.
    """
    traces_of(problems[0], 1e-3)
    found = [
        traces for problem in problems if any((traces := traces_of(problem, SECONDS)).values())
    ]
    if not found:
        raise InvalidInputError(
            f"no method solved any of {len(problems)} problems in {SECONDS:g} s: nothing to draw"
        )
    best = [min(length for trace in traces.values() for _, length in trace) for traces in found]
    ratios: dict[str, list[Interval]] = {}
    shares: dict[str, list[Interval]] = {}
    reached: dict[str, list[float]] = {}
    for name in found[0]:
        pairs = [(traces[name], known) for traces, known in zip(found, best, strict=True)]
        by_then = [[best_by(trace, time) / known for trace, known in pairs] for time in TIMES]
        # a mean ratio is drawn from when on all but a twentieth have a path
        ratios[name] = [mean_of_solved(r if np.isfinite(r).mean() >= 0.95 else []) for r in by_then]
        near = [100.0 * float(np.mean([ratio <= WITHIN for ratio in r])) for r in by_then]
        shares[name] = [Interval(percent, None, None, len(pairs)) for percent in near]
        reached[name] = [time_to(trace, WITHIN * known) for trace, known in pairs]
    x, label = [1e3 * t for t in TIMES], "time [ms]"
    panels = [
        Panel(
            "best length by then / best known",
            label,
            "ratio",
            x,
            ratios,
            log=(True, False),
            level=1.0,
        ),
        Panel("problems within 10 % of the best known", label, "%", x, shares, log=(True, False)),
    ]
    table = [_cells(name, reached) for name in reached]
    return [
        *save_figure(panels_figure(panels), folder, NAME),
        write_csv(folder / f"{NAME}.csv", table),
    ]


def _cells(name: str, reached: Mapping[str, Sequence[float]]) -> dict[str, object]:
    """A method's line of the table;
    where it never came so near, the whole time stands in the ratio.
    """
    own = np.minimum(reached[name], SECONDS)
    ratio = geometric_mean_interval(np.minimum(reached[REFERENCE], SECONDS) / own)
    middle = median_interval(reached[name])
    return {
        "method": name,
        "problems": len(own),
        "within_10_percent": int(np.isfinite(reached[name]).sum()),
        "median_s": middle.estimate,
        "median_s_low": middle.low,
        "median_s_high": middle.high,
        f"time_of_{REFERENCE}_over_its": ratio.estimate,
        "low": ratio.low,
        "high": ratio.high,
    }
