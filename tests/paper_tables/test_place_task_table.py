"""The table of the place task: numbers as stated, the paper's beside them, in every form."""

import math
from dataclasses import replace

import pytest
from made_rows import a_failure, a_row

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.results.statistics import wilson_interval
from paper_tables.judging import judged
from paper_tables.paper_numbers import read_published
from paper_tables.place_task_table import COLUMNS, HEADLINES, place_task_table, split_metric
from paper_tables.statements import ABOUT_PLACE_TASK
from paper_tables.table_engine import entries, suite_runs

PAPER = read_published("place_task.csv", "Place Task")


def run(planner, problem, time=None, **values):
    """A row; a failure where `time` is None."""
    make, time = (a_failure, 10.0) if time is None else (a_row, time)
    return make(f"p{problem}", planner, **{"suite": "place-task", "t_total_s": time, **values})


def some_rows():
    rows = [run("birrt", i, 0.1 * (i + 1), path_length_rad=5.0 + i, vertices=10 + i) for i in range(10)]
    rows += [run("ompl-projected", i, 0.4 * (i + 1), path_length_rad=8.0, vertices=40) for i in range(8)]
    failures = {"detail": "no path"}, {"fail_reason": "uncertified_goal"}
    return rows + [run("ompl-projected", 8 + i, **values) for i, values in enumerate(failures)]


def found(rows):
    return {item.planner: item for item in entries(suite_runs(rows, PAPER), COLUMNS, PAPER)}


def cells(table, title):
    """Of a section."""
    return [list(line) for line in table.sections[title]]


def test_the_published_files_hold_every_cell_of_both_tables():
    assert len(read_published("place_task.csv")) == 2 * 6 * 4
    assert len(PAPER) == 6 * 4
    values = {(value.planner, value.metric): value.value for value in PAPER}
    assert values["ompl-projected", "time"] == "22.95" and values["opt-cvq-mpt", "path_length"] == "5.507"
    assert values["mpnet", "accuracy"] == "33.85" and values["tb-rrt", "vertices"] == "32"
    assert {metric for _, metric in values} == HEADLINES.keys()


def test_the_published_totals_are_sums_and_accuracies_are_127ths():
    values = {(v.planner, v.metric): float(v.value) for v in read_published("multi_sequence.csv")}
    assert len(values) == 15
    for planner in {planner for planner, _ in values}:
        parts = values[planner, "planning_time"] + values[planner, "execution_time"]
        assert values[planner, "total_time"] == pytest.approx(parts)
    for value in PAPER:
        if value.metric == "accuracy":
            solved = round(float(value.value) * 1.27)
            assert f"{solved}/127" in value.note
            assert int(solved / 127 * 1e4) / 100 == float(value.value)


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


def test_planners_are_compared_on_easy_and_hard_problems_and_at_the_papers_cost():
    """x works twice as much on easy problems and a quarter on the hard ones, 4 and 5."""
    rows = []
    for i, factor in enumerate((2.0, 2.0, 2.0, 2.0, 0.25, 0.25)):
        shared = {"n_projections": 0, "t_goals_s": 0.5}
        effort = 100 * (i + 1)
        rows.append(run("birrt", i, 1.0, n_state_checks=effort, path_length_rad=4.0, **shared))
        own = {"n_state_checks": int(effort * factor), "t_predict_s": 0.1, "path_length_rad": 2.0}
        rows.append(run("x", i, 1.5, **own, **shared))
    x = found(rows)["x"].measured
    for part, ratio in {"all": (2.0**4 * 0.25**2) ** (1 / 6), "easy": 2.0, "hard": 0.25}.items():
        assert x[split_metric("work_ratio", part)].estimate == pytest.approx(ratio)
        assert x[split_metric("time_ratio", part)].estimate == pytest.approx(1.5)
        assert x[split_metric("own_time_ratio", part)].estimate == pytest.approx(2.0)
        assert x[split_metric("length_ratio", part)].estimate == pytest.approx(0.5)
    costs = [0.1 + 0.0035 * n for n in (200, 400, 600, 800, 125, 150)]
    assert x["paper_cost_median"].estimate == pytest.approx(0.1 + 0.0035 * 300)
    logs = [math.log(cost / (0.35 * (i + 1))) for i, cost in enumerate(costs)]
    assert x["paper_cost_ratio_birrt"].estimate == pytest.approx(math.exp(sum(logs) / 6))
    assert x["paper_cost_ratio_ompl-projected"].estimate is None
    table = place_task_table(rows, ())
    assert [line[1] for line in cells(table, "Against birrt")[1:]] == ["all (6)", "easy (4)", "hard (2)"]
    assert "One seed of birrt" in table.markdown
    assert "place-task,work_ratio_hard_of_birrt,1,birrt,ours,1.0" in table.csv
    assert "## Against" not in place_task_table([run("x", 0, 1.0)], ()).markdown


def test_the_same_runs_again_under_other_seeds_make_nothing_surer():
    once = [replace(row, n_state_checks=i, n_projections=1) for i, row in enumerate(some_rows())]
    five_times = [replace(row, seed=seed) for seed in range(5) for row in once]
    for one, five in zip(found(once).values(), found(five_times).values(), strict=True):
        assert five.n_runs == 5 * one.n_runs
        for name, interval in one.measured.items():
            same = five.measured[name]
            assert same.n == interval.n
            assert (same.estimate, same.low, same.high) == pytest.approx(
                (interval.estimate, interval.low, interval.high)
            ), name
    verdicts = (
        judged(ABOUT_PLACE_TASK, [*rows, *(replace(row, planner="cvq-mpt") for row in rows)], PAPER)
        for rows in (once, five_times)
    )
    assert next(verdicts) == next(verdicts) != ()


def test_what_makes_planners_hard_to_compare_is_noted():
    def notes(*rows):
        return " ".join(place_task_table([*some_rows(), *rows], PAPER).sections["Notes"])

    other_seed, unsolved = (
        [run(name, i, *time, seed=1) for i in range(10)] for name, *time in (("birrt", 1.0), ("tb-rrt",))
    )
    for rows, note in (
        (other_seed, "fewer than 2: ompl-projected 1."),
        (other_seed, "Several seeds"),
        (unsolved, "left out of the jointly solved set: tb-rrt"),
        ([run("birrt", 10, 1.0)], "did not all run the same problems"),
    ):
        assert note in notes(*rows) and note not in notes()


@pytest.mark.parametrize("rows", [[], [run("birrt", 0, 1.0), run("birrt", 0, 1.0, suite="random")]])
def test_a_table_is_of_one_suite(rows):
    with pytest.raises(InvalidInputError, match="one suite"):
        place_task_table(rows, PAPER)
