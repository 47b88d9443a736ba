"""Rules of verdicts and their measures; comparison of two runs: on made rows."""

import math
from itertools import product

import pytest
from made_rows import a_failure, a_results_folder, a_row
from refusals import refused

from cli.main import main
from cvqmpt_lab.results.statistics import Interval, ratio_of_means_interval
from paper_tables import judging
from paper_tables.compare_runs import Rule, clear, compared
from paper_tables.judging import Ruling, overall, percent, reduction, ruled, verdicts_of
from paper_tables.measures import Pair, censored, mean_ratio, paired, split_by_work, work
from paper_tables.statements import CLAIMS, Claim, PublishedValue

H, F, T, N = Ruling.HOLDS, Ruling.FAILS, Ruling.TOO_FEW, Ruling.INCOMPARABLE
HALF = Claim("time", 0.5, ("ompl-projected",))
SPREAD = (0.9, 1.1, 1.0, 0.95, 1.05, 1.02, 0.98, 1.0, 0.93, 1.07)


def pairs(ratio, others=(1.0,) * 10):
    """Ten problems of equal weight with ratios around one number."""
    both = enumerate(zip(SPREAD, others, strict=True))
    return [Pair(str(k), [(ratio * s * other, other)]) for k, (s, other) in both]


def rulings(verdicts):
    return [verdict.ruling for verdict in ruled(verdicts)]


def with_p(p, above=True, claim=HALF):
    nothing = Interval(None, None, None, 0)
    return judging.Verdict(claim, "x", None, nothing, nothing, p, above)


def test_a_stated_half_is_tested_at_nine_tenths_of_itself():
    """45 % less is a ratio of 0.55: below it the claim holds, above it fails, at it is open."""
    for ratio, expected in {0.3: H, 0.5: H, 0.55: T, 0.7: F, 1.4: F}.items():
        effect = reduction(HALF, "ompl-projected", pairs(ratio))
        assert rulings([effect]) == [expected]
        assert effect.paired.estimate == pytest.approx(1.0 - ratio, abs=0.01)
        assert effect.means.estimate == pytest.approx(1.0 - ratio, abs=0.01)


def test_two_problems_are_too_few_and_so_is_a_wide_spread():
    few = reduction(HALF, "ompl-projected", pairs(0.1)[:2])
    assert few.p is None and rulings([few]) == [T] and few.note == "2 problems"
    wide = [Pair(str(k), [(ratio, 1.0)]) for k, ratio in enumerate((0.05, 3.0, 0.2, 1.5))]
    assert rulings([reduction(HALF, "ompl-projected", wide)]) == [T]


def test_where_the_statistics_disagree_it_says_what_decides():
    """Nine problems take a third, one very long problem takes as long: so does the mean."""
    others = [1.0] * 9 + [1000.0]
    found = pairs(0.3, others)[:9] + [Pair("long", [(1000.0, 1000.0)])]
    effect = reduction(HALF, "ompl-projected", found)
    assert effect.paired.estimate > 0.5 and effect.means.estimate < 0.1
    assert effect.p == 1.0 and rulings([effect]) == [T]
    assert "paired: holds, means: too few runs to tell" in effect.note
    assert effect.note.endswith("problem long alone is 100 % of the mean of opt-cvq-mpt")


def test_holm_compares_sorted_p_with_growing_levels_and_stops_at_the_first_above():
    """0.01 <= 0.05/3, 0.02 <= 0.05/2, but 0.06 > 0.05; without the first, 0.03 > 0.05/2 stops."""
    assert rulings([with_p(0.06), with_p(0.01), with_p(0.02, above=False)]) == [T, H, F]
    assert rulings([with_p(0.03), with_p(0.04)]) == [T, T]
    assert rulings([with_p(0.05)]) == [H], "the level itself is significant"
    other = Claim("vertices", 0.0, ("x",), incomparable="counted otherwise")
    assert rulings([reduction(other, "x", []), with_p(0.04)]) == [N, H]
    assert reduction(other, "x", pairs(0.1)).p is not None, "rows with such values answer it"


def test_a_claim_holds_where_all_hold_and_does_not_where_one_does_not():
    cases = {(H, H): H, (H, T): T, (H, F): F, (T, F): F, (N, N): N, (H, N): N, (): Ruling.NO_ROWS}
    verdicts = {said: [with_p(None)._replace(ruling=ruling) for ruling in said] for said in cases}
    assert {said: overall(found) for said, found in verdicts.items()} == cases


def test_tests_against_values_by_hand():
    """Student: mean 2, sd 1, n 3, t = 2 sqrt(3), 2 df, p = 0.0742. Score: 60/100 to 1/2, z = 2."""
    assert judging.t_test([1.0, 2.0, 3.0]) == pytest.approx(0.0742, abs=1e-4)
    assert [judging.t_test(x) for x in ([2.0, 2.0], [0.0, 0.0], [5.0])] == [0.0, 1.0, 1.0]
    share = Interval(0.6, None, None, 100)
    assert judging.score_test(share, 0.5) == pytest.approx(0.0455, abs=1e-4)


def test_the_ratio_of_means_is_of_sums_and_seeds_of_a_problem_count_once():
    interval = ratio_of_means_interval
    assert interval([(1.0, 1.0), (3.0, 1.0)]).estimate == 2.0 and interval([]).n == 0
    assert interval([(1.0, 2.0)] * 5)[:3] == (0.5,) * 3
    assert interval([(1.0, 4.0)])[:2] == (0.25, None)
    two_seeds = Pair("p", [(1.0, 1.0), (4.0, 1.0)])
    assert (two_seeds.own, two_seeds.other, two_seeds.ratio) == (2.5, 1.0, pytest.approx(2.0))
    counts = {"n_projections": 1, "n_state_checks": 1}
    own, other = [a_row("q", "a", **counts)], [a_failure("q", "b", **counts)]
    for seed, done in enumerate((10, 30)):
        own.append(a_row("p", "a", seed=seed, n_projections=done, n_state_checks=0))
        other.append(a_row("p", "b", seed=seed, n_projections=5, n_state_checks=0))
    (pair,) = paired(own, other, work)
    assert (pair.own, pair.other) == (20.0, 5.0) and pair.ratio == pytest.approx(math.sqrt(12.0))


def at(planner, k, time, **values):
    """A row of the place task; a failure where `time` is None."""
    make, time = (a_failure, 10.0) if time is None else (a_row, time)
    return make(f"p{k}", planner, suite="place-task", t_total_s=time, **values)


def test_the_cutoff_is_the_time_within_which_the_papers_cbirrt_has_solved_as_much():
    rows = [at("ompl-projected", k, 0.1 * (k + 1) if k < 9 else None) for k in range(10)]
    for share in (0.8, 0.9):
        assert judging.cutoff_of(rows, share) == pytest.approx(share)
    assert math.isinf(judging.cutoff_of(rows, 0.95)), "one of ten is never solved"


def test_a_baseline_without_rows_and_runs_that_one_alone_failed_are_told():
    """Ten problems, two seeds; one planner fails the second seed of 3, the other of 2 others."""
    failing = {("a", 0), ("a", 1), ("a", 2), ("b", 3), ("b", 4)}
    runs = list(product("ab", range(10)))
    rows = [at(*run, None if run in failing else 0.1, seed=1) for run in runs]
    rows += [at(*run, 0.1) for run in runs]
    known, missing = verdicts_of(Claim("time", 0.0, ("b", "c"), "a"), rows, ())
    assert known.note == "left out of 20 runs: 3 that a alone failed and 2 that b alone failed"
    assert known.paired.n == 10 and missing.note == "0 problems"
    assert missing.p is None and rulings([missing]) == [T]


CBIRRT = PublishedValue("I", "place", "ompl-projected", "CBiRRT", "accuracy", "93.65", "%", "")


def test_what_is_solved_in_time_is_more_than_the_papers_cbirrt_solves():
    """98.42 % to its 93.65 %: test at 97.9 %; alone, at 88.6 %: more, neither or less."""
    compared_with_it, alone = ((200, 200, H), (200, 194, T), (200, 180, F)), ((100, 100, H),)
    alone += ((100, 88, T), (100, 60, F))
    for published, cases in (([CBIRRT], compared_with_it), ([], alone)):
        for runs, solved, expected in cases:
            rows = [at("ompl-projected", k, 0.1) for k in range(runs)]
            rows += [at("opt-cvq-mpt", k, 0.1 if k < solved else None) for k in range(runs)]
            (share,) = verdicts_of(Claim("solved_in_time", 0.9842), rows, published)
            assert rulings([share]) == [expected] and share.baseline == judging.NOTHING
            assert percent(share, share.paired).startswith(str(100 * solved // runs))


def test_statements_name_planners_that_ran_and_reductions_are_signed_changes():
    times = {"opt-cvq-mpt": 0.1, "ompl-projected": 0.4}
    rows = [at(name, k, time) for k in range(8) for name, time in times.items()]
    found = verdicts_of(Claim("time", 0.5, ("ompl-projected", "mpnet")), rows, ())
    pairs_of = [(effect.baseline, effect.paired.n) for effect in found]
    assert pairs_of == [("ompl-projected", 8), ("mpnet", 0)]
    assert percent(found[0], found[0].paired) == "−75 [−75, −75]"
    assert verdicts_of(Claim("time", 0.5, ("mpnet",), "cvq-mpt"), rows, ()) == []


def test_statements_are_few():
    assert sum(max(1, len(claim.baselines)) for claim in CLAIMS) <= 36
    assert len({claim.title for claim in CLAIMS}) == len(CLAIMS)


def run(planner, problem, checks=None, seed=0, solved=True, **values):
    """Its work is `checks`."""
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
    # the last says no work
    ties = split_by_work([run("birrt", i, 5) for i in range(6)] + [run("birrt", 6)])
    assert ties["hard"] == frozenset() and len(ties["easy"]) == 6
    assert split_by_work([])["all"] == frozenset()
    works = ((1, 1000, 2), (9, 10, 11), (3, 3, 3))
    rows = [run("birrt", k, works[k][seed], seed=seed) for k, seed in product(range(3), range(3))]
    hard = {(problem, seed) for _, problem, seed in split_by_work(rows)["hard"]}
    # in seed 1 problem 0 took long: by the others it is easy
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
    assert found.changes["length"].estimate == 0.0 and found.changes["time"].n == 20
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


def test_the_command_compares_two_directories(capsys, tmp_path):
    folders = [str(tmp_path / name / "place-task") for name in "ab"]
    for name, time in (("a", 1.0), ("b", 0.5)):
        (tmp_path / name).mkdir()
        a_results_folder(tmp_path / name, birrt=time)
    assert main(["compare", *folders]) == 0
    out = capsys.readouterr().out
    assert "birrt: less time, −50.0" in out and "birrt: less work" in out
    assert main(["compare", str(tmp_path), folders[1]]) == 2
    rules = ["--fail-if", "time > 1.1", "--fail-if", "solved<-2"]
    assert main(["compare", *folders, *rules]) == 0
    assert "fails" not in capsys.readouterr().out
    assert main(["compare", *reversed(folders), *rules]) == 1
    *_, last = capsys.readouterr().out.splitlines()
    assert last == "fails: birrt: time > 1.1, it is 2 times A's"


def test_planners_of_one_run_alone_are_named_and_must_not_be_missing_from_the_second(
    capsys, tmp_path
):
    folders = [str(tmp_path / name / "place-task") for name in "ab"]
    for name, other in (("a", "mpnet"), ("b", "roadmap")):
        (tmp_path / name).mkdir()
        a_results_folder(tmp_path / name, birrt=1.0, **{other: 1.0})
    assert main(["compare", *folders]) == 0
    out = capsys.readouterr().out
    assert "in A alone, not compared: mpnet\n" in out
    assert "in B alone, not compared: roadmap\n" in out and "fails" not in out
    assert main(["compare", *folders, "--fail-if", "time > 9"]) == 1
    assert capsys.readouterr().out.splitlines()[-1] == "fails: mpnet: B has no runs of it"


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
