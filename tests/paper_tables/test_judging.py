"""Measures of rows, and the comparison of two runs."""

import json
import math
from itertools import product

import pytest
from command_line import refused as one_line
from made_rows import a_failure, a_results_folder, a_row
from refusals import refused

from cvqmpt_lab.paper_tables.compare_runs import Rule, clear, compared
from cvqmpt_lab.paper_tables.measures import (
    censored,
    mean_ratio,
    paired,
    paper_cost,
    split_by_work,
    time_at,
    work,
)


def test_the_papers_cost_prices_checks_projections_and_newton_steps():
    counts = {"n_projections": 10, "n_newton_iterations": 20, "n_state_checks": 100}
    row = a_row(**counts, t_total_s=1.0, t_predict_s=0.5)
    search = 10 * 1.3e-4 + 20 * 5e-4 + 100 * 3.5e-3
    assert paper_cost(row) == pytest.approx(search + 0.5)
    assert time_at(row, 0.0) == 1.0
    assert time_at(row, 3.5e-3) == pytest.approx(1.0 + search)
    assert paper_cost(a_row()) is None and time_at(a_row(), 1.0) is None


def run(planner, problem, checks=None, seed=0, solved=True, **values):
    """Return a row whose work is `checks`."""
    make = a_row if solved else a_failure
    values |= {} if checks is None else {"n_projections": 0, "n_state_checks": checks}
    return make(str(problem), planner, seed=seed, **values)


def test_failures_are_infinite():
    for rows, values in (
        ([run("x", 0, 5), run("x", 1, 7, solved=False), run("x", 2)], [[5.0], [math.inf]]),
        ([run("x", 0), run("x", 1, solved=False)], []),
        ([run("x", 1, solved=False)], [[math.inf]]),
        ([run("x", 0, 5), run("x", 0, 7, seed=1), run("x", 1, 1)], [[5.0, 7.0], [1.0]]),
    ):
        assert censored(rows, work) == values


def test_ratios_are_geometric_means_over_problems_that_both_solved():
    works = {0: 2, 1: 8, 2: 1000, 4: None}
    rows = [*(run("x", k, x) for k, x in works.items()), run("x", 3, 5, solved=False)]
    base = [run("b", i, 1) for i in (0, 1, 3, 4)] + [run("b", 2, 1, solved=False)]
    ratio = mean_ratio(paired(rows, base, work))
    assert ratio.estimate == pytest.approx(4.0) and ratio.n == 2  # sqrt(2 * 8)
    assert (ratio.low, ratio.high) == (pytest.approx(2.0), pytest.approx(8.0))
    one = mean_ratio(paired([row for row in rows if row.problem in ("1", "2")], base, work))
    assert (one.estimate, one.n, one.low) == (pytest.approx(8.0), 1, None)
    assert mean_ratio(paired(rows, [], work)).estimate is None
    assert mean_ratio(paired([run("x", 0, 0)], base, work)).estimate is None  # no work: no ratio


def names(keys):
    return {problem for _, problem, _ in keys}


def test_hard_is_the_top_third_by_medians_of_other_seeds_ties_easy_and_failures_hardest():
    split = split_by_work([run("birrt", i, 10 * i) for i in range(9)])
    assert names(split["hard"]) == set("678") and names(split["easy"]) == set("012345")
    assert split["all"] == split["easy"] | split["hard"] and len(split["all"]) == 9
    # the last row has no work
    ties = split_by_work([run("birrt", i, 5) for i in range(6)] + [run("birrt", 6)])
    assert ties["hard"] == frozenset() and len(ties["easy"]) == 6
    assert split_by_work([])["all"] == frozenset()
    works = ((1, 1000, 2), (9, 10, 11), (3, 3, 3))
    rows = [run("birrt", k, works[k][seed], seed=seed) for k, seed in product(range(3), range(3))]
    hard = {(problem, seed) for _, problem, seed in split_by_work(rows)["hard"]}
    # problem 0 took long with seed 1 only, so the other seeds call it easy
    assert hard == {("0", 0), ("1", 1), ("0", 2)}
    failing = [run("birrt", 2, 3, seed=s, solved=s == 0) for s in range(3)]
    assert names(split_by_work([*rows[:6], *failing])["hard"]) == {"2"}


def twenty(time, solved=range(20), planner="birrt"):
    """Rows of 20 problems with two seeds."""
    rows = []
    for k, seed in product(range(20), (0, 1)):
        solved_in = {"t_total_s": time * (1 + 0.01 * k), "path_length_rad": 5.0}
        make, values = (a_row, solved_in) if k in solved else (a_failure, {"t_total_s": 9.0})
        rows.append(make(f"p{k}", planner, seed=seed, **values))
    return rows


def test_a_change_is_told_with_its_interval_and_equal_numbers_are_no_change():
    (found,) = compared(twenty(1.0), twenty(0.5))
    assert found.pairs == 40 and found.changes["time"].estimate == pytest.approx(0.5)
    assert found.changes["length"].estimate == 1.0 and found.changes["time"].n == 20
    assert clear([found]) == ["birrt: less time, −50.0 [−50.0, −50.0] %"]
    assert clear(compared(twenty(1.0), twenty(1.0))) == []


def test_runs_of_one_alone_are_counted_and_those_gained_and_lost_are_named():
    some, but_last = twenty(1.0, range(1, 20)), twenty(1.0, range(19))
    (found,) = compared(some[:10], [*twenty(0.5)[4:], a_row("p99")])
    assert found.pairs == 6 and found.left_out == (4, 31) and found.solved[0].estimate == 100.0
    assert found.changes["time"].estimate == pytest.approx(0.5)
    (found,) = compared(some, but_last)
    assert found.gained == (("p0", 0), ("p0", 1)) and found.lost == (("p19", 0), ("p19", 1))
    assert "birrt: lost 2: problem p19 seed 0, problem p19 seed 1" in clear([found])
    assert found.changes["time"].n == 18


def test_runs_that_do_not_pair_are_refused_by_name():
    for other, says in (
        ([a_row("p99")], "no run in common: A has problem p0 seed 0, problem p0 seed 1"),
        (twenty(1.0, planner="mpnet"), "no planner in common: A has birrt, B has mpnet"),
        ([a_row(suite="sensor")], "runs of place do not pair with runs of sensor"),
        ([a_row("p0"), a_row("p0", suite="maze")], "B has rows of 2 suites, maze, place"),
    ):
        refused(says, compared, twenty(1.0), other)
    both = [a_row("p0"), a_row("p0", suite="maze")]
    refused("A has rows of 2 suites, maze, place; compare", compared, both, both)


def two_folders(tmp_path, a, b):
    """Folders of rows with these times [s] by planner."""
    for name, times in (("a", a), ("b", b)):
        (tmp_path / name).mkdir()
        a_results_folder(tmp_path / name, **times)
    return [tmp_path / name / "place-task" for name in "ab"]


def test_the_command_compares_two_directories(cvqmpt, tmp_path):
    folders = two_folders(tmp_path, {"birrt": 1.0}, {"birrt": 0.5})
    told = cvqmpt("compare", *folders)
    assert "birrt: less time, −50.0" in told and "birrt: less work" in told
    cvqmpt("compare", tmp_path, folders[1], code=2)
    rules = "compare --fail-if 'time > 1.1' --fail-if 'solved<-2'"
    assert "fails" not in cvqmpt(rules, *folders)
    *_, last = cvqmpt(rules, *reversed(folders), code=1).splitlines()
    assert last == "fails: birrt: time > 1.1, it is 2 times A's"


def test_unlike_settings_come_first_and_rules_need_equal_budgets(cvqmpt, tmp_path, capsys):
    folders = two_folders(tmp_path, {"birrt": 1.0}, {"birrt": 0.5})
    path = folders[1] / "provenance.json"
    record = json.loads(path.read_text())
    record["configuration"]["cutoff_s"] = 2.0
    path.write_text(json.dumps(record))
    first, *_ = cvqmpt("compare", *folders).splitlines()
    assert first == "unlike settings, from A to B: cutoff_s was 10.0, now 2.0"
    assert "equal budgets" in one_line(capsys, "compare", *folders, "--fail-if", "time > 9")


def test_any_two_planners_are_compared_from_one_folder_or_two(cvqmpt, tmp_path, capsys):
    a, b = two_folders(tmp_path, {"birrt": 1.0, "mpnet": 0.5}, {"roadmap": 2.0})
    assert "birrt → mpnet: less time, −50.0" in cvqmpt("compare", f"{a}:birrt", f"{a}:mpnet")
    assert "mpnet → roadmap: more time, +300" in cvqmpt("compare", f"{a}:mpnet", f"{b}:roadmap")
    assert "birrt, mpnet" in one_line(capsys, "compare", f"{a}:birrt", f"{a}:my:plan")
    assert "A:PLANNER B:PLANNER" in one_line(capsys, "compare", f"{a}:birrt", b)
    *_, head, line = cvqmpt("table", a, "--baseline", "mpnet").splitlines()
    assert "solved A, B [%]" in head and line.startswith("birrt") and "+100.0 [100.0" in line
    assert "birrt, mpnet" in one_line(capsys, "table", a, "--baseline", "roadmap")


def test_planners_of_one_run_alone_are_named_and_must_not_be_missing_from_the_second(
    cvqmpt, tmp_path
):
    folders = two_folders(tmp_path, {"birrt": 1.0, "mpnet": 1.0}, {"birrt": 1.0, "roadmap": 1.0})
    told = cvqmpt("compare", *folders)
    assert "in A alone, not compared: mpnet\n" in told
    assert "in B alone, not compared: roadmap\n" in told and "fails" not in told
    told = cvqmpt("compare --fail-if 'time > 9'", *folders, code=1)
    assert told.splitlines()[-1] == "fails: mpnet: B has no runs of it"


def test_a_rule_holds_for_ratios_and_for_what_fewer_solve_and_must_be_judged():
    fewer = compared(twenty(1.0), twenty(0.5, range(19)))
    for text, told in (
        ("time<0.6", ["birrt: time < 0.6, it is 0.5 times A's"]),
        ("time <= 0.4", []),
        ("length > 1", []),
        ("length >= 1", ["birrt: length >= 1, it is 1 times A's"]),
        ("solved < -2", ["birrt: solved < -2, it is -5 points"]),
        ("solved < -6", []),
    ):
        assert Rule.read(text).broken(fewer) == told
    (told,) = Rule.read("time > 9").broken(compared(twenty(1.0), twenty(1.0, ())))
    assert told == "birrt: time > 9 cannot be judged, no run of both has it"
