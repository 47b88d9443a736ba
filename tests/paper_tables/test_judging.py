"""The rule of verdicts on made and committed rows, measures, and the comparison of two runs."""

import json
import math
from itertools import product
from statistics import fmean

import numpy as np
import pytest
from command_line import refused as one_line
from made_rows import a_failure, a_results_folder, a_row
from refusals import refused

from cvqmpt_lab.paper_tables.claims import verdicts_of
from cvqmpt_lab.paper_tables.compare_runs import Rule, clear, compared
from cvqmpt_lab.paper_tables.judging import Word, sample_size, word_of
from cvqmpt_lab.paper_tables.measures import (
    censored,
    mean_ratio,
    paired,
    paper_cost,
    split_by_work,
    time_at,
    work,
)
from cvqmpt_lab.paper_tables.statements import Claim, PublishedValue
from cvqmpt_lab.results.statistics import Interval, student_interval

REPLICATED, SMALLER, SAME = Word.REPLICATED, Word.SMALLER, Word.SAME
OPPOSITE, OPEN, NO_ROWS = Word.OPPOSITE, Word.OPEN, Word.NO_ROWS
TEN = -math.log(0.9)  # the gain of ten percent less


def claim(metric="time", baselines=("b",), **more):
    """Return the claim that `a` has a smaller metric than `b`."""
    return Claim(metric, ("a",), "made", "", "made", baselines, **more)


FASTER, MORE = claim(cutoff="rows"), claim("accuracy", margin=0.05)
AS_MANY = claim("accuracy", margin=0.05, similar=True)


def in_paper(metric="time", **values):
    """Return published values of a metric by planner."""
    return [PublishedValue("I", "made", k, k, metric, str(x), "", "") for k, x in values.items()]


HALF = in_paper(a=5, b=10)


def made_rows(ratio=1.0, problems=60, spread=0.3, seeds=2, failing=(), shares=None):
    """Rows of `a` and `b`: times with a known geometric mean of their ratio.

    failing: planners and problems that fail; shares: fraction of runs that each planner solves.
    """
    rng, rows = np.random.default_rng(3), []
    for k in range(problems):
        hard = float(rng.lognormal(0.0, 1.0))
        for seed, (name, factor) in product(range(seeds), (("a", ratio), ("b", 1.0))):
            solved = (name, k) not in failing
            if shares:
                solved = (k % 20) < 20 * shares[name]
            values = {"planner": name, "seed": seed, "t_total_s": 10.0}
            if solved:
                values["t_total_s"] = 0.1 * hard * factor * float(rng.lognormal(0.0, spread))
            rows.append((a_row if solved else a_failure)(f"p{k}", **values))
    return rows


def word(rows, of=FASTER, published=HALF, level=0.01):
    (found,) = verdicts_of(of, rows, published, 10.0, level)
    return found.word


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [
        (0.9, 1.2, REPLICATED),  # beyond the paper's number
        (0.1, 0.7, REPLICATED),  # reaches it
        (0.1, 0.5, SMALLER),
        (0.01, 0.1, SAME),
        (-0.1, 0.1, SAME),
        (-0.1, -0.01, SAME),
        (-0.2, -0.01, OPPOSITE),
        (-0.2, 0.1, OPEN),
        (-0.1, 0.7, OPEN),
        (None, None, OPEN),
    ],
)
def test_the_word_is_where_the_interval_lies(low, high, expected):
    gain = Interval(None if low is None else (low + high) / 2.0, low, high, 20)
    assert word_of(gain, TEN, reached=0.6) is expected


def test_similar_is_not_worse_by_more_than_the_margin():
    for low, high, expected in (
        (-0.04, -0.01, REPLICATED),
        (0.1, 0.3, REPLICATED),
        (-0.06, 0.1, OPEN),
        (-0.2, -0.06, OPPOSITE),
    ):
        assert word_of(Interval(0.0, low, high, 9), 0.05, 0.05, similar=True) is expected


def test_a_known_effect_gets_its_word():
    """The paper's ratio is 0.5; a ratio of 0.55 is nine tenths of this effect."""
    for ratio, expected in {0.3: REPLICATED, 0.5: REPLICATED, 0.75: SMALLER, 1.5: OPPOSITE}.items():
        assert word(made_rows(ratio)) is expected, ratio
    assert word(made_rows(1.0, spread=0.1)) is SAME
    assert word(made_rows(0.85), published=()) is REPLICATED, "without a number any gain is one"
    assert word(made_rows(0.97, spread=0.02), published=()) is SAME, "but not one below the margin"
    assert word(made_rows(0.98, spread=0.01), published=in_paper(a=98, b=100)) is REPLICATED
    for planner, shares in (("a", {"a": 0.9, "b": 0.3}), ("b", {"a": 0.3, "b": 0.9})):
        expected = REPLICATED if planner == "a" else OPPOSITE
        assert word(made_rows(shares=shares), MORE, in_paper("accuracy", a=98, b=34)) is expected
    assert word(made_rows(shares={"a": 0.9, "b": 0.6}), MORE, in_paper("accuracy", a=98, b=34)) is (
        SMALLER
    )


def test_more_problems_end_an_inconclusive_and_about_as_many_as_foretold():
    few = made_rows(1.6, problems=20, spread=1.0, seeds=1)
    (found,) = verdicts_of(FASTER, few, HALF, 10.0, 0.01)
    assert found.word is OPEN and 20 < found.needed < 1000
    assert word(made_rows(1.6, 2 * found.needed, 1.0, 1)) is OPPOSITE
    equal = verdicts_of(FASTER, made_rows(1.0, 20, 0.4, 1), HALF, 10.0, 0.01)[0]
    assert equal.word is OPEN
    assert word(made_rows(1.0, 2 * equal.needed, 0.4, 1)) is SAME
    assert verdicts_of(FASTER, made_rows(0.5), HALF, 10.0, 0.01)[0].needed is None


def test_the_size_of_a_sample_has_the_power_that_it_promises():
    """Half a standard deviation, two-sided 5 %, 80 %: 34 (any table of t tests)."""
    assert sample_size(2.0, 0.05) in (33, 34, 35)
    rng, n = np.random.default_rng(0), sample_size(2.0, 0.01)
    told = [student_interval(rng.normal(0.5, 1.0, n), 0.99).low > 0.0 for _ in range(600)]
    assert 0.75 < fmean(told) < 0.87


def test_a_failed_run_counts_as_the_cutoff_for_whoever_failed():
    """The planner takes half of the time, but a third of its problems failed and count as 10 s."""
    for planner, expected in (("a", OPPOSITE), ("b", REPLICATED)):
        rows = made_rows(0.5, failing={(planner, k) for k in range(20)})
        (found,) = verdicts_of(FASTER, rows, HALF, 10.0, 0.01)
        assert found.word is expected and len(found.pairs) == 60
        assert found.failed == ((40, 0, 120) if planner == "a" else (0, 40, 120))
        (pair,) = (pair for pair in found.pairs if pair.problem == "p0")
        assert max(pair.own, pair.other) == 10.0
    early = [a_failure("p0", "a", t_total_s=0.1), a_row("p0", "b", t_total_s=1.0)]
    (found,) = verdicts_of(FASTER, early, (), 10.0, 0.01)
    assert found.pairs[0].own == 10.0, "however early it gave up"


def test_counts_have_the_largest_number_as_cutoff_and_lengths_are_of_both():
    rows = [a_row("p0", n, n_projections=x, path_length_rad=5.0) for n, x in (("a", 10), ("b", 90))]
    rows += [a_row("p1", "a", n_projections=20, path_length_rad=5.0), a_failure("p1", "b")]
    (counted,) = verdicts_of(claim("projections", cutoff="largest"), rows, (), 10.0)
    assert [pair.values for pair in counted.pairs] == [[(10, 90)], [(20, 90)]]
    (length,) = verdicts_of(claim("path_length"), rows, (), 10.0)
    assert len(length.pairs) == 1 and length.failed == (0, 1, 2)
    assert verdicts_of(claim("extensions", cutoff="largest"), rows)[0].word is NO_ROWS


def test_seeds_of_a_problem_count_once():
    (one,) = verdicts_of(FASTER, made_rows(0.8, 30, seeds=1), (), 10.0)
    again = [row for seed in range(5) for row in made_rows(0.8, 30, seeds=1)]
    rows = [a_row(**{**vars(row), "seed": k // 60}) for k, row in enumerate(again)]
    (five,) = verdicts_of(FASTER, rows, (), 10.0)
    assert five.gain.n == 30 and five.gain[:3] == pytest.approx(one.gain[:3])


def test_all_solved_by_both_is_not_certain_to_be_equal():
    for problems, expected in ((10, OPEN), (300, REPLICATED)):
        assert word(made_rows(problems=problems), AS_MANY, ()) is expected
    (found,) = verdicts_of(AS_MANY, made_rows(problems=10), (), 10.0, 0.01)
    assert found.gain.estimate == 0.0 and found.gain.low < -0.1 and found.needed > 10
    fewer = made_rows(problems=20, shares={"a": 0.85, "b": 0.95})
    of = claim("accuracy", margin=0.3, similar=True)
    (found,) = verdicts_of(of, fewer, (), 10.0, 0.01)
    assert found.word is OPEN and 20 < found.needed < 60, "0.2 from the margin, spread 0.3"


def test_kinds_are_not_pooled():
    rows = []
    for kind, ratio in (("door", 0.2), ("upright", 3.0)):
        for k, row in enumerate(made_rows(ratio, 30)):
            rows.append(a_row(**{**vars(row), "problem": f"{k // 4}/1-{kind}"}))
    found = verdicts_of(claim(cutoff="rows", by_kind=True), rows, (), 10.0)
    assert {x.against: x.word for x in found} == {"b, door": REPLICATED, "b, upright": OPPOSITE}


def test_what_single_runs_resolve_is_wider_than_what_all_runs_do():
    (found,) = verdicts_of(claim(cutoff="rows", runs=20), made_rows(0.5, seeds=4), HALF, 10.0, 0.05)
    resolved, gain = found.resolved, found.gain
    assert resolved.n == 20 and resolved.low < math.log(2.0) < resolved.high
    assert resolved.high - resolved.low > gain.high - gain.low
    assert found.inside is (gain.low <= math.log(2.0) <= gain.high)
    assert found.heaviest < 0.5 and abs(found.means - math.log(2.0)) < 0.4


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
    ):
        refused(says, compared, twenty(1.0), other)


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
