"""Tasks of several phases: one planned whole, its rows and table, json, and everything that must be refused."""

import json
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread
from PIL import Image
from rerun.chunk import RrdReader

from cli.main import main
from cvqmpt_lab.certificate import certify
from cvqmpt_lab.constraints.task_space_region import TaskSpaceRegion
from cvqmpt_lab.errors import InvalidInputError, UnknownChoiceError
from cvqmpt_lab.methods.method import Method
from cvqmpt_lab.methods.table import PLANNERS
from cvqmpt_lab.planning.birrt import BiRRT
from cvqmpt_lab.planning.result import Budget, Counters, PlanResult, PlanStatus
from cvqmpt_lab.poses import pose
from cvqmpt_lab.results.phase_name import split_problem
from cvqmpt_lab.results.row import ResultRow
from cvqmpt_lab.robot.loading import FINGER_OPENING
from cvqmpt_lab.scene.scene import SceneObject
from cvqmpt_lab.scene.shapes import Box
from cvqmpt_lab.show import task_film
from cvqmpt_lab.show import task_recording as task_viewer
from cvqmpt_lab.show.labels import Label, Strip
from cvqmpt_lab.show.task_film import film_task
from cvqmpt_lab.show.task_still import NAME_LETTERS, draw_task
from cvqmpt_lab.tasks.phases import Grasp, Release
from cvqmpt_lab.tasks.solve_task import solve_task
from cvqmpt_lab.tasks.task import Task
from cvqmpt_lab.tasks.world import World
from experiments.rows import Run, phase_rows
from experiments.suites.door_task import OPEN
from experiments.suites.multi_sequence import CAN_NAME, TARGET, TARGET_SIDE, multi_sequence_task, world
from experiments.suites.place_task import DOOR, carried_can
from paper_tables.multi_sequence_render import render_multi_sequence
from paper_tables.multi_sequence_summary import build_phases_table, task_rows, time_metric
from paper_tables.paper_numbers import read_published

BUDGET = Budget(seconds=20.0)
RUN = Run("multi-sequence", 0, "birrt", 0, BUDGET)
PHASES = ["reach-handle", "open-door", "reach-can", "approach", "carry"]


@pytest.fixture(scope="module")
def task():
    return multi_sequence_task(0)


@pytest.fixture(scope="module")
def solution(task):
    return solve_task(task, "birrt", BUDGET, seed=0)


@pytest.fixture(scope="module")
def rows(solution):
    return phase_rows(RUN, solution)


def changed(task, which, **fields):
    """The task with fields of one phase changed."""
    assert which in [phase.name for phase in task.phases]
    return replace(task, phases=tuple(replace(p, **fields) if p.name == which else p for p in task.phases))


def without(task, name):
    return replace(task, phases=tuple(phase for phase in task.phases if phase.name != name))


def test_a_whole_task_is_solved_and_every_phase_certified(solution):
    assert solution.solved and solution.failure == ""
    assert [outcome.phase.name for outcome in solution.outcomes] == PHASES
    for outcome in solution.outcomes:
        path = outcome.solution.simplified.path
        assert certify(outcome.solution.problem, path).valid
        motion = outcome.trajectory
        np.testing.assert_allclose(motion.velocities[[0, -1]], 0.0, atol=1e-12)
        np.testing.assert_allclose(motion.positions[[0, -1]], path.states[[0, -1]], atol=1e-9)


def test_phases_follow_each_other(solution):
    """Each begins where the last ended; the door turned, the can stands upright where it was to be put."""
    for before, after in zip(solution.outcomes, solution.outcomes[1:], strict=False):
        end = before.solution.simplified.path.states[-1]
        np.testing.assert_array_equal(after.solution.problem.start[:7], end[:7])
    end = solution.world
    assert end.scene.articulation(DOOR).value == pytest.approx(OPEN, abs=1e-4)
    assert end.held is None and end.source["finger_opening"] == FINGER_OPENING
    T = end.scene[CAN_NAME].T_world_object
    goal = solution.task.phases[7].goal.T0_w[:3, 3]
    np.testing.assert_allclose(T[:2, 3], goal[:2], atol=2e-3)
    assert T[2, 2] > np.cos(0.01)


def test_the_can_is_in_the_way_until_it_is_grasped(solution):
    problems = {outcome.phase.name: outcome.solution.problem for outcome in solution.outcomes}
    for name in ("reach-handle", "open-door", "reach-can", "approach"):
        assert problems[name].scene[CAN_NAME].obstacle and not problems[name].attachments
    assert CAN_NAME not in problems["carry"].scene
    assert [item.name for item in problems["carry"].attachments] == ["carried_can"]
    assert problems["open-door"].robot.dof == 8


def test_same_seed_same_motion(task, solution):
    again = solve_task(task, "birrt", BUDGET, seed=0)
    for a, b in zip(again.outcomes, solution.outcomes, strict=True):
        np.testing.assert_array_equal(a.solution.simplified.path.states, b.solution.simplified.path.states)


def test_tasks_differ_and_are_drawn_within_the_stated_square():
    tasks = [multi_sequence_task(k) for k in range(4)]
    starts = {tuple(task.start) for task in tasks}
    targets = np.array([task.phases[7].goal.T0_w[:3, 3] for task in tasks])
    assert len(starts) == 4 and len({tuple(target) for target in targets}) == 4
    assert (np.array(TARGET)[:2] <= targets[:, :2]).all()
    assert (targets[:, :2] <= np.array(TARGET)[:2] + TARGET_SIDE).all()
    np.testing.assert_array_equal(tasks[1].start, multi_sequence_task(1).start)


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


def test_a_goal_out_of_reach_names_phase_and_cause(task):
    far = TaskSpaceRegion(pose((3.0, 0.0, 0.5)), np.eye(4), np.zeros((6, 2)))
    solution = solve_task(changed(task, "carry", goal=far), "birrt", BUDGET, seed=0)
    assert not solution.solved
    assert solution.failure.startswith("phase 'carry': no goal: of 100 poses, 100 without inverse kinematics")
    rows = phase_rows(RUN, solution)
    assert [row.solved for row in rows] == [True] * 4 + [False]
    assert rows[-1].fail_reason == "no_goal" and "inverse kinematics" in rows[-1].detail


def test_phases_after_a_failed_one_are_failures_too(task):
    wall = SceneObject("wall", Box((0.3, 0.3, 0.3)), pose((0.34, -0.485, 0.757)))
    solution = solve_task(replace(task, scene=world().with_objects(wall)), "birrt", BUDGET, seed=0)
    rows = phase_rows(RUN, solution)
    assert [row.fail_reason for row in rows] == ["no_goal"] + ["not_reached"] * 4
    assert all("phase 'reach-handle'" in row.detail for row in rows[1:])
    (total,) = task_rows(rows)
    assert total.fail_reason == "no_goal" and total.detail.startswith("reach-handle: no goal")


def test_json_round_trip(task, tmp_path):
    task.save(tmp_path / "task.json")
    again = Task.load(tmp_path / "task.json")
    assert again.to_dict() == task.to_dict()
    assert [type(phase) for phase in again.phases] == [type(phase) for phase in task.phases]


@pytest.mark.parametrize(
    ("name", "field", "message"),
    [
        ("carry", "goal", r"phases\[7\].goal is missing"),
        ("open-door", "constraint", r"phases\[2\].constraint is missing"),
        ("approach", "distance", r"phases\[5\].distance is missing"),
        ("carry", "kind", r"phases\[7\].kind is missing; one of move, slide, turn"),
    ],
)
def test_missing_fields_are_named(task, tmp_path, name, field, message):
    data = task.to_dict()
    phase = next(item for item in data["phases"] if item["name"] == name)
    del phase[field]
    file = tmp_path / "task.json"
    file.write_text(json.dumps(data))
    with pytest.raises(InvalidInputError, match=message) as error:
        Task.load(file)
    assert str(file) in str(error.value)


def test_malformed_values_are_named(task):
    data = task.to_dict()
    data["phases"][5]["distance"] = "far"
    with pytest.raises(InvalidInputError, match=r"phases\[5\].distance is 'far'"):
        Task.from_dict(data)
    data = task.to_dict()
    data["start"] = [0.0] * 6
    with pytest.raises(InvalidInputError, match=r"start has shape \(6,\), robot panda needs \(7,\)"):
        Task.from_dict(data)


def test_unknown_fields_and_kinds_are_refused(task):
    data = task.to_dict()
    data["phases"][7]["constraints"] = data["phases"][7].pop("constraint")
    with pytest.raises(
        InvalidInputError, match=r"phases\[7\].constraints is unknown; did you mean 'constraint'"
    ):
        Task.from_dict(data)
    data = task.to_dict()
    data["phases"][7]["kind"] = []
    with pytest.raises(
        UnknownChoiceError, match=r"unknown phases\[7\].kind \[\]; valid choices: move, slide"
    ):
        Task.from_dict(data)


def test_task_files_of_before_still_load(tmp_path):
    path = Path(__file__).parents[1] / "data" / "task-1.json"
    old, task = json.loads(path.read_text()), Task.load(path)
    assert [phase["name"] for phase in old["phases"]] == [phase.name for phase in task.phases]
    assert (
        task.start.tolist() == old["start"]
        and task.phases[0].goal.Bw.tolist() == old["phases"][0]["goal"]["Bw"]
    )
    task.save(tmp_path / "now.json")
    assert Task.load(tmp_path / "now.json") == task


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda task: without(task, "let-go"), "'reach-can': the hand holds 'dagger_door_left'"),
        (lambda task: without(task, "hold-handle"), "'open-door': the hand holds no door or drawer"),
        (lambda task: without(task, "grasp-can"), "'put-down': the gripper holds nothing to release"),
        (
            lambda task: changed(task, "grasp-can", object="cup"),
            "'grasp-can': unknown object .*'cup'",
        ),
        (
            lambda task: changed(task, "hold-handle", articulation="lid"),
            "'hold-handle': unknown articulation",
        ),
        (lambda task: changed(task, "open-door", value=-2.0), "'open-door': value -2.0 of hinge .* outside"),
        (lambda task: changed(task, "put-down", name="carry"), "'carry' occurs twice"),
        (lambda task: replace(task, phases=(Release("r", {}),)), "plans nothing"),
        (
            lambda task: replace(
                task,
                phases=(
                    *task.phases[:7],
                    Grasp("again", "mustard_bottle", {}, carried_can()),
                    *task.phases[7:],
                ),
            ),
            "'again': the gripper already holds 'can'",
        ),
    ],
)
def test_phases_that_cannot_follow_are_refused(task, spoil, message):
    with pytest.raises(InvalidInputError, match=message):
        spoil(task)


def test_a_hand_that_closes_where_nothing_is(task):
    start = World.before(task)
    with pytest.raises(
        InvalidInputError, match=r"phase 'grasp-can': 'can' is .* m from where the hand closes"
    ):
        start.after(next(phase for phase in task.phases if isinstance(phase, Grasp)))


def test_methods_that_cannot_serve_a_phase_say_why(solution):
    problems = {outcome.phase.name: outcome.solution.problem for outcome in solution.outcomes}
    for name in ("ompl-projected", "atlas-rrt", "tb-rrt"):
        method = PLANNERS[name]
        assert method.unfit(problems["carry"]) == method.unfit(problems["open-door"]) == ""
        assert "needs a constraint" in method.unfit(problems["reach-can"])
    for name in ("mpnet", "cvq-mpt", "opt-cvq-mpt", "roadmap-cvq"):
        assert PLANNERS[name].unfit(problems["carry"]) == PLANNERS[name].unfit(problems["reach-can"]) == ""
        assert "weights are for" in PLANNERS[name].unfit(problems["open-door"])
    assert all(PLANNERS["birrt"].unfit(problem) == "" for problem in problems.values())


def test_rows_name_their_phases(rows):
    assert [split_problem(row.problem) for row in rows] == [
        ("0", k, name) for k, name in enumerate(PHASES, 1)
    ]
    assert all(row.solved and row.execution_time_s > 0 for row in rows)
    with pytest.raises(InvalidInputError, match="no phase of a task"):
        split_problem("17")


def made_up(planner, task, planning, execution, solved=True):
    """Rows of one run whose times are known."""
    return [
        ResultRow(
            suite="multi-sequence",
            problem=f"{task}/{k}-{name}",
            planner=planner,
            seed=0,
            backend="compiled",
            fail_reason=None if solved else "timeout" if k == 1 else "not_reached",
            solved=solved,
            certified=solved or None,
            t_total_s=planning,
            execution_time_s=execution if solved else None,
        )
        for k, name in enumerate(PHASES, 1)
    ]


def test_the_table_sums_the_papers_phases_and_judges_its_statements():
    rows = []
    for task in range(6):
        rows += made_up("opt-cvq-mpt", task, 0.5, 9.0)
        rows += made_up("ompl-projected", task, 1.0 + 0.01 * task, 10.0 + 0.1 * task)
    rows += made_up("ompl-projected", 7, 1.0, 10.0, solved=False)
    published = read_published("multi_sequence.csv", "Multi-sequence task")
    table = build_phases_table(rows, published)
    planners = {planner.name: planner for planner in table.planners}
    assert list(planners) == ["ompl-projected", "opt-cvq-mpt"]  # those that were run, in the paper's order
    ours = planners["opt-cvq-mpt"].measured
    assert ours[time_metric("planning_time", "paper", "mean")].estimate == pytest.approx(1.5)
    assert ours[time_metric("total_time", "all", "mean")].estimate == pytest.approx(5 * 9.5)
    theirs = planners["ompl-projected"]
    assert (theirs.n_runs, theirs.measured["solved"].estimate) == (7, pytest.approx(600 / 7))
    assert [(count.what, count.runs) for count in theirs.failures] == [("reach-handle: timeout", 1)]
    verdicts = {(v.statement.metric, v.baseline): v for v in table.verdicts}
    planning = verdicts["planning_time", "ompl-projected"]
    assert planning.paper == pytest.approx(1 - 10.98 / 19.71) and planning.ours.n == 6
    assert planning.ours.estimate == pytest.approx(0.51, abs=0.01) and planning.verdict.startswith(
        "confirmed"
    )
    assert verdicts["execution_time", "ompl-projected"].verdict == "less than stated"
    assert ("execution_time", "atlas-rrt") not in verdicts
    made = render_multi_sequence(rows, published)
    assert "| 19.71" in made.markdown and r"\toprule" in made.latex and max(map(len, made.brief)) <= 100
    assert f"{time_metric('planning_time', 'paper', 'mean')},s,opt-cvq-mpt,ours,1.5,1.5,1.5,6" in made.csv


def test_a_verdict_needs_tasks_that_both_solved():
    rows = made_up("opt-cvq-mpt", 0, 0.5, 9.0) + made_up("tb-rrt", 1, 1.0, 10.0)
    verdicts = build_phases_table(rows, ()).verdicts
    assert len(verdicts) == 2 and all(item.verdict.startswith("not judged") for item in verdicts)


def test_fallbacks_are_counted_by_phase_and_by_task():
    rows = made_up("cvq-mpt", 0, 0.5, 9.0) + made_up("cvq-mpt", 1, 0.5, 9.0)
    rows = [
        replace(row, fallback="no weights for a door: birrt") if "door" in row.problem else row
        for row in rows
    ]
    (planner,) = build_phases_table(rows, ()).planners
    assert [(count.what, count.runs) for count in planner.fallbacks] == [("open-door", 2)]
    assert (planner.n_fallen_back, planner.n_runs) == (2, 2)


def test_pictures_and_recording(solution, tmp_path, monkeypatch):
    monkeypatch.setattr(task_viewer, "PERIOD", 1.0)
    monkeypatch.setattr(task_film, "FRAMES", 8)
    names = draw_task(solution, tmp_path / "task.png", size=(60, 40))
    assert names == ["start", *PHASES]
    height = 40 + Strip([Label("1  start")], 60, NAME_LETTERS).height
    assert imread(tmp_path / "task.png").shape[:2] == (2 * height + 6, 3 * 60 + 2 * 6)
    film_task(solution, tmp_path / "task.gif", size=(60, 40))
    with Image.open(tmp_path / "task.gif") as film:
        assert film.n_frames > len(PHASES)
    task_viewer.log_task(solution, tmp_path / "task.rrd")
    moments: dict[str, int] = {}
    for chunk in RrdReader(tmp_path / "task.rrd").stream():
        if task_viewer.TIMELINE in chunk.timeline_names:
            moments[chunk.entity_path] = moments.get(chunk.entity_path, 0) + chunk.num_rows
    assert moments.pop("/phase") == len(solution.task.phases)
    assert f"/world/moving/{CAN_NAME}" in moments and f"/world/moving/{DOOR}/handle_bar" in moments
    assert "/world/robot/panda_leftfinger_0" in moments and "/world/moving/mustard_bottle" not in moments
    duration = sum(outcome.trajectory.duration for outcome in solution.outcomes)
    assert set(moments.values()) == {len(list(task_viewer.frames(solution)))}
    assert min(moments.values()) > duration / task_viewer.PERIOD


def test_command_line(task, tmp_path, capsys):
    task.save(tmp_path / "task.json")
    assert main(["plan", "--task-file", str(tmp_path / "task.json")]) == 0
    out = capsys.readouterr().out
    assert all(name in out for name in PHASES) and "solved" in out
    assert main(["plan", "place-task", "--task-file", str(tmp_path / "task.json")]) == 2
    assert "--task-file, one of the three" in capsys.readouterr().err
    assert main(["plan", "--task-file", str(tmp_path / "task.json"), "--json"]) == 2
    assert "--json does not go with a task" in capsys.readouterr().err
    assert main(["problems", "export", "multi-sequence", "--problems", "1", "--out", str(tmp_path)]) == 0
    assert Task.load(tmp_path / "multi-sequence-000.json").to_dict() == multi_sequence_task(0).to_dict()


@pytest.mark.slow
def test_reproduce_continues_where_it_was(tmp_path, capsys):
    command = ["reproduce", "multi-sequence", "--problems", "1", "--planners", "birrt", "--jobs", "1"]
    command += ["--out", str(tmp_path)]
    assert main(command) == 0
    first = (tmp_path / "runs.csv").read_bytes()
    assert main(command) == 0
    assert (tmp_path / "runs.csv").read_bytes() == first
    assert "By phase" in (tmp_path / "table.md").read_text()
    assert len(capsys.readouterr().out.splitlines()) <= 15
