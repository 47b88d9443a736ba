"""Tasks of the published code: fixed configurations, the replayed door, draws of each task."""

import numpy as np
import pytest
from refusals import refused

from cvqmpt_lab.benchmarks.declarations import SUITES
from cvqmpt_lab.benchmarks.place_task import DOOR_OPEN_RAD, bar_pose, handle_region
from cvqmpt_lab.benchmarks.published import (
    ORDINARY_RAD,
    SHELF_GRASPS,
    PublishedProblem,
    door_motion,
    published_phases,
    published_problem,
)
from cvqmpt_lab.benchmarks.results.row import PAPER_PHASES
from cvqmpt_lab.constraints.task_space_region import displacements
from cvqmpt_lab.experiments.experiment import Experiment
from cvqmpt_lab.experiments.run import outcome_of
from cvqmpt_lab.features.tasks.solve import phase_seed
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.search.ompl_planners import OMPL_STEP_RAD, OmplSearch, _Run
from cvqmpt_lab.search.planner_interface import Query
from cvqmpt_lab.search.result import Budget
from cvqmpt_lab.search.space import ConstrainedSpace

SUITE = "multi-sequence-published"


def planned(number, planner, budget):
    """Return the rows of a task that is not in the suite."""
    run = Experiment(SUITE, SUITES[SUITE].problems[:1], (planner,), (0,), budget).runs[0]
    return outcome_of(run, published_phases(number)).rows


def distance_from_limits(q, robot):
    return np.minimum(q - robot.lower, robot.upper - q).min()


def test_no_two_tasks_have_equal_draws_in_a_phase():
    """All tasks had the seed of their first phase: one run of the others, 66 times."""
    draws = {phase: [] for phase in PAPER_PHASES}
    goals = []
    tasks = range(2000, 2100)
    for number in tasks:
        phases = published_phases(number)
        for phase, problem in phases.problems.items():
            stream = problem.random_stream(phase_seed(0, phases.name, phase))
            draws[phase].append(tuple(stream.random(4)))
        goals.append(tuple(problem.goals[0]))
    assert all(len(set(found)) == len(tasks) for found in (*draws.values(), goals))


def test_seeds_differ_between_seeds_tasks_phases_and_attempts():
    seeds = {
        phase_seed(seed, str(task), phase, tried)
        for seed in range(2)
        for task in range(100)
        for phase in ("open-door", *PAPER_PHASES)
        for tried in range(2)
    }
    assert len(seeds) == 2 * 100 * 4 * 2
    assert phase_seed(0, "3000", "carry") == phase_seed(0, "3000", "carry")


def test_two_tasks_have_other_paths_where_their_problems_are_equal():
    one, other = (planned(number, "ompl-uniform", Budget(cost=100.0)) for number in (2000, 2001))
    assert [row.problem for row in one] == [
        f"2000/{k}-{phase}" for k, phase in enumerate(PAPER_PHASES, start=1)
    ]
    assert all(row.solved for row in (*one, *other))
    assert len({row.path_sha256 for row in (*one, *other)}) == 6
    for row in one:
        assert row.execution_time_s > 0.0 and row.path_length_ompl_rad > 0.0
        assert row.t_total_s == pytest.approx(
            row.t_goals_s + row.t_plan_s + row.t_simplify_s, abs=1e-6
        )


def test_a_phase_is_planned_whether_the_one_before_fails_or_not():
    rows = planned(2000, "ompl-uniform", Budget(iterations=1))
    assert [str(row.fail_reason) for row in rows] == ["iteration_limit"] * 3


def test_phases_begin_and_end_in_fixed_configurations():
    first, second = published_phases(3).problems, published_phases(4).problems
    motion, grasp = door_motion(), SHELF_GRASPS["ordinary"]
    for phases in (first, second):
        reach_handle, reach_can, carry = (phases[phase] for phase in PAPER_PHASES)
        np.testing.assert_array_equal(reach_handle.goals, motion[:1])
        np.testing.assert_array_equal(reach_can.start, motion[-1])
        np.testing.assert_array_equal(reach_can.goals, [grasp])
        np.testing.assert_array_equal(carry.start, grasp)
        assert "can" not in [item.name for item in carry.scene.objects]
        for problem in phases.values():
            for _, q in problem.labelled_configurations():
                assert not problem.collision_checker().in_collision(q)
    assert not np.array_equal(first["reach-handle"].start, second["reach-handle"].start)
    # origin (0.3103, -0.3955) in the published code
    target = first["carry"].goal_region.T0_w[:3, 3]
    np.testing.assert_allclose(target, (0.3103, -0.3955, 0.271), atol=1e-4)


def test_the_replayed_motion_holds_the_bar_until_the_door_is_open():
    motion, robot = door_motion(), published_phases(3).problems["carry"].robot
    assert np.abs(np.diff(motion, axis=0)).max() < 0.1
    angles = np.linspace(0.0, DOOR_OPEN_RAD, len(motion))
    for q, angle in zip(motion, angles, strict=True):
        grip = handle_region(turn=0.0).at(bar_pose(angle))
        off = displacements(robot, grip, q[None])[:, :6]
        np.testing.assert_allclose(off, 0.0, atol=1e-5)
    assert min(distance_from_limits(q, robot) for q in motion[[0, -1]]) >= ORDINARY_RAD


@pytest.mark.parametrize(("published", "step"), [(True, 0.1304), (False, OMPL_STEP_RAD)])
def test_motions_without_a_constraint_are_those_of_the_published_code(published, step):
    problem = published_phases(3).problems["reach-can"]
    if not published:
        fields = ("name", "robot", "scene", "start", "goals")
        problem = PlanningProblem(**{key: getattr(problem, key) for key in fields})
    assert isinstance(problem, PublishedProblem) is published
    space = ConstrainedSpace.of(problem)
    rng = np.random.default_rng(0)
    query = Query.of(space, problem.start, problem.goals, Budget(iterations=10), rng, 0)
    run = _Run(OmplSearch("projected"), query, None)
    assert run._states.getLongestValidSegmentLength() == pytest.approx(step, abs=1e-4)
    assert (run._planner.getRange() > 13.0) is published


def test_a_start_is_drawn_for_each_environment_away_from_the_limits():
    starts = [published_problem(number).start for number in range(6400, 6430)]
    robot = published_problem(6400).robot
    assert len({tuple(start) for start in starts}) == 30
    assert min(distance_from_limits(start, robot) for start in starts) >= ORDINARY_RAD
    fixed = {grasp: published_problem(6400, grasp).start for grasp in SHELF_GRASPS}
    assert distance_from_limits(fixed["ordinary"], robot) > ORDINARY_RAD
    assert distance_from_limits(fixed["at-limit"], robot) < 1e-3
    for grasp, start in fixed.items():
        suite = SUITES[f"place-task-published-{grasp}"]
        for number in suite.problems[:2]:
            np.testing.assert_array_equal(suite.item(number).start, start)


def test_searches_in_scanned_scenes_have_the_reach_of_the_suite():
    def reach(planner, suite="sensor-ompl", **options):
        run = Experiment(suite, (500,), (planner,), (0,), Budget(cost=1.0), **options).runs[0]
        search = run.method.stages(published_problem(6400)).search
        return getattr(search, "reach", None)

    for planner in ("ompl-projected", "atlas-rrt", "tb-rrt", "ompl-uniform", "ompl-cvq"):
        assert reach(planner) == np.inf
    assert reach("ompl-projected", "sensor-ompl-short") is None
    assert reach("ompl-projected", reach=1.5) == 1.5
    assert reach("ompl-mpnet") is None  # its motions have no longest length anyway
    settings = [
        Experiment(suite, (500,), ("ompl-projected",), (0,), Budget(cost=1.0)).settings()
        for suite in ("sensor-ompl", "sensor-ompl-short")
    ]
    assert [one.get("reach_rad") for one in settings] == ["inf", None]


def test_a_task_of_several_problems_is_no_problem_to_plan():
    told = "task 3000 of multi-sequence-published is 3 problems; .* cvqmpt problems export"
    refused(told, SUITES[SUITE].solvable, 3000)
