"""The paper's sentences on committed rows: words and numbers are computed again from csv files."""

import csv
import re
from dataclasses import replace
from itertools import product
from pathlib import Path
from statistics import NormalDist

import numpy as np
import pytest
from made_rows import a_failure, a_row
from scipy.special import stdtrit

from cvqmpt_lab.paper_tables import answer, beside
from cvqmpt_lab.paper_tables import claims as judged
from cvqmpt_lab.paper_tables import evidence as evidence_module
from cvqmpt_lab.paper_tables.claims import comparisons, judged_claims, sentence_level
from cvqmpt_lab.paper_tables.committed import README, RESULTS
from cvqmpt_lab.paper_tables.evidence import Evidence
from cvqmpt_lab.paper_tables.failures import failure_lines
from cvqmpt_lab.paper_tables.ompl_table import ompl_table
from cvqmpt_lab.paper_tables.pages import PAGE, report_html
from cvqmpt_lab.paper_tables.rule import Word
from cvqmpt_lab.paper_tables.statements import CLAIMS, PROBLEMS
from cvqmpt_lab.paper_tables.writers import PAGE_WIDTH

BY_TITLE = {claim.title: claim for claim in CLAIMS}


def evidence(rows):
    return Evidence(RESULTS, rows, {"streams": 2})


def priced(planner, problem, checks, solved=True, suite="place-task-ompl", **more):
    """A run whose cost is 3.5 ms for each check."""
    make = a_row if solved else a_failure
    counts = {"n_state_checks": checks, "n_projections": 0, "n_newton_iterations": 0}
    return make(problem, planner, suite=suite, **counts, **more)


def place_rows(count=40, **checks):
    """Problems of one suite; the number of checks by planner grows with the problem."""
    return [
        priced(name.replace("_", "-"), f"{6000 + k}", each * (20 + k))
        for name, each in checks.items()
        for k in range(count)
    ]


def words(title, rows):
    return [item.word for item in comparisons(BY_TITLE[title], (evidence(rows),), 0.05)]


def test_a_sentence_has_a_word_for_each_baseline_that_has_rows():
    rows = place_rows(ompl_cvq=10, ompl_projected=25, atlas_rrt=10, birrt=1)
    assert words("almost twice as fast", rows) == [Word.REPLICATED, Word.SAME]
    slower = place_rows(ompl_cvq=10, ompl_projected=5, atlas_rrt=12, tb_rrt=30)
    assert words("almost twice as fast", slower) == [Word.OPPOSITE, Word.SMALLER, Word.REPLICATED]


def test_a_failed_run_is_left_out_of_its_planners_mean_and_a_longer_run_costs_the_cutoff():
    rows = [priced("ompl-projected", f"{k}", 50_000) for k in range(40)]  # 175 s
    rows += [priced("ompl-cvq", f"{k}", 10_000, solved=k > 9) for k in range(40)]  # 35 s
    (found,) = comparisons(BY_TITLE["almost twice as fast"], (evidence(rows),), 0.05)
    assert found.effect.means.estimate == pytest.approx(35 / 100)
    assert found.failed == (10, 0) and found.word is Word.REPLICATED
    # where the other planner solves as soon, a mean over fewer problems is no evidence
    rows = [priced("ompl-projected", f"{k}", 10_000 if k < 30 else 27_000) for k in range(40)]
    rows += [priced("ompl-cvq", f"{k}", 2_000, solved=k > 29) for k in range(40)]
    (found,) = comparisons(BY_TITLE["almost twice as fast"], (evidence(rows),), 0.05)
    assert found.effect.means.high < 0.5 and found.failed == (30, 0)
    assert found.within.fewer and found.word is Word.STATISTIC


def test_seeds_of_a_problem_count_once_in_ratios_of_means():
    rows = place_rows(ompl_cvq=10, ompl_projected=25)
    once, thrice = (
        ompl_table([replace(row, seed=seed) for seed in range(seeds) for row in rows])
        for seeds in (1, 3)
    )
    of_both = [table.sections["Table I by the rule"] for table in (once, thrice)]
    assert re.search(r"0\.400 \[0\.\d+, 0\.\d+\]", str(of_both[0])) and of_both[0] == of_both[1]


def test_five_ways_to_count_failures_stand_below_the_claim_of_time():
    claim = BY_TITLE["almost twice as fast"]
    rows = [priced("ompl-projected", f"{k}", 20_000, solved=k > 3) for k in range(40)]  # 70 s
    rows += [priced("ompl-cvq", f"{k}", 10_000, solved=k < 30) for k in range(40)]  # 35 s
    _, *lines, paper = failure_lines(claim, evidence(rows), 0.05)
    means = [[float(x) for x in line[1:3]] for line in lines]
    told = [
        ((30 * 35 + 10 * 100) / 40, (36 * 70 + 4 * 100) / 40),
        (35, 70),
        ((30 * 35 + 10 * 50) / 40, (36 * 70 + 4 * 100) / 40),
        (35, 70),
        (35, 70),
    ]
    assert means == [pytest.approx(pair, rel=0.01) for pair in told]
    assert [float(line[3].split()[0]) for line in lines] == pytest.approx(
        [a / b for a, b in told], rel=0.01
    )
    assert paper[3] == "0.490"


def test_the_word_of_a_sentence_is_the_less_favourable_of_two_planners_against_cbirrt():
    rows = place_rows(ompl_cvq=10, ompl_opt_cvq=20, ompl_projected=20, atlas_rrt=5)
    longer = [replace(row, path_length_ompl_rad=1e-3 * row.n_state_checks) for row in rows]
    claims = judged_claims({"place-task-ompl": evidence(longer)})
    (length,) = (item for item in claims if item.claim.title == "shorter paths")
    assert [item.word for item in length.deciding] == [Word.REPLICATED, Word.SAME]
    assert length.word == "no difference", "whatever the words against Atlas are"


def test_the_word_depends_on_hardware_where_networks_do():
    rows = place_rows(ompl_cvq=10, ompl_projected=25)
    slow = [replace(x, t_predict_s=9.0) if x.planner == "ompl-cvq" else x for x in rows]
    (found,) = comparisons(BY_TITLE["almost twice as fast"], (evidence(slow),), 0.05)
    assert found.word is Word.HARDWARE and found.words["this machine"] is Word.OPPOSITE


def test_tasks_are_left_out_where_a_phase_failed_that_the_paper_does_not_time():
    def task(planner, k, failed=""):
        phases = {"1-reach-handle": 100, "2-open-door": 9_000, "3-reach-can": 100, "5-carry": 300}
        reason, slower = None, 1 + (planner != "ompl-cvq")
        for phase, checks in phases.items():
            reason = "not_reached" if reason else ("cost_limit" if phase == failed else None)
            more = {"suite": "multi-sequence-published", "solved": reason is None}
            more |= {"fail_reason": reason} if reason else {}
            yield priced(planner, f"{k}/{phase}", checks * slower, **more)

    claim = BY_TITLE["tasks: 45 % less planning time"]
    rows = [row for k in range(40) for row in task("ompl-cvq", k)]
    ends = dict.fromkeys(range(35, 40), "2-open-door")
    baseline = [row for k in range(40) for row in task("ompl-projected", k, ends.get(k))]
    (found,) = comparisons(claim, (evidence(rows + baseline),), 0.05)
    assert (found.planner, found.count, found.failed) == ("ompl-cvq", 35, (0, 0))
    assert found.effect.means.estimate == pytest.approx(0.5), "without the door"
    # where a phase failed that is timed, the task is not solved
    ends = dict.fromkeys(range(35, 40), "1-reach-handle")
    baseline = [row for k in range(40) for row in task("ompl-projected", k, ends.get(k))]
    (found,) = comparisons(claim, (evidence(rows + baseline),), 0.05)
    assert (found.count, found.failed) == (40, (0, 5))
    assert found.effect.means.estimate == pytest.approx(0.5)


def test_problems_that_could_not_be_made_are_left_out():
    rows = place_rows(ompl_cvq=10, ompl_projected=25)
    for planner in ("ompl-cvq", "ompl-projected"):
        rows += [priced(planner, f"{k}", 0, False, fail_reason="no_start") for k in range(40, 50)]
    (found,) = comparisons(BY_TITLE["almost twice as fast"], (evidence(rows),), 0.05)
    assert (found.count, found.failed) == (40, (0, 0))
    assert found.effect.means.estimate == pytest.approx(0.4)


def test_kinds_are_pooled_over_suites():
    claim = BY_TITLE["other constraints, without training"]
    rng = np.random.default_rng(0)
    parts = []
    for suite, kinds in (("constraints-ompl", "ab"), ("constraints-more-ompl", "cd")):
        rows, first = [], PROBLEMS[suite][0]
        for place, kind in enumerate(kinds, start=1):
            for k in range(first, first + 30):
                name, checks = f"{k}/{place}-{kind}", int(rng.uniform(1000, 5000))
                rows.append(priced("ompl-projected", name, checks, suite=suite))
                rows.append(
                    priced("ompl-cvq", name, int(0.6 * checks * rng.uniform(0.9, 1.1)), suite=suite)
                )
        parts.append(evidence(rows))
    (found,) = comparisons(claim, tuple(parts), 0.05)
    assert found.word is Word.REPLICATED and found.effect.means.n == 4 and found.count == 120


def test_rows_of_old_random_streams_and_of_problems_used_before_are_not_judged(monkeypatch):
    monkeypatch.setattr(evidence_module, "STREAMS", 2)
    monkeypatch.setattr(evidence_module, "PROBLEMS", {"place-task-ompl": [6000, 6039]})
    rows = place_rows(ompl_cvq=10, ompl_projected=25)

    def told(rows, **record):
        found = {"place-task-ompl": Evidence(RESULTS, rows, record)}
        claims = {item.claim.title: item for item in judged_claims(found)}
        return claims["almost twice as fast"], evidence_module.banner(found)

    for record in ({}, {"streams": 2, "continued": [{}]}):
        item, banner = told(rows, **record)
        assert item.word == "not run" and banner.startswith("Not judged: place-task-ompl")
    item, banner = told(rows, streams=2)
    assert item.comparisons[0].count == 40 and banner == ""
    spent = [replace(row, problem=f"5{row.problem[1:]}") for row in rows]
    assert told(spent + rows, streams=2)[0].comparisons[0].count == 40
    item, banner = told(spent, streams=2)
    assert item.word == "not run" and "none of the problems that are judged" in banner


def test_claims_without_rows_say_so_and_what_cannot_be_tested_too():
    found = {item.claim.title: item.word for item in judged_claims({})}
    assert found.pop("probabilistically complete") == "not testable"
    assert set(found.values()) == {"not run"}


def test_verdicts_lead_a_report_of_rows_that_judge():
    rows = place_rows(count=120, ompl_cvq=10, ompl_projected=25)
    text = report_html({"place-task-ompl": Evidence(Path("made"), rows, {"streams": 2})})
    places = [text.index(mark) for mark in ('id="verdicts"', "almost twice as fast", "<details")]
    assert places == sorted(places) and "not testable" in text and 'class="verdict holds"' in text
    assert "prices of the published code" in text and "judgement.md" not in text, "a single file"


def few_rows(**checks):
    """Five problems, whose costs differ by more than the planners do."""
    return [row for row in place_rows(**checks) if int(row.problem) < 6005]


def test_few_problems_have_an_interval_and_no_verdict():
    claim = BY_TITLE["almost twice as fast"]
    (found,) = comparisons(claim, (evidence(few_rows(ompl_cvq=10, ompl_projected=25)),), 0.05)
    assert found.word is Word.OPEN and found.few[:3] == pytest.approx([0.4] * 3)
    rows = few_rows(ompl_cvq=10, ompl_projected=25)
    uneven = [
        replace(row, n_state_checks=row.n_state_checks * (1 + 4 * (row.problem == "6002")))
        if row.planner == "ompl-cvq"
        else row
        for row in rows
    ]
    (found,) = comparisons(claim, (evidence(uneven),), 0.05)
    low, high = found.few.low, found.few.high
    assert found.few.estimate == pytest.approx(0.4 * (110 + 4 * 22) / 110) and low < 0.4 < 1 < high
    judged_claim = judged.JudgedClaim(claim, (found,), ())
    assert beside.here(judged_claim).endswith("], 5 cannot decide")
    solved = BY_TITLE["MPNet does not generalize"]
    mpnet = few_rows(ompl_cvq=10, ompl_mpnet=10)
    failed = [replace(x, solved=False, certified=None, fail_reason="timeout") for x in mpnet[5:]]
    (share,) = comparisons(solved, (evidence([*mpnet[:5], *failed]),), 0.05)
    assert share.few.estimate == 1.0 and share.few.low > 0.0
    told = beside.here(judged.JudgedClaim(solved, (share,), ()))
    assert told.startswith("+100 [") and told.endswith("pt, as the paper says")
    one = [row for row in rows if row.problem == "6000"]
    (single,) = comparisons(claim, (evidence(one),), 0.05)
    assert beside.here(judged.JudgedClaim(claim, (single,), ())) == "0.400, 1 cannot decide"


def test_own_rows_that_are_the_committed_ones_repeat_them_all():
    rows = few_rows(ompl_cvq=1000, ompl_projected=2500)
    known = {"place-task-ompl": evidence(rows)}
    assert "same 10 runs, 10 have the same result (solved or not), 10" in beside.repeated(
        known, known
    )
    other = [replace(row, n_state_checks=row.n_state_checks + 100) for row in rows]
    told = beside.repeated({"place-task-ompl": evidence(other)}, known)
    assert "10 have the same result (solved or not), 0 exactly" in told and "and 10 the" in told
    assert beside.repeated({"place-task": evidence(rows)}, known) == ""


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ([Word.REPLICATED] * 3, "yes"),
        ([Word.REPLICATED, Word.OPPOSITE], "in part"),
        ([Word.SMALLER] * 2, "in part"),
        ([Word.SAME, Word.OPEN], "no"),
        ([Word.OPPOSITE] * 2, "no"),
        ([Word.OPEN], "undecided"),
    ],
)
def test_the_answer_is_yes_no_or_in_part(words, told):
    made = [judged.Comparison(planner="a", baseline="b", count=40, failed=(0, 0), paper=0.5, word=x)
            for x in words]  # fmt: skip
    assert answer.answer_word(made) == told


def test_the_answer_of_hardware_is_in_part_where_some_time_of_networks_gives_it():
    (found,) = comparisons(
        BY_TITLE["almost twice as fast"],
        (evidence(place_rows(ompl_cvq=10, ompl_projected=25)),),
        0.05,
    )
    depends = replace(found, word=Word.HARDWARE)
    assert answer.answer_word([depends]) == "in part"
    parts = [answer.Part(name, word, "", "") for name, word in (("Time", "no"), ("Length", "yes"))]
    assert answer.whole_word(parts) == "in part" and answer.whole_word(parts[:1]) == "no"


# ---------------------------------------------------------------- committed rows


def read(suite):
    with (RESULTS / suite / "runs.csv").open(newline="") as handle:
        return list(csv.DictReader(handle))


def cost(row, projection=0.13e-3, step=0.5e-3):
    checks, projections, steps = (
        float(row[name] or 0) for name in ("n_state_checks", "n_projections", "n_newton_iterations")
    )
    seconds = 3.5e-3 * checks + projection * projections + step * steps
    return min(seconds, 100.0) if row["solved"] == "true" else np.nan


def columns(suite, planner, baseline, value, both=False):
    """Values of two planners on each problem."""
    runs = {(row["planner"], row["problem"]): row for row in read(suite)}
    pairs = [
        (row, runs[baseline, problem])
        for (name, problem), row in runs.items()
        if name == planner and (baseline, problem) in runs
    ]
    if both:
        pairs = [x for x in pairs if all(row["solved"] == "true" for row in x)]
    return np.array([[value(row) for row in x] for x in pairs]).T


def bca(own, other, level):
    """Ratio of means over own solved problems, with bias-corrected and accelerated bounds."""
    rng, normal, n = np.random.default_rng(1), NormalDist(), len(own)

    def ratio(chosen):
        return np.nanmean(own[chosen], axis=-1) / np.nanmean(other[chosen], axis=-1)

    draws = np.concatenate([ratio(rng.integers(n, size=(2_000, n))) for _ in range(10)])
    estimate = ratio(np.arange(n))
    left = np.array([ratio(np.delete(np.arange(n), k)) for k in range(n)])
    away = left.mean() - left
    speed = (away**3).sum() / (6.0 * (away**2).sum() ** 1.5)
    bias = normal.inv_cdf((draws < estimate).mean())
    ends = (bias + normal.inv_cdf(x) for x in (level / 2.0, 1.0 - level / 2.0))
    low, high = (np.quantile(draws, normal.cdf(bias + z / (1.0 - speed * z))) for z in ends)
    return estimate, low, high


def never_fewer(own, other, limit, level):
    """Whether Student's bound of the difference of shares lies above -5 points at every time."""
    bounds = []
    for time in {*own[own < limit], *other[other < limit], limit}:
        gains = np.append((own <= time) * 1.0 - (other <= time), [0.5**0.5, -(0.5**0.5)])
        width = stdtrit(len(gains) - 1, 1.0 - level / 2.0) * gains.std(ddof=1)
        bounds.append(gains.mean() - width / len(gains) ** 0.5)
    return min(bounds) > -0.05


def own_word(estimate, low, high, paper, behind):
    if high < 1.0:
        if behind:
            return "inconclusive"
        if low > paper:
            return "same direction, smaller"
        return "replicated" if max(high / estimate, estimate / low) <= 1.5 else "inconclusive"
    if low > 1.0:
        return "opposite"
    return "no difference" if low >= 0.9 and high <= 1.0 / 0.9 else "inconclusive"


def length(row):
    return float(row["path_length_ompl_rad"] or "nan")


@pytest.mark.parametrize(
    ("title", "planner", "baseline", "paper"),
    [
        ("almost twice as fast", "ompl-cvq", "ompl-projected", 11.25 / 22.95),
        ("almost twice as fast", "ompl-cvq", "tb-rrt", 11.25 / 25.31),
        ("Algorithm 2 improves planning", "ompl-opt-cvq", "ompl-cvq", 11.03 / 11.25),
        ("shorter paths", "ompl-cvq", "ompl-projected", 5.08 / 8.715),
        ("shorter paths", "ompl-opt-cvq", "atlas-rrt", 5.507 / 5.85),
    ],
)
def test_five_verdicts_follow_from_the_rows_by_other_code(
    title, planner, baseline, paper, committed_claims
):
    claim = BY_TITLE[title]
    (suite,) = claim.suites
    (of,) = (item for item in committed_claims if item.claim is claim)
    (found,) = (x for x in of.comparisons if (x.planner, x.baseline) == (planner, baseline))
    of_length = claim.measure == "length"
    own, other = columns(suite, planner, baseline, length if of_length else cost, of_length)
    estimate, low, high = bca(own, other, sentence_level())
    assert found.effect.means.estimate == pytest.approx(estimate) and found.count == len(own)
    assert found.effect.means[1:3] == pytest.approx((low, high), rel=0.02)
    behind = not (of_length or never_fewer(own, other, 50.0, sentence_level()))
    first = {str(found.words.get("0 s, as published", found.word)), *map(str, found.others)}
    near = product((0.99, 1.0, 1.01), repeat=2)  # within the error of these draws
    own_words = {own_word(estimate, a * low, b * high, paper, behind) for a, b in near}
    assert first & own_words and (len(own_words) > 1 or first == own_words)


def test_the_readmes_sentences_have_the_numbers_of_the_rows():
    text = README.read_text(encoding="utf-8")
    written = text[text.index("<!-- answer") : text.index("<!-- end of answer")]
    bold = written.partition("\n\n")[0]
    questions = ("Time", "Length", "Accuracy", "Algorithm 2")
    places = [bold.index(f"{question}: ") for question in questions]
    assert places == sorted(places) and bold.count("**") == 2
    assert written.index(bold) < written.index("forest.png") < written.index("**Time.**")
    told = [float(x) for x in re.findall(r"(\d\.\d+) \[", written)]
    suite = "place-task-ompl"

    def ratio(planner, baseline, value=cost, both=False, suite=suite):
        return np.divide(*np.nanmean(columns(suite, planner, baseline, value, both), axis=1))

    cheap = ratio("ompl-cvq", "ompl-projected", lambda row: cost(row, 55e-6, 80e-6))
    second = "place-task-ompl-more"
    means = [ratio("ompl-cvq", "ompl-projected", suite=name) for name in (suite, second)]
    means += [cheap, ratio("ompl-cvq", "ompl-uniform")]
    means.append(ratio("ompl-cvq", "ompl-projected", length, True))
    means.append(ratio("ompl-opt-cvq", "ompl-cvq", suite=second))
    assert told[:6] == pytest.approx(means, abs=0.006)
    shares = [int(x) for x in re.findall(r"(\d+) %", written.partition("Within 10 s")[2])]
    both = columns(suite, "ompl-cvq", "ompl-projected", cost)
    wanted = [100.0 * np.mean(values <= time) for time in (10.0, 50.0) for values in both]
    assert shares[:4] == pytest.approx(wanted, abs=0.51)


def test_the_readmes_table_of_planners_has_the_medians_of_the_rows():
    text = README.read_text(encoding="utf-8")
    table = text[text.index("<!-- table") : text.index("<!-- end of table")]
    lines = re.findall(r"^\| `(\S+)` \| (\d+) of (\d+) \| (\S+) \| (\S+) \|", table, re.MULTILINE)
    rows, medians = read("peers"), {}
    for planner, solved, count, seconds, slower in lines:
        own = [row for row in rows if row["planner"] == planner]
        proven = [row["solved"] == "true" for row in own]
        assert (sum(proven), len(own)) == (int(solved), int(count))
        times = [float(row["t_wall_s"]) if row["solved"] == "true" else np.inf for row in own]
        medians[planner] = np.median(times)
        told = [float(x.replace("∞", "inf")) for x in (seconds, slower)]
        wanted = [medians[planner], medians[planner] / medians[lines[0][0]]]
        assert told == pytest.approx(wanted, rel=0.006)
    assert len(medians) == 7 and min(medians, key=medians.get) == lines[0][0]


def test_mean_lengths_are_of_the_same_problems_for_all_planners():
    """Those of MPNet, which solves few problems, stood beside means over others."""
    folder = RESULTS / "place-task-published"
    solved = {}
    with (folder / "runs.csv").open(newline="") as handle:
        for row in csv.DictReader(handle):
            if row["path_length_ompl_rad"] and row["solved"] == "true":
                solved.setdefault(row["planner"], set()).add(row["problem"])
    joint = len(set.intersection(*solved.values()))
    with (folder / "table.csv").open(newline="") as handle:
        means = {
            x["planner"]: x for x in csv.DictReader(handle) if x["metric"] == "raw_length_mean"
        }
    assert means.pop("ompl-mpnet")["value"] == "" and means.keys() == solved.keys()
    assert {int(line["n"]) for line in means.values()} == {joint}


def test_tables_of_the_page_are_not_wider_than_a_page():
    """Tables of ten columns were cut at the right edge; each part repeats planner and baseline."""
    lines = PAGE.read_text(encoding="utf-8").splitlines()
    wide = [line for line in lines if line.startswith("|") and len(line) > PAGE_WIDTH + 1]
    assert not [line for line in wide if "ompl-cvq" in line]
    heads = [line for line in lines if line.startswith("| planner")]
    assert sum("against" in line for line in heads) > 10
