"""External planners: how they are found, and the result row of every outcome."""

import json
import re

import numpy as np
import pytest
from command_line import run_here
from refusals import refused

from cvqmpt_lab.benchmarks.place_task import single_goal_problem
from cvqmpt_lab.benchmarks.results.provenance import ProvenanceFile
from cvqmpt_lab.benchmarks.results.row import FailReason
from cvqmpt_lab.benchmarks.results.store import states_hash
from cvqmpt_lab.experiments.experiment import Experiment
from cvqmpt_lab.experiments.run import executor_for, run_experiment
from cvqmpt_lab.external import door, names
from cvqmpt_lab.external.counted import counted, with_reported
from cvqmpt_lab.planning.pipeline import solve
from cvqmpt_lab.planning.planners import planner_named
from cvqmpt_lab.planning.warm_up import compile_kernels
from cvqmpt_lab.search.result import Budget, PlanStatus

PLANNERS = """
import os, time
import numpy as np
from cvqmpt_lab.search.planner_interface import Proposal, Uniform
from cvqmpt_lab.search.result import PlanStatus

def good(problem, budget, seed):
    from cvqmpt_lab import solve
    path = solve(problem, "birrt", budget, seed).simplified
    return None if path is None else path.path.states

def boasting(problem, budget, seed):
    drawn = Uniform(problem.robot.lower, problem.robot.upper, "theirs")
    return Proposal(drawn, failure=PlanStatus.SOLVED)

# three corners far apart: the motion collides
sparse = lambda problem, *_: [problem.start, problem.robot.upper, problem.goals[0]]
proposal = lambda problem, *_: Proposal(Uniform(problem.robot.lower, problem.robot.upper, "theirs"))

def printing(problem, budget, seed):
    print("a word")
    os.write(1, b"and one of compiled code")
    return good(problem, budget, seed)

def raising(problem, budget, seed):
    raise RuntimeError("no luck today")

def leaving(problem, budget, seed):
    raise SystemExit(3)

def cheating(problem, budget, seed):
    lower, time.perf_counter = problem.robot.lower, lambda: -1e4
    lower.setflags(write=True)
    lower -= 0.5
    return [problem.start, lower, problem.goals[0]]

nan = lambda problem, budget, seed: np.full((4, 7), np.nan)
flat = lambda problem, budget, seed: problem.start
text = lambda problem, budget, seed: "a path"
nothing = lambda problem, budget, seed: None
long = lambda problem, *_: np.linspace(problem.start, problem.goals[0], 60_000)

def late(problem, budget, seed):
    time.sleep(1.4 * budget.seconds)
    return good(problem, budget, seed)

class Counting:
    def __init__(self):
        self.calls = 0
    def __call__(self, problem, budget, seed):
        self.calls += 1
        raise ValueError(f"call {self.calls}, seed {seed}")

number = 3
"""
HOSTILE = "properties.hostile_planners"
ENTRY_POINTS = "[cvqmpt.planners]\nlucky = their_planners:good\ntb-rrt = their_planners:good\n"
# time limit [s] that only a hanging process exceeds
ENOUGH = Budget(seconds=600.0, iterations=20_000)
METADATA = "Metadata-Version: 2.1\nName: their-planners\nVersion: 1.2\n"


@pytest.fixture(scope="module", autouse=True)
def compiled():
    compile_kernels(lambda *_: None)


@pytest.fixture(scope="module", autouse=True)
def theirs(tmp_path_factory):
    """A package of planners with entry points, as pip would install it."""
    folder = tmp_path_factory.mktemp("theirs")
    (folder / "their_planners.py").write_text(PLANNERS)
    about = folder / "their_planners-1.2.dist-info"
    about.mkdir()
    (about / "METADATA").write_text(METADATA)
    (about / "top_level.txt").write_text("their_planners\n")
    (about / "entry_points.txt").write_text(ENTRY_POINTS)
    caches = (door.external_planner, names.entry_points)
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(folder)
        for cache in caches:
            cache.cache_clear()
        yield
    for cache in caches:
        cache.cache_clear()


def solved_by(name, budget=ENOUGH):
    planner = name if ":" in name else f"their_planners:{name}"
    return solve(single_goal_problem(5), planner, budget, 0)


def test_an_external_path_is_certified_as_it_is_and_its_work_is_not_counted():
    ours = solve(single_goal_problem(5), "birrt", ENOUGH, 0)
    found = solved_by("good")
    assert found.solved and found.plan.sampler == "their-planners 1.2" and found.plan.as_is
    np.testing.assert_array_equal(found.path.states, ours.path.states)


def test_straight_segments_are_divided_and_not_moved():
    found, problem = solved_by("sparse"), single_goal_problem(5)
    states = found.path.states
    corners = np.array([problem.start, problem.robot.upper, problem.goals[0]])
    assert np.linalg.norm(np.diff(states, axis=0), axis=1).max() <= 0.1 + 1e-12
    length = np.linalg.norm(np.diff(corners, axis=0), axis=1).sum()
    assert found.path.length == pytest.approx(length)
    assert not found.solved and found.certificate.reasons


def test_our_search_continues_with_a_proposal():
    solution = solved_by("proposal")
    assert solution.solved and solution.plan.sampler == "theirs"
    assert solution.plan.counters.projections > 0


@pytest.mark.parametrize(
    ("name", "status", "word"),
    [
        ("raising", PlanStatus.PLANNER_ERROR, "RuntimeError: no luck today"),
        ("leaving", PlanStatus.PLANNER_ERROR, "SystemExit: 3"),
        (f"{HOSTILE}:ends_its_process", PlanStatus.PLANNER_ERROR, "its process ended with 0"),
        (
            f"{HOSTILE}:goes_ten_million_radians_away",
            PlanStatus.MALFORMED_PATH,
            r"1 of 3 .* 1e\+07",
        ),
        ("long", PlanStatus.MALFORMED_PATH, "a path of 60000 states"),
        (f"{HOSTILE}:proposes_code", PlanStatus.MALFORMED_PATH, "a Own: give Uniform or"),
        ("nan", PlanStatus.MALFORMED_PATH, "row 0 of 4 of the states that it"),
        ("flat", PlanStatus.MALFORMED_PATH, r"states of shape \(7,\): give \(m, 7\)"),
        ("text", PlanStatus.MALFORMED_PATH, "it returned 'a path'"),
        ("boasting", PlanStatus.MALFORMED_PATH, "failure SOLVED, which is no failure"),
        ("nothing", PlanStatus.NO_PATH, ""),
        ("Counting", PlanStatus.PLANNER_ERROR, "call 1, seed 0"),
    ],
)
def test_a_result_that_is_no_path_has_a_reason(name, status, word):
    plan = solved_by(name).plan
    assert plan.status is status and plan.path is None
    assert re.search(word, plan.detail)
    assert FailReason(plan.status)


def test_a_planner_that_is_late_or_hangs_is_over_time():
    hanging = solved_by(f"{HOSTILE}:never_ends_and_catches_everything", Budget(seconds=0.2)).plan
    assert hanging.seconds > 0.9
    assert hanging.status is PlanStatus.OVERTIME
    assert "where 0.2 s were given; interrupted" in hanging.detail
    late = solved_by("late", Budget(seconds=0.6)).plan
    assert late.status is PlanStatus.OVERTIME and late.path is None


def test_output_of_a_planner_does_not_reach_standard_output(capfd):
    solution = solved_by("printing")
    written = capfd.readouterr()
    assert solution.solved and written.out == "" and "a word" in written.err
    assert "wrote 31 bytes to standard output" in solution.plan.detail


def test_rows_have_the_outcome_and_the_distribution_of_the_planner(tmp_path):
    names = tuple(f"their_planners:{name}" for name in ("cheating", "raising", "good"))
    planners = (*names, "birrt")
    experiment = Experiment("place-task-single-goal", (5,), planners, (0,), ENOUGH)
    with executor_for(experiment, 1) as executor:
        rows = run_experiment(experiment, tmp_path / "out", executor, ["test"], lambda *_: None)
    by_name = {row.planner.removeprefix("their_planners:"): row for row in rows}
    reasons = {name: row.fail_reason for name, row in by_name.items()}
    failed = {"raising": "planner_error", "cheating": "uncertified_limits"}
    assert reasons == {"good": None, "birrt": None, **failed}
    ours = solve(single_goal_problem(5), "birrt", ENOUGH, 0)
    assert by_name["birrt"].path_sha256 == states_hash(ours.path.states)
    assert by_name["birrt"].certified and not by_name["cheating"].certified
    good = by_name["good"]
    assert good.certified and good.n_projections is None and good.vertices is None
    assert good.t_wall_s >= good.t_plan_s > 0.0 and good.sampler_used == "their-planners 1.2"
    recorded = ProvenanceFile(tmp_path / "out").read()["planners"]
    assert recorded == dict.fromkeys(names, "their-planners 1.2")


def test_an_entry_point_is_a_name_and_names_of_this_package_are_refused():
    assert planner_named("lucky").external == "their-planners 1.2"
    solution = solve(single_goal_problem(5), "lucky", ENOUGH, 0)
    assert solution.solved, solution
    refused(r"'tb-rrt' of their-planners 1.2 has the name of one of ours", planner_named, "tb-rrt")


def test_a_planner_that_does_not_exist_is_refused_in_one_line():
    refused("there is no module 'no_such_module'", planner_named, "no_such_module:plan")
    refused("is 3: give a function", planner_named, "their_planners:number")
    refused("did you mean 'good'", planner_named, "their_planners:godo")
    refused("module:planner", planner_named, "unlucky")


def test_the_command_plans_with_an_external_planner_and_keeps_json_clean(capfd):
    words = ["plan", "place-task-single-goal", "--problem", 5, "--cutoff", ENOUGH.seconds]
    words += ["--iterations", ENOUGH.iterations, "--planner"]
    run_here([*words, "their_planners:printing", "--json"])
    told = json.loads(capfd.readouterr().out)
    assert told["solved"] and told["counts"] is None
    run_here([*words, "their_planners:raising"], code=1)
    assert "planner error (RuntimeError: no luck today)" in capfd.readouterr().out


COUNTED = """
import numpy as np
from my_geometry import touches

def calling(problem, budget, seed):
    checker, states = problem.collision_checker(), np.array([problem.start, problem.goals[0]])
    for q in states:
        problem.manifold.project(q + 0.4)
    touches(checker, problem.start)
    checker.in_collision_batch(states)
    return states

def reporting(problem, budget, seed):
    return calling(problem, budget, seed), {"state_checks": np.int64(1000)}

def failing(problem, budget, seed):
    return None, {"projections": 7, "newton_iterations": 21}

def wrong(problem, budget, seed):
    return None, {'checks': 3}
"""


@pytest.fixture(scope="module")
def counting(tmp_path_factory):
    """Return the plan of a planner in COUNTED, which checks states through another module."""
    folder = tmp_path_factory.mktemp("counting")
    (folder / "counting_planners.py").write_text(COUNTED)
    touches = "touches = lambda checker, q: checker.in_collision(q)\n"
    (folder / "my_geometry.py").write_text(touches)
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(folder)
        yield lambda name: solve(single_goal_problem(5), f"counting_planners:{name}", ENOUGH, 0)


def test_calls_of_ours_are_counted_and_a_report_replaces_them(counting):
    called = counting("calling").plan
    assert (called.counters.projections, called.counters.state_checks) == (2, 3)
    assert called.counters.newton_iterations > 0 and called.as_is
    reported = counting("reporting")
    told = reported.plan.counted
    assert (told.projections, told.state_checks) == (2, 1000)
    line = r"counts +2 projections, \d+ Newton iterations, 1000 state checks\n"
    assert re.search(line, str(reported.report("mine")))
    failed = counting("failing").plan
    assert failed.status is PlanStatus.NO_PATH and failed.counters.newton_iterations == 21
    wrong = counting("wrong").plan
    assert wrong.status is PlanStatus.MALFORMED_PATH and "it reported 'checks'" in wrong.detail


@pytest.mark.parametrize(
    ("report", "told"),
    [
        ({"checks": 3}, "it reported 'checks': valid counts are projections,"),
        ({"projections": -3}, "it reported projections -3: give a whole number, 0 or more"),
        ({"projections": 2.5}, "it reported projections 2.5: give a whole number"),
        ({"state_checks": float("nan")}, "it reported state_checks nan: give a whole number"),
        ({"state_checks": float("inf")}, "it reported state_checks inf: give a whole number"),
        ({"state_checks": "many"}, "it reported state_checks 'many': give a whole number"),
        ({"state_checks": [3]}, "it reported state_checks .*: give a whole number"),
        ({"state_checks": 1 << 60}, "it reported state_checks .*: give a whole number"),
    ],
)
def test_a_report_that_is_no_count_is_refused(report, told):
    refused(told, with_reported, {}, report)


def test_counting_ends_with_the_call_and_leaves_our_own_calls_out():
    problem = single_goal_problem(5)
    project = type(problem.manifold).project
    with counted() as work:
        assert type(problem.manifold).project is not project
        solve(problem, "birrt", Budget(iterations=200), 0)
        assert (work.projections, work.state_checks) == (0, 0)
    assert type(problem.manifold).project is project
