"""Rows of solutions, and the regression test of tables, which names changes."""

import time
from dataclasses import replace
from itertools import chain
from unittest.mock import Mock

import numpy as np
import pytest
from made_rows import CLEAN, a_results_folder, a_row
from refusals import refused

from cvqmpt_lab.benchmarks.declarations import SUITES
from cvqmpt_lab.benchmarks.item import UnsolvableProblem
from cvqmpt_lab.benchmarks.place_task import multi_sequence_task
from cvqmpt_lab.benchmarks.results.row import FailReason, read_rows
from cvqmpt_lab.benchmarks.results.store import RunStore, states_hash
from cvqmpt_lab.benchmarks.suite import suite_named
from cvqmpt_lab.certificate.certificate import Fault, FaultKind
from cvqmpt_lab.experiments import regression
from cvqmpt_lab.experiments.experiment import Experiment
from cvqmpt_lab.experiments.regression import CASES, EXPECTED, Case, Expectations, compare, sample
from cvqmpt_lab.experiments.run import failed_rows, outcome_of, result_row
from cvqmpt_lab.paper_tables.committed import committed_directories, differing_cells, untraceable
from cvqmpt_lab.paper_tables.rendering import render_directory
from cvqmpt_lab.planning import planners as table
from cvqmpt_lab.planning.pipeline import solve
from cvqmpt_lab.search.birrt import BiRRT
from cvqmpt_lab.search.method import Method
from cvqmpt_lab.search.planner_interface import GaussianMixture, Proposal, Uniform
from cvqmpt_lab.search.result import Budget, PlanStatus, Timings
from cvqmpt_lab.vqmpt import sequence_predictor

HERE = {"numba for": "this one", "numba": "1"}
ELSEWHERE = {"numba for": "another one", "numba": "1"}


class BrokenBiRRT(BiRRT):
    """birrt that always draws the same sample."""

    def search(self, query, distribution):
        start = query.start[None]
        near = GaussianMixture(start, 1e-6 * np.eye(start.shape[1])[None], np.ones(1))
        budget = replace(query.deadline.budget, iterations=50)
        return super().search(query.limited(budget), near)


def outcome(seed=0, planner="birrt", **values):
    plain = {"fail_reason": None, "path_length_rad": 8.0, "path_sha256": "a"}
    guarded = dict.fromkeys(regression.GUARDED_COLUMNS, 100)
    return {Case(planner, 1, seed, 10): guarded | plain | values}


def many(**values):
    """Return outcomes of 40 runs."""
    return {case: run for seed in range(40) for case, run in outcome(seed, **values).items()}


CHANGES = (  # in how many of 40 runs; what differs with equal arithmetic, and elsewhere
    (40, {}, "", ""),
    (1, {"path_sha256": "b"}, "path_sha256 was a, is b", ""),
    (1, {"n_projections": 300}, "n_projections was 100, is 300", ""),
    (40, {"n_state_checks": 101}, "n_state_checks was 100", ""),
    (40, {"n_state_checks": 97}, "n_state_checks was 100", "50% quantile of the factors"),
    (5, {"n_projections": 300}, "n_projections was 100", "90% quantile of the factors"),
    (40, {"path_length_rad": 8.3}, "path_length_rad was 8.0", "50% quantile"),
    (2, {"fail_reason": "timeout"}, "fail_reason was None", ""),
    (3, {"fail_reason": "timeout"}, "fail_reason was None", "3 of 40 runs end otherwise"),
)


@pytest.mark.parametrize(("count", "change", "exactly", "by_bounds"), CHANGES)
def test_equality_here_and_stated_bounds_elsewhere(count, change, exactly, by_bounds):
    """With equal arithmetic and versions, every changed run gives a line."""
    expected, outcomes = Expectations(HERE, many()), many()
    for case in [*outcomes][:count]:
        outcomes[case] = outcomes[case] | change
    exact_lines = [exactly] * count if exactly else []
    for here, wanted in ((HERE, exact_lines), (ELSEWHERE, [by_bounds] if by_bounds else [])):
        mode, found = compare(expected, outcomes, here)
        assert len(found) == len(wanted)
        assert all(words in line for words, line in zip(wanted, found, strict=True)), found
        assert mode.startswith("exactly") is (here is HERE or not exactly)
    if "50%" in by_bounds:
        assert compare(expected, outcomes, ELSEWHERE, typical=1.5)[1] == []


ALTERED = {"step": (BiRRT(step=0.13), 0), "seed": (BiRRT(), 10), "nothing": (BiRRT(), 0)}


@pytest.mark.parametrize("altered", ALTERED)
def test_an_altered_planner_fails_in_both_forms(monkeypatch, altered):
    """Another step and another seed are found, bit for bit and as a whole; equal runs pass."""
    search, seeds = ALTERED[altered]
    monkeypatch.setitem(table.PLANNERS, "birrt", Method.simple("birrt", search=search))
    cases = [case for case in CASES if case[:1] == ("birrt",) and case.suite == "place-task"]
    committed = Expectations.load(EXPECTED)
    wanted = committed._replace(outcomes={case: committed.outcomes[case] for case in cases})
    made = regression.measure([case._replace(seed=case.seed + seeds) for case in cases])
    outcomes = dict(zip(cases, made.values(), strict=True))
    for form in (wanted.made_with, {**wanted.made_with, "numba for": "another processor"}):
        mode, found = compare(wanted, outcomes, form)
        assert bool(found) is (altered != "nothing"), (mode, found)


def test_the_sample_has_every_planner_of_every_suite_and_a_failure():
    kinds = {(case.planner, case.suite) for case in CASES}
    assert {(case.planner, case.suite) for case in sample()} == kinds
    assert len(sample()) == len(kinds) + 1 and CASES[0] in sample()


def test_expectations_without_run_or_of_no_use_are_named(tmp_path):
    _, found = compare(Expectations(HERE, outcome(0) | outcome(1)), outcome(1) | outcome(2), HERE)
    assert [line.split(", ")[2] for line in found] == ["seed 0", "seed 2"]
    path, told = tmp_path / "e.json", r"e\.json .*check-tables --update"
    refused(told, Expectations.load, path)
    Expectations(HERE, {}).save(path)
    refused("no runs", Expectations.load, path)
    for wrong in ({"seed": "0"}, {"planner": 5}, {"n_projections": "many"}):
        Expectations(HERE, outcome(**wrong)).save(path)
        refused(told, Expectations.load, path)
    for text in ("", "[]", "{}", '{"schema": "other/1"}', '{"schema": 5, "runs": 5}', "[" * 9999):
        path.write_text(text)
        refused(told, Expectations.load, path)


def test_the_committed_expectations_are_of_these_cases_and_of_every_planner():
    committed = Expectations.load(EXPECTED)
    assert sorted(committed.outcomes) == sorted(CASES)
    products = {case.planner for case in CASES if case.planner.startswith("cvq:")}
    assert {case.planner for case in CASES} - products == {*table.PLANNERS}
    assert products < {*SUITES["factorial"].planners}
    reasons = {values["fail_reason"] for values in committed.outcomes.values()}
    assert reasons == {None, "iteration_limit"}


@pytest.fixture
def results(tmp_path):
    """A folder of results with one directory of rendered rows."""
    (tmp_path / "results").mkdir()
    folder = a_results_folder(tmp_path / "results", birrt=1.0, ompl_projected=2.0)
    render_directory(folder / "place-task")
    return folder


def tampered(path, old, new):
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


OLD_AND_NEW = "committed '21.95', rendered '22.95'"


def test_a_tampered_table_is_named_by_cell(results):
    directory = results / "place-task"
    for name, old, new, words in (
        ("table.md", "22.95", "21.95", ["row 'ompl-projected (CBiRRT)'", OLD_AND_NEW]),
        ("table.tex", "22.95", "21.95", ["committed '21.95", "rendered '22.95"]),
        ("table.csv", "22.95", "21.95", ["row 'place-task', cell 6", OLD_AND_NEW]),
        ("table.md", "| birrt", "|  birrt", ["spaces differ"]),
    ):
        before = (directory / name).read_text()
        tampered(directory / name, old, new)
        (line,) = differing_cells(directory)
        assert line.startswith(f"{directory / name}, line ")
        assert line.endswith(f"cvqmpt table {directory}")
        assert all(word in line for word in words), line
        (directory / name).write_text(before)


def test_changed_rows_and_missing_tables_are_noticed(results):
    directory = results / "place-task"
    (directory / "table.tex").unlink()
    assert "table.tex: missing" in "".join(differing_cells(directory))
    tampered(directory / "runs.csv", ",true,,,,true,", ",false,timeout,,,,")
    assert len(differing_cells(directory)) == 3
    (directory / "provenance.json").unlink()
    assert "cannot be rendered" in "".join(differing_cells(directory))


NO_DIGEST = "no digest of the weights 'vq_mpt'"


SESSIONS = (
    ({"git_dirty": True}, "made from aaaaaaaaaaaa with uncommitted changes"),
    ({"git_commit": None}, "made without a commit"),
    *((session, NO_DIGEST) for session in ({}, {"weights": {"mpnet": "b" * 64}})),
)


@pytest.mark.parametrize(("session", "words"), SESSIONS)
def test_rows_that_cannot_be_traced_are_refused(tmp_path, session, words):
    for planner, made in (("birrt", {}), ("cvq-mpt", session)):
        with RunStore.open(tmp_path, {}, CLEAN | made) as store:
            store.append([a_row("1", planner, suite="place-task")])
    needs = {"cvq-mpt": ("vq_mpt",) if words == NO_DIGEST else ()}
    (line,) = untraceable(tmp_path, lambda planner: needs.get(planner, ()))
    assert words in line


def test_the_command_is_red_until_an_update(results, tmp_path, monkeypatch, cvqmpt):
    case = Case("birrt", 2, 0, 20_000)
    monkeypatch.setattr(regression, "CASES", (case,))
    check = f"check-tables --expected {tmp_path / 'e.json'} --results {results}"
    cvqmpt(f"{check} --update")
    told = cvqmpt(check)
    assert "runs compared exactly" in told
    assert "tables of 1 results directories rendered again: no difference" in told
    monkeypatch.setitem(table.PLANNERS, "birrt", Method.simple("birrt", search=BrokenBiRRT()))
    assert f"  differs: {case}: fail_reason was None" in cvqmpt(check, code=1)
    cvqmpt(f"{check} --update")
    cvqmpt(check)
    tampered(results / "place-task" / "table.md", "22.95", "21.95")
    assert OLD_AND_NEW in cvqmpt(check, code=1)


RUN = Experiment("place-task", (0,), ("birrt",), (0,), Budget(iterations=1)).runs[0]
PARTS = ("t_goals_s", "t_encode_s", "t_predict_s", "t_optimize_s", "t_plan_s", "t_simplify_s")


def row_of(problem, timings, budget=20_000):
    """Return the row of `birrt` with a slow prediction stage."""

    def think(query, observation):
        time.sleep(timings.total)
        return Proposal(query.uniform, timings)

    thinking = Method.simple("birrt", predict=think)
    solution = solve(problem, thinking, Budget(iterations=budget), seed=0)
    return result_row(RUN, solution, goal_seconds=0.25), solution


def test_every_part_is_in_its_column_and_the_total_is_their_sum(problem):
    row, solution = row_of(problem, Timings(encode=0.07, predict=0.11, optimize=0.13))
    assert (row.t_encode_s, row.t_predict_s, row.t_optimize_s) == (0.07, 0.11, 0.13)
    assert row.t_plan_s == solution.plan.search_seconds < solution.plan.seconds - 0.309
    assert row.t_total_s == pytest.approx(sum(getattr(row, part) for part in PARTS))
    total = 0.25 + solution.plan.seconds + solution.simplified.seconds
    assert row.t_total_s == pytest.approx(total)
    failed, solution = row_of(problem, Timings(encode=0.03), budget=1)
    assert failed.t_total_s == pytest.approx(0.25 + solution.plan.seconds)
    assert (failed.solved, failed.t_predict_s, failed.t_simplify_s) == (False, None, None)
    refused("timing 'predict'", Timings, predict=float("nan"))
    refused("timing 'predict'", Timings, predict=-1.0)


def test_g_is_that_of_what_is_sampled(problem):
    """g(q) = F(q)^T F(q): 0 on the manifold, also without a model, None without samples."""

    def g_of(covariance):
        uniform = Uniform(problem.robot.lower, problem.robot.upper)
        near = GaussianMixture.equal(problem.goals, covariance * np.eye(7), uniform, 0.0, "near")
        method = Method.simple("near", predict=lambda query, observation: Proposal(near))
        return result_row(RUN, solve(problem, method, Budget(iterations=1), seed=0), 0.0).g_sampled

    assert g_of(1e-12) == 0.0 < g_of(0.1) < g_of(1.0)
    anywhere = problem.robot.random_configurations(np.random.default_rng(1), 4000)
    expected = np.square(problem.manifold.residual(anywhere)).sum(axis=1).mean()
    row, solution = row_of(problem, Timings(), budget=1)
    assert row.g_sampled == pytest.approx(expected, rel=0.2)
    assert result_row(RUN, replace(solution, distribution=None), 0.0).g_sampled is None


def test_every_way_to_fail_has_its_reason():
    """Every planner status and every certificate fault has a reason of failure."""
    of_trajectories = ["velocity", "acceleration", "jerk", "effort", "current", "torque_rate"]
    of_trajectories += ["frame_speed", "frame_turning_speed", "velocity_jump"]
    for status in set(PlanStatus) - {PlanStatus.SOLVED}:
        assert FailReason(status)
    for kind in set(FaultKind) - {FaultKind(name) for name in of_trajectories}:
        assert FailReason(f"uncertified_{kind}")


def test_a_path_that_is_refused_keeps_its_faults_and_a_fallback_counts_as_solved(solution):
    faults = Fault(FaultKind.STEP, "a step of 1 rad"), Fault(FaultKind.COLLISION, "in collision")
    judged = replace(solution, certificate=replace(solution.certificate, faults=faults))
    row = result_row(RUN, judged, goal_seconds=0.0)
    assert (row.solved, row.certified, row.fail_reason) == (False, False, "uncertified_step")
    assert row.detail.startswith("a step of 1 rad; in collision")
    assert row.path_sha256 == states_hash(solution.path.states)
    fallen_back = replace(solution, plan=replace(solution.plan, fallback="no path: birrt"))
    row = result_row(RUN, fallen_back, goal_seconds=0.0)
    assert (row.solved, row.fallback, row.fail_reason) == (True, "no path: birrt", None)


def test_a_problem_without_a_start_and_a_task_that_failed_as_a_whole_have_all_their_rows():
    (row,) = outcome_of(RUN, UnsolvableProblem("0", "no start grasp: =1")).rows
    assert (row.key, row.fail_reason, row.detail) == (RUN.key, "no_start", "no start grasp: =1")
    rows = failed_rows(RUN, multi_sequence_task(0), FailReason.WORKER_DIED, "it ended")
    assert [row.fail_reason for row in rows] == ["worker_died"] + ["not_reached"] * 4
    assert {row.item for row in rows} == {"0"} and rows[-1].problem == "0/5-carry"


def test_committed_rows_load_and_add_up(part):
    files = [path for folder in committed_directories() for path in folder.glob("runs.csv")]
    assert len(files) >= 5
    for row in chain.from_iterable(map(read_rows, part(files, 6))):
        parts = sum(getattr(row, part) or 0.0 for part in PARTS)
        assert (row.t_total_s or 0.0) == pytest.approx(parts)


@pytest.mark.parametrize("suite", ["family-shelves", "place-task"])
def test_every_run_is_charged_for_the_encoding_of_its_scene(monkeypatch, suite):
    grouped = Mock(side_effect=sequence_predictor.compiled_groups)
    monkeypatch.setattr(sequence_predictor, "compiled_groups", grouped)
    item, found = suite_named(suite).solvable(0), []
    for name in ("cvq-mpt", "opt-cvq-mpt", "cvq-wide"):
        grouped.reset_mock()
        runs = Experiment(suite, (0,), (name,), (0,), Budget(iterations=1)).runs
        (row,) = outcome_of(runs[0], item).rows
        assert row.scene_new
        found.append(grouped.call_count)
    assert found[1:] == [1, 1]
