"""Tables of the other suites: tasks by phase, kinds of constraints, scanned scenes;
against numbers by hand.
"""

import csv
import io

import pytest
from made_rows import a_failure, a_row

from paper_tables.multi_sequence_table import multi_sequence_table
from paper_tables.paper_numbers import read_published
from paper_tables.robustness_table import levels_of, robustness_table

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
        rows.append(
            (a_row if solved else a_failure)(f"{task}/{k}-{name}", planner, **shared, **own)
        )
    return rows


def test_times_of_tasks_sum_the_papers_phases():
    rows = phases("ompl-projected", 7, 1.0, 10.0, solved=False)
    for task in range(6):
        rows += phases("opt-cvq-mpt", task, 0.5, 9.0)
        rows += phases("ompl-projected", task, 1.0 + 0.01 * task, 10.0 + 0.1 * task)
    table = multi_sequence_table(rows, read_published("multi_sequence.csv", "Multi-sequence task"))
    ours = ours_in(table)
    assert ours["planning_time_of_paper_phases_mean", "opt-cvq-mpt"] == pytest.approx(1.5)
    assert ours["total_time_of_all_phases_mean", "opt-cvq-mpt"] == pytest.approx(5 * 9.5)
    assert ours["solved", "ompl-projected"] == pytest.approx(600 / 7)
    assert ours["solved_in_carry", "ompl-projected"] == 100.0, "of the six that reached it"
    assert table.sections["Failures"][1:] == [
        ["ompl-projected", "reach-handle: timeout", "–", "1 of 7"]
    ]
    assert (
        "| 19.71" in table.markdown
        and r"\toprule" in table.latex
        and max(map(len, table.brief)) <= 100
    )


def varied(scene, planner, setting, solved=True, **values):
    name, make = f"{scene}/{scene + 1}-{setting}", a_row if solved else a_failure
    return make(name, planner, suite="sensor-robustness", path_length_rad=8.0, **values)


def some_rows():
    """Padding 0 collides once, the next does not; noise 2 fails once."""
    rows = []
    for scene in range(4):
        for planner in ("birrt", "cvq-mpt"):
            for padding in ("0", "0.01", "0.03"):
                hit = padding == "0" and scene == 2 and planner == "cvq-mpt"
                setting = f"noise=1 padding={padding} pixels=all"
                rows.append(varied(scene, planner, setting, true_free=not hit))
            noisy, few = "noise=2 padding=0 pixels=all", "noise=1 padding=0 pixels=900"
            rows.append(varied(scene, planner, few, true_free=True))
            rows.append(
                varied(scene, planner, noisy, solved=scene > 0, true_free=True if scene else None)
            )
    return rows


def test_one_thing_is_varied_at_a_time_and_the_padding_follows():
    groups = [level.group for level in levels_of(some_rows()) if level.planner == "birrt"]
    assert [value for factor, value in groups if factor == "padding"] == ["0 *", "0.01", "0.03"]
    assert [value for factor, value in groups if factor == "pixels"] == ["900", "all *"]
    table = robustness_table(some_rows(), ())
    ours = ours_in(table)
    assert ours["collisions_at_padding=0", "cvq-mpt"] == 1
    assert ours["true_free_at_padding=0", "cvq-mpt"] == pytest.approx(75.0)
    assert ours["solved_at_noise=2", "birrt"] == pytest.approx(75.0)
    assert ours["true_free_at_noise=2", "birrt"] == pytest.approx(100.0)
    assert table.size == "4 scenes" and "Recommended padding: 0.01 m" in table.markdown
    assert max(map(len, table.brief)) <= 100
