"""Tasks: refused sequences of phases; whole tasks planned, with every phase certified."""

import json
import time
from dataclasses import replace

import numpy as np
import pytest
from refusals import refused

from cvqmpt_lab.base.poses import pose
from cvqmpt_lab.benchmarks.place_task import carried_can
from cvqmpt_lab.benchmarks.published import planned_door_task
from cvqmpt_lab.benchmarks.results.row import PAPER_PHASES
from cvqmpt_lab.certificate.certificate import FaultKind, certify
from cvqmpt_lab.constraints.task_space_region import TaskSpaceRegion
from cvqmpt_lab.experiments.experiment import Experiment
from cvqmpt_lab.experiments.run import phase_rows
from cvqmpt_lab.features.tasks.solve import solve_task, task_report
from cvqmpt_lab.features.tasks.task import Grasp, Move, Release, Task
from cvqmpt_lab.features.tasks.world import World, phase_goals
from cvqmpt_lab.scene.scene import SceneObject
from cvqmpt_lab.scene.shapes import Box, Cylinder, OccupancyMap, Sphere
from cvqmpt_lab.search.birrt import BiRRT
from cvqmpt_lab.search.method import Method
from cvqmpt_lab.search.planner_interface import Stages
from cvqmpt_lab.search.result import Budget, Counters, PlanResult, PlanStatus


def changed(task, which, **fields):
    """Return the task with changed fields of one phase."""
    assert which in [phase.name for phase in task.phases]
    phases = (replace(p, **fields) if p.name == which else p for p in task.phases)
    return replace(task, phases=tuple(phases))


def without(task, name):
    return replace(task, phases=tuple(phase for phase in task.phases if phase.name != name))


def grasping(task, shape):
    """Return the task with a grasp that gives an attachment of a shape."""
    return changed(task, "grasp-can", attachment=replace(carried_can(), shape=shape))


def grasping_a_map(task):
    cells = replace(task.scene["can"], name="map", shape=OccupancyMap(np.zeros((1, 3))))
    return changed(replace(task, scene=task.scene.with_objects(cells)), "grasp-can", object="map")


def grasping_twice(task):
    again = Grasp("again", "mustard_bottle", {})
    return replace(task, phases=(*task.phases[:7], again, *task.phases[7:]))


SPOILT = {
    "'reach-can': the hand holds 'dagger_door_left'": lambda task: without(task, "let-go"),
    "'open-door': the hand holds no door or dr": lambda task: without(task, "hold-handle"),
    "'put-down': the gripper holds nothing to rel": lambda task: without(task, "grasp-can"),
    "'grasp-can': unknown object .*'cup'": lambda t: changed(t, "grasp-can", object="cup"),
    "'grasp-can': type .* is 'Sphere'.*'Cylinder'": lambda task: grasping(task, Sphere(1e-3)),
    "height .* is 0.2, that of 'can' .* 0.2": lambda t: grasping(t, Cylinder(0.0373, 0.2)),
    "'grasp-can': attachment 'map' is an occupancy map; give a solid or a": grasping_a_map,
    "unknown articulation": lambda task: changed(task, "hold-handle", articulation="lid"),
    "'open-door': value -2.0 of hinge .* outside": lambda t: changed(t, "open-door", value=-2.0),
    "'carry' occurs twice": lambda task: changed(task, "put-down", name="carry"),
    "plans nothing": lambda task: replace(task, phases=(Release("r", {}),)),
    "'again': the gripper already holds 'can'": grasping_twice,
}


@pytest.mark.parametrize("message", SPOILT)
def test_phases_that_cannot_follow_are_refused(task, message):
    refused(message, SPOILT[message], task)


def test_a_grasp_far_from_its_object_is_refused(task):
    grasp = next(phase for phase in task.phases if isinstance(phase, Grasp))
    told = "'grasp-can': 'can' is more than 0.02 m from the arm"
    refused(told, World.before(task).after, grasp)


QUARTER_ABOUT_X = np.array([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1.0]])


@pytest.mark.parametrize(
    ("T_written", "told"),
    [
        (pose((0.0, 0.0, 0.019)), ""),
        (pose((0.0, 0.0, 0.0), 1.5), ""),  # about the can's own axis
        (pose((0.0, 0.0, 0.021)), "'can' is 0.021 m and 0.00 rad from where the hand closes"),
        (QUARTER_ABOUT_X, "'can' is 0.000 m and 1.57 rad"),
    ],
)
def test_the_carried_object_has_its_pose_in_the_scene_not_the_expected_one(
    task_solution, T_written, told
):
    carrying = task_solution.outcomes[-1].world
    can, item = carrying.held.attachment, carrying.held.item
    before = replace(carrying, held=None, scene=carrying.scene.with_objects(item))
    written = replace(can, T_hand_object=can.T_hand_object @ T_written)
    phase = Grasp("grasp-can", "can", {}, written)
    if told:
        refused(told, before.after, phase)
        return
    held = before.after(phase).held.attachment
    T_world_held = before.arm.pose(before.q) @ held.T_hand_object
    np.testing.assert_allclose(T_world_held, item.T_world_object, atol=1e-12)
    assert held == can and held.shape == item.shape


@pytest.mark.parametrize(
    ("in_scene", "in_grasp", "carried"), [(2.0, None, 2.0), (2.0, 3.0, 2.0), (None, 3.0, 3.0)]
)
def test_the_mass_of_a_grasped_object_counts(task_solution, in_scene, in_grasp, carried):
    world = task_solution.outcomes[-1].world
    can, item = world.held.attachment, world.held.item
    scene = world.scene.with_objects(replace(item, mass=in_scene))
    before = replace(world, held=None, scene=scene)
    grasp = Grasp("grasp-can", "can", {}, replace(can, mass=in_grasp))
    assert before.after(grasp).held.attachment.mass == carried


def test_a_task_whose_object_is_too_heavy_is_not_solved(task):
    (can,) = (item for item in task.scene.objects if item.name == "can")
    others = task.scene.without("can")
    heavy = replace(task, scene=others.with_objects(replace(can, mass=30.0)))
    found = solve_task(heavy, "birrt", Budget(iterations=20_000), 0)
    assert not found.solved
    assert "'carry': not timed: joint 'panda_joint" in found.failure
    assert "Nm to stand still: carry less" in found.failure


def test_a_carried_can_hits_a_board_that_one_5_mm_shorter_does_not(task_solution):
    solution, item = task_solution.outcomes[-1].solution, task_solution.outcomes[-1].world.held.item
    top = item.T_world_object[2, 3] - item.shape.height / 2 + 0.0025
    below = pose((*item.T_world_object[:2, 3], top - 0.05))
    board = SceneObject("board", Box((0.05, 0.05, 0.1)), below)
    problem = replace(solution.problem, scene=solution.problem.scene.with_objects(board))
    (fault,) = certify(problem, solution.path).faults
    assert fault.kind is FaultKind.COLLISION and "can and board" in fault.text


BUDGET = Budget(seconds=20.0)
RUN = Experiment("multi-sequence", (0,), ("birrt",), (0,), BUDGET).runs[0]
PHASES = ["reach-handle", "open-door", "reach-can", "approach", "carry"]


def test_a_whole_task_is_solved_and_every_phase_certified(task_solution):
    assert task_solution.solved and task_solution.failure == ""
    assert [outcome.phase.name for outcome in task_solution.outcomes] == PHASES
    for outcome in task_solution.outcomes:
        path = outcome.solution.path
        assert certify(outcome.solution.problem, path).valid
        motion = outcome.trajectory
        np.testing.assert_allclose(motion.velocities[[0, -1]], 0.0, atol=1e-12)
        np.testing.assert_allclose(motion.positions[[0, -1]], path.states[[0, -1]], atol=1e-9)


class FailsOnce:
    """`birrt`, except that its first run for a named phase takes 0.5 s and finds no path."""

    def __init__(self, phase):
        self.phase, self.failed, self.problem = phase, False, ""

    def build(self, problem, model):
        self.problem = problem.name
        return Stages(search=self)

    def search(self, query, distribution):
        if self.problem.endswith(self.phase) and not self.failed:
            self.failed = True
            time.sleep(0.5)
            return PlanResult(PlanStatus.TIMEOUT, None, 0.5, Counters(), 0, "none")
        return BiRRT().search(query, distribution)


def test_another_grasp_is_tried_when_a_later_phase_fails(task):
    solution = solve_task(task, Method("birrt", FailsOnce("carry").build), BUDGET, seed=1)
    assert solution.solved
    approach = next(outcome for outcome in solution.outcomes if outcome.phase.name == "approach")
    assert len(approach.attempts) == 2
    first, second = (item.path.states[-1] for item in approach.attempts)
    assert np.abs(first - second).max() > 1e-6
    rows = phase_rows(RUN, solution)
    row = next(row for row in rows if row.problem.endswith("approach"))
    assert rows[-1].solved and rows[-1].t_plan_s > 0.5  # the time of failed runs counts too
    assert row.n_state_checks == sum(item.plan.counters.state_checks for item in approach.attempts)


class SlidesOnlyWithASecond:
    """`birrt`, except that slides fail with a budget below one second, or below `fewest`."""

    def __init__(self, fewest=1.0):
        self.given, self.problem, self.fewest = [], "", fewest

    def build(self, problem, model):
        self.problem = problem.name
        return Stages(search=self)

    def search(self, query, distribution):
        if self.problem.endswith("approach"):
            seconds = query.deadline.budget.seconds
            self.given.append((round(seconds), tuple(query.start)))
            if seconds < self.fewest:
                return PlanResult(PlanStatus.TIMEOUT, None, 0.0, Counters(), 0, "none")
        return BiRRT().search(query, distribution)


def test_a_slide_gets_little_time_until_all_grasps_have_failed(task):
    search = SlidesOnlyWithASecond()
    solution = solve_task(task, Method("birrt", search.build), Budget(seconds=2.0), seed=0)
    assert solution.solved
    seconds = [given for given, _ in search.given]
    assert seconds == sorted(seconds) and set(seconds) == {0, 2}
    assert len({start for given, start in search.given if given == 0}) > 1


def test_a_goal_out_of_reach_names_phase_and_cause(task):
    far = TaskSpaceRegion(pose((3.0, 0.0, 0.5)), np.eye(4), np.zeros((6, 2)))
    phases = tuple(replace(p, goal=far) if p.name == "carry" else p for p in task.phases)
    search = SlidesOnlyWithASecond(fewest=0.0)
    method = Method("birrt", search.build)
    solution = solve_task(replace(task, phases=phases), method, BUDGET, seed=0)
    assert not solution.solved
    assert {seconds for seconds, _ in search.given} == {0}  # more time would find no goal either
    told = "phase 'carry': no goal: of 100 poses, 100 without inverse kinematics"
    assert solution.failure.startswith(told)
    rows = phase_rows(RUN, solution)
    assert [row.solved for row in rows] == [True] * 4 + [False]
    assert rows[-1].fail_reason == "no_goal" and "inverse kinematics" in rows[-1].detail


def test_a_move_to_a_configuration_ends_there(task):
    """The published task reaches the handle and the can in the same configurations every time."""
    first, second = planned_door_task(3), planned_door_task(4)
    ends = {phase.name: phase.configuration for phase in first.phases if isinstance(phase, Move)}
    assert list(ends) == list(PAPER_PHASES) and ends["carry"] is None
    for phase in second.planned:
        if isinstance(phase[1], Move) and phase[1].name != "carry":
            np.testing.assert_array_equal(phase[1].configuration, ends[phase[1].name])
    assert not np.array_equal(first.start, second.start)
    # origin (0.3103, -0.3955) in the published code
    target = first.phases[-2].goal.T0_w[:2, 3]
    np.testing.assert_allclose(target, (0.3103, -0.3955), atol=1e-4)
    reached, reason = phase_goals(first, 0, World.before(first))
    assert not reason
    np.testing.assert_array_equal(reached, ends["reach-handle"][None])


@pytest.mark.parametrize(
    ("q", "told"),
    [(np.zeros(6), r"'reach-can': configuration has shape \(6,\)"), (np.full(7, 9.0), "by ")],
)
def test_a_configuration_that_the_arm_cannot_take_is_refused(task, q, told):
    refused(told, changed, task, "reach-can", configuration=q)


@pytest.mark.parametrize("where", ["goal", "constraint", "through"])
def test_an_unknown_frame_of_a_region_names_file_and_phase(task, tmp_path, where):
    """The message named neither, and came when the phase was planned."""
    data, path = task.to_dict(), tmp_path / "task.json"
    phase = data["phases"][4]
    region = {**phase["goal"], "end_effector": "nohand"}
    phase[where] = region if where == "goal" else [region]
    path.write_text(json.dumps(data))
    refused(f"{path}: .*phase 4 'reach-can': unknown .*'nohand'", Task.load, path)


def test_the_report_states_the_margin_that_each_phase_keeps(task_solution):
    first, *others = task_solution.outcomes
    less = "0.9 mm, 0.005 rad of 50 mm, 0.005 rad: the start is 0.9 mm from can and shelf"
    shown = replace(task_solution, outcomes=(replace(first, margin=less), *others))
    line = next(
        line for line in task_report(shown, "birrt", 1.0).lines if line.startswith("reach-handle")
    )
    assert line.endswith(f"of the limits, margin {less}")
