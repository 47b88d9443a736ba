"""The table of tasks by phase, against sums worked out by hand."""

from dataclasses import replace

import pytest

from cvqmpt_lab.results.row import ResultRow
from paper_tables.multi_sequence_render import render_multi_sequence
from paper_tables.multi_sequence_summary import build_phases_table, time_metric
from paper_tables.paper_numbers import read_published

PHASES = ["reach-handle", "open-door", "reach-can", "approach", "carry"]


def made_up(planner, task, planning, execution, solved=True):
    """Rows of one run whose times are known."""
    return [
        ResultRow(
            suite="multi-sequence",
            problem=f"{task}/{k}-{name}",
            planner=planner,
            seed=0,
            backend="compiled",
            fail_reason=None if solved else "timeout" if k == 1 else "not_reached",
            solved=solved,
            certified=solved or None,
            t_total_s=planning,
            execution_time_s=execution if solved else None,
        )
        for k, name in enumerate(PHASES, 1)
    ]


def test_the_table_sums_the_papers_phases_and_judges_its_statements():
    rows = []
    for task in range(6):
        rows += made_up("opt-cvq-mpt", task, 0.5, 9.0)
        rows += made_up("ompl-projected", task, 1.0 + 0.01 * task, 10.0 + 0.1 * task)
    rows += made_up("ompl-projected", 7, 1.0, 10.0, solved=False)
    published = read_published("multi_sequence.csv", "Multi-sequence task")
    table = build_phases_table(rows, published)
    planners = {planner.name: planner for planner in table.planners}
    assert list(planners) == ["ompl-projected", "opt-cvq-mpt"]  # those that were run, in the paper's order
    ours = planners["opt-cvq-mpt"].measured
    assert ours[time_metric("planning_time", "paper", "mean")].estimate == pytest.approx(1.5)
    assert ours[time_metric("total_time", "all", "mean")].estimate == pytest.approx(5 * 9.5)
    theirs = planners["ompl-projected"]
    assert (theirs.n_runs, theirs.measured["solved"].estimate) == (7, pytest.approx(600 / 7))
    assert [(count.what, count.runs) for count in theirs.failures] == [("reach-handle: timeout", 1)]
    verdicts = {(v.statement.metric, v.baseline): v for v in table.verdicts}
    planning = verdicts["planning_time", "ompl-projected"]
    assert planning.paper == pytest.approx(1 - 10.98 / 19.71) and planning.ours.n == 6
    assert planning.ours.estimate == pytest.approx(0.51, abs=0.01) and planning.ruling.startswith("confirmed")
    assert verdicts["execution_time", "ompl-projected"].ruling == "less than stated"
    assert ("execution_time", "atlas-rrt") not in verdicts
    made = render_multi_sequence(rows, published)
    assert "| 19.71" in made.markdown and r"\toprule" in made.latex and max(map(len, made.brief)) <= 100
    assert f"{time_metric('planning_time', 'paper', 'mean')},s,opt-cvq-mpt,ours,1.5,1.5,1.5,6" in made.csv


def test_a_verdict_needs_tasks_that_both_solved():
    rows = made_up("opt-cvq-mpt", 0, 0.5, 9.0) + made_up("tb-rrt", 1, 1.0, 10.0)
    verdicts = build_phases_table(rows, ()).verdicts
    assert len(verdicts) == 2 and all(item.ruling.startswith("not judged") for item in verdicts)


def test_fallbacks_are_counted_by_phase_and_by_task():
    rows = made_up("cvq-mpt", 0, 0.5, 9.0) + made_up("cvq-mpt", 1, 0.5, 9.0)
    rows = [
        replace(row, fallback="no weights for a door: birrt") if "door" in row.problem else row
        for row in rows
    ]
    (planner,) = build_phases_table(rows, ()).planners
    assert [(count.what, count.runs) for count in planner.fallbacks] == [("open-door", 2)]
    assert (planner.n_fallen_back, planner.n_runs) == (2, 2)
