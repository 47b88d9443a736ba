"""Tables of the other suites: tasks by phase, kinds of constraints, scanned scenes; against numbers by hand."""

import csv
import io

import pytest
from made_rows import a_failure, a_row

from paper_tables.constraints_table import constraints_table
from paper_tables.multi_sequence_table import multi_sequence_table
from paper_tables.paper_numbers import read_published
from paper_tables.place_task_table import place_task_table
from paper_tables.robustness_table import levels_of, robustness_table

PHASES = ["reach-handle", "open-door", "reach-can", "approach", "carry"]


def ours_in(table):
    """Our numbers in its csv, by metric and planner."""
    lines = [line for line in csv.DictReader(io.StringIO(table.csv)) if line["source"] == "ours"]
    return {(line["metric"], line["planner"]): float(line["value"] or "nan") for line in lines}


def said(table, title="What the paper says"):
    """Verdicts by statement and baseline."""
    return {(line[0], line[1]): line for line in table.sections[title][1:]}


def phases(planner, task, planning, execution, solved=True, **values):
    """Rows of one task whose times are known."""
    rows = []
    for k, name in enumerate(PHASES, 1):
        shared = {"suite": "multi-sequence", "t_total_s": planning, **values}
        reason = "timeout" if k == 1 else "not_reached"
        make, own = (
            (a_row, {"execution_time_s": execution}) if solved else (a_failure, {"fail_reason": reason})
        )
        rows.append(make(f"{task}/{k}-{name}", planner, **shared, **own))
    return rows


def test_times_of_tasks_sum_the_papers_phases_and_its_statements_are_judged():
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
    assert table.sections["Failures"][1:] == [["ompl-projected", "reach-handle: timeout", "–", "1 of 7"]]
    faster = said(table)["opt-cvq-mpt reduces planning time by 45 %", "ompl-projected"]
    assert faster[2] == "44.3" and faster[3].startswith("51.") and faster[4:] == ["6", "confirmed"]
    assert (
        said(table)["opt-cvq-mpt reduces execution time by 18 %", "ompl-projected"][-1] == "less than stated"
    )
    assert len(said(table)) == 2, "nothing about planners that did not run"
    assert "| 19.71" in table.markdown and r"\toprule" in table.latex and max(map(len, table.brief)) <= 100


def test_a_verdict_needs_tasks_that_both_solved():
    rows = phases("opt-cvq-mpt", 0, 0.5, 9.0) + phases("tb-rrt", 1, 1.0, 10.0)
    verdicts = said(multi_sequence_table(rows, ())).values()
    assert len(verdicts) == 2 and all(line[-1].startswith("not judged") for line in verdicts)


def test_ratios_are_taken_within_a_kind_and_over_all():
    rows = [a_failure("48/1-upright", "roadmap-cvq", suite="constraints")]
    for kind, name, less in ((0, "upright", 2), (2, "plane", 4)):
        for k in range(6):
            key = f"{8 * k + kind}/{kind + 1}-{name}"
            shared = {"problem": key, "suite": "constraints", "n_projections": 0}
            rows.append(a_row(**shared, n_state_checks=800))
            rows.append(a_row(**shared, planner="roadmap-cvq", n_state_checks=800 // less))
    table = constraints_table(rows, ())
    ours = ours_in(table)
    assert ours["work_ratio_under_upright", "roadmap-cvq"] == pytest.approx(0.5)
    assert ours["work_ratio_under_plane", "roadmap-cvq"] == pytest.approx(0.25)
    assert ours["work_ratio_under_all kinds", "roadmap-cvq"] == pytest.approx(8**-0.5)
    assert ours["solved_under_upright", "roadmap-cvq"] == pytest.approx(600 / 7)
    assert table.size == "13 problems, 2 kinds"
    assert table.sections["Failures"][1:] == [["roadmap-cvq", "upright: timeout", "–", "1 of 13"]]


def scanned(planner, scene, time, length, true_free=True):
    work = {"vertices": 40, "n_projections": 9, "n_state_checks": 9}
    sensed = {"t_sense_s": 0.2, "t_whole_s": 0.3 + time, "true_free": true_free}
    return a_row(
        str(scene), planner, suite="sensor", t_total_s=time, path_length_rad=length, **work, **sensed
    )


def test_truth_stands_beside_the_map_and_statements_are_judged():
    rows = [scanned("ompl-projected", k, 1.0 + 0.01 * k, 10.0) for k in range(6)]
    rows += [scanned("opt-cvq-mpt", k, 2.0 + 0.03 * k, 7.0 + 0.01 * k, true_free=k > 0) for k in range(6)]
    rows += [a_failure("6", "opt-cvq-mpt", suite="sensor", t_total_s=10.0)]
    table = place_task_table(rows, read_published("place_task.csv", "Physical robot"), sensed=True)
    truth = {line[0]: line for line in table.sections["In the map and in truth"]}
    assert truth["opt-cvq-mpt"][2].startswith("83.3 [")  # 5 of 6 paths
    verdicts = said(table, 'The paper: "CVQ-MPT and Opt-CV-MPT outperform traditional planners"')
    by_metric = {
        text.removeprefix("opt-cvq-mpt outperforms in "): line for (text, _), line in verdicts.items()
    }
    assert by_metric["planning time"][-1] == "not confirmed: more of it"
    assert by_metric["vertices"][-1] == "not confirmed: no clear difference"
    assert by_metric["path length"][-1] == "confirmed"
    assert by_metric["path length"][2] == "42.2" and by_metric["vertices"][2] == "-7.9"  # the paper's own
    assert "8.37" in table.latex and "free_in_truth,%,opt-cvq-mpt,ours,83.3" in table.csv
    assert max(map(len, table.brief)) <= 100


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
            rows.append(varied(scene, planner, noisy, solved=scene > 0, true_free=True if scene else None))
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
