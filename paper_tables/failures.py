"""The ratio of times by five ways to count failed runs."""

import numpy as np

from cvqmpt_lab.paper_tables.bootstrap import ratios_of_means
from cvqmpt_lab.paper_tables.claims import both_ran, cost_sides, paper_number, published_number
from cvqmpt_lab.paper_tables.evidence import Evidence
from cvqmpt_lab.paper_tables.measures import Rows
from cvqmpt_lab.paper_tables.ompl_table import PAPER_CUTOFF_S, capped
from cvqmpt_lab.paper_tables.statements import Claim
from cvqmpt_lab.paper_tables.writers import Lines, estimate, number


def failure_lines(claim: Claim, evidence: Evidence, level: float) -> Lines:
    """Return a line for each way to count failures: both means and their ratio.

    Args:
        claim: of a time, with the paper's numbers; its first planner and baseline are compared.
        evidence: results directory of its suite.
        level: of the intervals, two-sided.
    """
    planner, baseline = claim.planners[0], claim.baselines[0]
    runs = both_ran(evidence, planner, baseline)
    if not runs:
        return []
    solved = cost_sides(runs)
    spent = np.array([[_spent(run) for run in x[1:]] for x in runs]).T
    failed, limits = np.isnan(solved), np.array([[claim.limit], [PAPER_CUTOFF_S]])
    ways = {
        f"{PAPER_CUTOFF_S:g} s": np.where(failed, PAPER_CUTOFF_S, solved),
        "what it spent": np.where(failed, spent, solved),
        f"its limit, {claim.limit:g} or {PAPER_CUTOFF_S:g} s": np.where(failed, limits, solved),
        "left out, also for the other": np.where(failed.any(axis=0), np.nan, solved),
        "left out, as in the paper": solved,
    }
    own, other = np.array([*ways.values()]).transpose(1, 0, 2)
    ratios = ratios_of_means(own, other, level)
    lines = [["a failed run counts as", f"{planner} [s]", f"{baseline} [s]", "ratio"]]
    for way, ours, theirs, found in zip(ways, own, other, ratios, strict=True):
        means = (number(float(np.nanmean(side))) for side in (ours, theirs))
        lines.append([way, *means, estimate(found.interval)])
    printed = [published_number(claim, name) for name in (planner, baseline)]
    ratio = paper_number(claim, planner, baseline)
    means = ("–" if x is None else f"{x:.4g}" for x in printed)
    lines.append(["in the paper", *means, number(ratio)])
    return lines


def _spent(run: Rows) -> float:
    """Return the cost of a run, solved or not [s]."""
    return sum(capped("search_cost")(row) or 0.0 for row in run)
