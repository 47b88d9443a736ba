"""The table of the place task: our numbers beside the paper's, in all formats."""

import math
from dataclasses import replace

import pytest
from made_rows import a_failure, a_row
from refusals import refused

from cvqmpt_lab.results.statistics import wilson_interval
from paper_tables.layouts import place_table
from paper_tables.statements import read_published
from paper_tables.table_engine import suite_runs

PAPER = read_published("place_task.csv", "Place Task")


def run(planner, problem, time=None, **values):
    """A row; a failure where `time` is None."""
    make, time = (a_failure, 10.0) if time is None else (a_row, time)
    return make(f"p{problem}", planner, **{"suite": "place-task", "t_total_s": time, **values})


def some_rows():
    counts = [{"path_length_rad": 5.0 + i, "vertices": 10 + i} for i in range(10)]
    rows = [run("birrt", i, 0.1 * (i + 1), **values) for i, values in enumerate(counts)]
    values = {"path_length_rad": 8.0, "vertices": 40}
    rows += [run("ompl-projected", i, 0.4 * (i + 1), **values) for i in range(8)]
    rows.append(run("ompl-projected", 8, detail="no path"))
    return [*rows, run("ompl-projected", 9, fail_reason="uncertified_goal")]


def found(rows):
    return {item.planner: item for item in place_table(rows, PAPER).found}


def test_metrics_are_computed_as_stated():
    runs = suite_runs(some_rows(), PAPER)
    birrt, ompl = (found(some_rows())[name].measured for name in ("birrt", "ompl-projected"))
    assert ompl["accuracy"] == wilson_interval(8, 10).scaled(100)
    assert birrt["time_median"].estimate == pytest.approx(0.55)
    assert ompl["time_median"].estimate == pytest.approx(0.4 * 5.5) and ompl["time_median"].n == 10
    assert ompl["time_median"].high == math.inf
    assert ompl["time_mean"].estimate == pytest.approx(0.4 * 4.5) and ompl["time_mean"].n == 8
    assert birrt["vertices_mean"].estimate == 14.5
    assert len(runs.joint) == birrt["path_length_median"].n == 8
    assert birrt["path_length_mean"].estimate == pytest.approx(8.5)  # problems 0..7 only
    assert (birrt["time_ratio"].estimate, birrt["time_ratio"].n) == (pytest.approx(0.25), 8)
    assert birrt["projections_median"].estimate is None
    assert birrt["solved_within_0.1_s"].estimate == pytest.approx(10)


def test_the_same_runs_again_under_other_seeds_make_nothing_surer():
    once = [replace(row, n_state_checks=i, n_projections=1) for i, row in enumerate(some_rows())]
    five_times = [replace(row, seed=seed) for seed in range(5) for row in once]
    for one, five in zip(found(once).values(), found(five_times).values(), strict=True):
        assert five.n_runs == 5 * one.n_runs
        for name, interval in one.measured.items():
            same = five.measured[name]
            assert same.n == interval.n
            bounds = interval.estimate, interval.low, interval.high
            assert (same.estimate, same.low, same.high) == pytest.approx(bounds), name


@pytest.mark.parametrize("rows", [[], [run("birrt", 0, 1.0), run("birrt", 0, 1.0, suite="random")]])
def test_a_table_is_of_one_suite(rows):
    refused("one suite", place_table, rows, PAPER)


def test_the_share_by_rollouts_alone_stands_where_a_planner_says_it():
    title = "Solved by rollouts alone"
    assert title not in place_table(some_rows(), PAPER).markdown
    alone = "solved by rollouts alone"
    trees = "solved by rollouts and trees: 1 of 3 pairs joined by tree growth"
    details = [alone, trees, trees, f"{alone}; exact checks near start"]
    rows = [run("mpnet", i, 0.1, detail=text) for i, text in enumerate(details)]
    rows.append(run("mpnet", 9, detail="all 10 of 10 rollouts failed: 10 whose sides did not meet"))
    made = place_table([*some_rows(), *rows], PAPER)
    lines = made.markdown.split(title)[1].splitlines()
    titles = ["planner", "Accuracy", "by rollouts alone [%]"]
    assert [cell.strip() for cell in lines[2].split("|")][1:4] == titles
    assert lines[4].startswith("| mpnet") and "| 40.0 [" in lines[4] and lines[5] == ""
    assert "place-task,rollouts_alone,%,mpnet,ours,40" in made.csv


def test_the_first_table_has_six_columns_and_no_table_is_wider_than_a_page():
    work = {"n_projections": 10, "n_state_checks": 90, "path_length_rad": 4.0, "vertices": 3}
    names = "birrt", "opt-cvq-mpt", "ompl-projected"
    made = place_table([run(name, i, 0.1, **work) for i in range(6) for name in names], PAPER)
    first = next(iter(made.sections.values()))
    assert first[0] == ["planner", "solved [%]", "time [s]", "work", "length [rad]", "work / birrt"]
    (birrt,) = (line for line in first if line[0] == "birrt")
    assert birrt == ["birrt", "100", "0.100", "100", "4.00", "–"]
    tables = [line for line in made.markdown.splitlines() if line.startswith("|")]
    assert max(map(len, [*tables, *made.brief])) <= 100
    assert "Opt-CVQ-MPT" in made.markdown and "11.03" in made.markdown


def test_encoding_is_charged_where_the_scene_is_new_and_told_apart():
    """0.5 s with 0.1 of goals and 0.3 of encoding; older rows do not mark a new scene."""
    times = {"t_goals_s": 0.1, "t_encode_s": 0.3}
    new = [run("cvq-mpt", i, 0.5, scene_new=True, n_clearances=70, **times) for i in range(6)]
    old = [run("cvq-mpt", i, 0.5, **times) for i in range(6)]
    for rows, new_time, clearances in ((new, 0.4, 70), (old, None, None)):
        measured = found(rows)["cvq-mpt"].measured
        assert measured["known_time_median"].estimate == pytest.approx(0.1)
        assert measured["new_time_median"].estimate == (new_time and pytest.approx(new_time))
        assert measured["clearances_median"].estimate == clearances
