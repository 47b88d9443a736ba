"""Tables of other suites (task phases, kinds of constraints), against hand calculations."""

import csv
import io

import pytest
from made_rows import a_failure, a_row

from paper_tables.multi_sequence_table import task_table
from paper_tables.statements import read_published

PHASES = ["reach-handle", "open-door", "reach-can", "approach", "carry"]


def ours_in(table):
    """Our numbers in its csv, by metric and planner."""
    lines = [line for line in csv.DictReader(io.StringIO(table.csv)) if line["source"] == "ours"]
    return {(line["metric"], line["planner"]): float(line["value"] or "nan") for line in lines}


def phases(planner, task, planning, execution, solved=True, **values):
    """Rows of one task whose times are known."""
    rows = []
    for k, name in enumerate(PHASES, 1):
        shared = {"suite": "multi-sequence", "t_total_s": planning, **values}
        reason = "timeout" if k == 1 else "not_reached"
        own = {"execution_time_s": execution} if solved else {"fail_reason": reason}
        make = a_row if solved else a_failure
        rows.append(make(f"{task}/{k}-{name}", planner, **shared, **own))
    return rows


def test_times_of_tasks_sum_the_papers_phases():
    rows = phases("ompl-projected", 7, 1.0, 10.0, solved=False)
    for task in range(6):
        rows += phases("opt-cvq-mpt", task, 0.5, 9.0)
        rows += phases("ompl-projected", task, 1.0 + 0.01 * task, 10.0 + 0.1 * task)
    table = task_table(rows, read_published("multi_sequence.csv", "Multi-sequence task"))
    ours = ours_in(table)
    assert ours["planning_time_of_paper_phases_mean", "opt-cvq-mpt"] == pytest.approx(1.5)
    assert ours["total_time_of_all_phases_mean", "opt-cvq-mpt"] == pytest.approx(5 * 9.5)
    assert ours["solved", "ompl-projected"] == pytest.approx(600 / 7)
    assert ours["solved_in_carry", "ompl-projected"] == 100.0, "of the six that reached it"
    failures = [["ompl-projected", "reach-handle: timeout", "–", "1 of 7"]]
    assert table.sections["Failures"][1:] == failures
    assert "| 19.71" in table.markdown and r"\toprule" in table.latex
    assert max(map(len, table.brief)) <= 100
