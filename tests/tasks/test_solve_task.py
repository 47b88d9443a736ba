"""A task planned whole: every phase certified, another grasp tried, failures named; its rows."""

import time
from dataclasses import replace

import numpy as np

from cvqmpt_lab.certificate import certify
from cvqmpt_lab.constraints.task_space_region import TaskSpaceRegion
from cvqmpt_lab.planners import PLANNERS, Method
from cvqmpt_lab.poses import pose
from cvqmpt_lab.search.birrt import BiRRT
from cvqmpt_lab.search.result import Budget, Counters, PlanResult, PlanStatus
from cvqmpt_lab.tasks.solve import solve_task
from experiments.experiment import Experiment
from experiments.rows import phase_rows

BUDGET = Budget(seconds=20.0)
RUN = Experiment("multi-sequence", (0,), ("birrt",), (0,), BUDGET).runs[0]
PHASES = ["reach-handle", "open-door", "reach-can", "approach", "carry"]


def test_a_whole_task_is_solved_and_every_phase_certified(task_solution):
    assert task_solution.solved and task_solution.failure == ""
    assert [outcome.phase.name for outcome in task_solution.outcomes] == PHASES
    for outcome in task_solution.outcomes:
        path = outcome.solution.simplified.path
        assert certify(outcome.solution.problem, path).valid
        motion = outcome.trajectory
        np.testing.assert_allclose(motion.velocities[[0, -1]], 0.0, atol=1e-12)
        np.testing.assert_allclose(motion.positions[[0, -1]], path.states[[0, -1]], atol=1e-9)


class FailsOnce:
    """birrt, but the first planning run to the end of a named phase finds nothing, slowly."""

    def __init__(self, phase):
        self.phase, self.failed = phase, False

    def search(self, space, *arguments):
        if space.problem.name.endswith(self.phase) and not self.failed:
            self.failed = True
            time.sleep(0.5)
            return PlanResult(PlanStatus.TIMEOUT, None, 0.5, Counters(), 0, "none")
        return BiRRT().search(space, *arguments)


def test_another_grasp_is_tried_when_a_later_phase_fails(task):
    solution = solve_task(task, Method.simple("birrt", search=FailsOnce("carry")), BUDGET, seed=0)
    assert solution.solved
    approach = next(outcome for outcome in solution.outcomes if outcome.phase.name == "approach")
    assert len(approach.attempts) == 2
    first, second = (item.simplified.path.states[-1] for item in approach.attempts)
    assert np.abs(first - second).max() > 1e-6
    rows = phase_rows(RUN, solution)
    row = next(row for row in rows if row.problem.endswith("approach"))
    assert rows[-1].solved and rows[-1].t_plan_s > 0.5  # what failed was paid for too
    assert row.n_state_checks == sum(item.plan.counters.state_checks for item in approach.attempts)


class SlidesOnlyAtLeisure:
    """birrt, but slides need more than a second."""

    def __init__(self):
        self.given = []

    def search(self, space, start, goals, distribution, budget, rng):
        if space.problem.name.endswith("approach"):
            self.given.append((round(budget.seconds), tuple(start)))
            if budget.seconds < 1.0:
                return PlanResult(PlanStatus.TIMEOUT, None, 0.0, Counters(), 0, "none")
        return BiRRT().search(space, start, goals, distribution, budget, rng)


def test_a_slide_gets_little_time_until_all_grasps_have_failed(task):
    search = SlidesOnlyAtLeisure()
    solution = solve_task(task, Method.simple("birrt", search=search), Budget(seconds=3.0), seed=0)
    assert solution.solved
    seconds = [given for given, _ in search.given]
    assert seconds == sorted(seconds) and set(seconds) == {0, 3}
    assert len({start for given, start in search.given if given == 0}) > 1


def test_a_goal_out_of_reach_names_phase_and_cause(task):
    far = TaskSpaceRegion(pose((3.0, 0.0, 0.5)), np.eye(4), np.zeros((6, 2)))
    phases = tuple(replace(p, goal=far) if p.name == "carry" else p for p in task.phases)
    solution = solve_task(replace(task, phases=phases), "birrt", BUDGET, seed=0)
    assert not solution.solved
    told = "phase 'carry': no goal: of 100 poses, 100 without inverse kinematics"
    assert solution.failure.startswith(told)
    rows = phase_rows(RUN, solution)
    assert [row.solved for row in rows] == [True] * 4 + [False]
    assert rows[-1].fail_reason == "no_goal" and "inverse kinematics" in rows[-1].detail


def test_methods_that_cannot_serve_a_phase_say_why(task_solution):
    problems = {outcome.phase.name: outcome.solution.problem for outcome in task_solution.outcomes}
    for name in ("mpnet", "cvq-mpt", "opt-cvq-mpt", "roadmap-cvq"):
        for served in ("carry", "reach-can"):
            assert PLANNERS[name].incompatibility(problems[served]) == ""
        assert "weights are for" in PLANNERS[name].incompatibility(problems["open-door"])
    for name in ("birrt", "ompl-projected", "atlas-rrt", "tb-rrt"):
        assert all(PLANNERS[name].incompatibility(problem) == "" for problem in problems.values())
