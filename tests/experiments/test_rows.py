"""Rows of solutions: times charged to a planner, and their columns."""

import time
from dataclasses import replace
from itertools import chain
from unittest.mock import Mock

import numpy as np
import pytest
from refusals import refused

from cvqmpt_lab.benchmarks.item import UnsolvableProblem
from cvqmpt_lab.benchmarks.multi_sequence import multi_sequence_task
from cvqmpt_lab.benchmarks.suite import suite_named
from cvqmpt_lab.certificate import Fault, FaultKind
from cvqmpt_lab.pipeline import solve, with_sampled_goals
from cvqmpt_lab.planners import Method
from cvqmpt_lab.results.row import FailReason, read_rows
from cvqmpt_lab.results.store import states_hash
from cvqmpt_lab.search.planner_interface import GaussianMixture, Proposal, Uniform
from cvqmpt_lab.search.result import Budget, PlanStatus, Timings
from cvqmpt_lab.vqmpt import scene_predictor
from experiments.experiment import Experiment
from experiments.rows import failed_rows, outcome_of, result_row
from paper_tables.committed import committed_directories

RUN = Experiment("place-task", (0,), ("birrt",), (0,), Budget(iterations=1)).runs[0]
PARTS = ("t_goals_s", "t_encode_s", "t_predict_s", "t_optimize_s", "t_plan_s", "t_simplify_s")


def row_of(problem, timings, budget=20_000):
    """The row of birrt after a slow proposer."""

    def think(query, observation):
        time.sleep(timings.total)
        return Proposal(query.uniform, timings)

    thinking = Method.simple("birrt", predict=think)
    solution = solve(problem, thinking, Budget(iterations=budget), seed=0, clearance=False)
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
    """g(q) = F(q)^T F(q): none on the manifold, of any q without a model, empty without samples."""

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
    """A planner status or certificate fault without a reason would fail a run at its end."""
    statuses = {FailReason(status) for status in PlanStatus if status is not PlanStatus.SOLVED}
    of_trajectories = {FaultKind.VELOCITY, FaultKind.ACCELERATION, FaultKind.CURRENT}
    faults = {FailReason(f"uncertified_{kind}") for kind in set(FaultKind) - of_trajectories}
    phases = {FailReason.NO_START, FailReason.NOT_TIMED, FailReason.NOT_REACHED}
    lost = {FailReason.WORKER_DIED, FailReason.WORKER_HUNG, FailReason.OUT_OF_MEMORY}
    assert statuses | faults | phases | lost | {FailReason.PLANNER_ERROR} == set(FailReason)


def test_a_path_that_is_refused_keeps_its_faults_and_a_fallback_counts_as_solved(solution):
    faults = Fault(FaultKind.STEP, "a step of 1 rad"), Fault(FaultKind.COLLISION, "in collision")
    judged = replace(solution, certificate=replace(solution.certificate, faults=faults))
    row = result_row(RUN, judged, goal_seconds=0.0)
    assert (row.solved, row.certified, row.fail_reason) == (False, False, "uncertified_step")
    assert row.detail.startswith("a step of 1 rad; in collision")
    assert row.path_sha256 == states_hash(solution.simplified.path.states)
    fallen_back = replace(solution, plan=replace(solution.plan, fallback="no path: birrt"))
    row = result_row(RUN, fallen_back, goal_seconds=0.0)
    assert (row.solved, row.fallback, row.fail_reason) == (True, "no path: birrt", None)


def test_a_problem_without_a_start_and_a_task_that_failed_as_a_whole_have_all_their_rows():
    (row,) = outcome_of(RUN, UnsolvableProblem("0", "no start grasp: =1"), 0.0).rows
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
    grouped = Mock(side_effect=scene_predictor.compiled_groups)
    monkeypatch.setattr(scene_predictor, "compiled_groups", grouped)
    item, found = with_sampled_goals(suite_named(suite).solvable(0))[0], []
    for name in ("cvq-mpt", "opt-cvq-mpt", "cvq-wide"):
        grouped.reset_mock()
        runs = Experiment(suite, (0,), (name,), (0,), Budget(iterations=1)).runs
        (row,) = outcome_of(runs[0], item, 0.0).rows
        assert row.scene_new
        found.append(grouped.call_count)
    assert found[1:] == [1, 1]
