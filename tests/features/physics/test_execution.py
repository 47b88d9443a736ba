"""Motions and tasks in simulation: the model equals the robot's, and faults are found."""

import json
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from command_line import SCAN_START
from command_line import refused as command_refused
from refusals import refused
from small_arms import box, joint

from cvqmpt_lab.base.poses import pose
from cvqmpt_lab.benchmarks.results.row import RUNS_FILE, FailReason, read_rows
from cvqmpt_lab.benchmarks.suite import suite_named
from cvqmpt_lab.collision.exact import CollisionChecker
from cvqmpt_lab.experiments import executed
from cvqmpt_lab.experiments.experiment import Experiment
from cvqmpt_lab.experiments.run import executor_for, failed_rows, outcome_of, run_experiment
from cvqmpt_lab.features.motion.motion_check import certified_motion
from cvqmpt_lab.features.motion.trajectory import save_trajectory
from cvqmpt_lab.features.physics import execute
from cvqmpt_lab.features.physics.execute import Outcome, agreed, execute_motion, execute_task
from cvqmpt_lab.features.physics.mjcf import ARMATURE, HAND_SITE, Physics, mjcf_of
from cvqmpt_lab.features.physics.simulation import Controller, Simulation
from cvqmpt_lab.features.plan import Request, plan
from cvqmpt_lab.features.tasks.task import Release
from cvqmpt_lab.paper_tables.committed import RESULTS
from cvqmpt_lab.robot.load import load_robot, robot_from_source, with_gripper
from cvqmpt_lab.robot.robot import Follower
from cvqmpt_lab.scene.cells import map_of_points
from cvqmpt_lab.scene.scene import Scene, SceneObject
from cvqmpt_lab.scene.shapes import Box, OccupancyMap, PointCloud
from cvqmpt_lab.search.result import Budget, JointPath

mujoco = pytest.importorskip("mujoco")
FINGERS = {
    "panda_finger_joint1": None,
    "panda_finger_joint2": Follower("panda_finger_joint2", "panda_finger_joint1", 1.0, 0.0),
}


@pytest.fixture(scope="module")
def carrying():
    """A problem in which the arm carries the can, and a certified motion half of the way."""
    problem = suite_named("place-task-with-can").solvable(3)
    found = plan(problem, Request("birrt", Budget(iterations=40_000))).solution
    states = found.path.states[: len(found.path.states) // 2]
    problem = found.problem.changed(goals=states[-1:], goal_region=None)
    return problem, certified_motion(problem, JointPath(states))


@pytest.fixture(scope="module")
def known(carrying):
    """The motion, executed by a controller that knows the load."""
    return execute_motion(*carrying, "computed-torque")


@pytest.mark.parametrize("name", ["panda", "ur5", "xarm7"])
def test_the_simulated_arm_has_the_kinematics_and_inertia_of_the_robot(name):
    robot = robot_from_source({"name": name})
    model = mujoco.MjModel.from_xml_string(mjcf_of(robot, Scene("none", ()), Physics(0.004)))
    data, M = mujoco.MjData(model), np.zeros((robot.dof, robot.dof))
    for q in robot.random_configurations(np.random.default_rng(0), 20):
        data.qpos[:] = q
        mujoco.mj_forward(model, data)
        T = robot.pose(q)
        assert np.allclose(data.site(HAND_SITE).xpos, T[:3, 3], atol=1e-9)
        assert np.allclose(data.site(HAND_SITE).xmat.reshape(3, 3), T[:3, :3], atol=1e-9)
        for row, one in zip(M, np.eye(robot.dof), strict=True):
            mujoco.mj_mulM(model, data, row, one)
        mass = pin.crba(robot.model, robot.model.createData(), q)
        assert np.allclose(M - ARMATURE * np.eye(robot.dof), mass, atol=1e-6)


def test_moving_fingers_have_the_mass_that_they_have_when_held(panda):
    robot = with_gripper(panda)
    text = mjcf_of(robot, Scene("none", ()), Physics(0.004, fingers=FINGERS))
    model = mujoco.MjModel.from_xml_string(text)
    assert robot.dof == 9
    held = sum(body.mass for body in list(panda.model.inertias)[1:])
    assert model.body_mass.sum() == pytest.approx(held, rel=1e-9)


def test_the_known_model_follows_closely_and_an_unknown_load_pulls_it_off(carrying, known):
    unknown = execute_motion(*carrying, "computed-torque-unknown-load")
    assert not known.faults and known.off_path_m < 5e-4 and known.tilt_rad < 0.1
    assert 5e-4 < unknown.off_path_m < 0.01
    assert len(list(known.moments)) > 10


def test_a_box_in_the_way_is_touched_and_named(carrying):
    problem, motion = carrying
    middle = problem.robot.pose(motion.at(0.5 * motion.duration).positions)[:3, 3]
    box = SceneObject("box in the way", Box((0.1, 0.1, 0.1)), pose(middle))
    blocked = replace(problem, scene=problem.scene.with_objects(box))
    found = execute_motion(blocked, motion, "computed-torque")
    assert any("box in the way" in pair for pair in found.pairs)
    assert any("box in the way" in fault for fault in found.faults)


def test_fingers_hold_the_can_and_lose_it_without_force(carrying, monkeypatch):
    held = execute_motion(*carrying, "computed-torque", 0.001, friction=True)
    assert held.drift_m < 0.005
    monkeypatch.setattr(execute, "GRIP_FORCE_N", 0.0)
    lost = execute_motion(*carrying, "computed-torque", 0.001, friction=True)
    assert "the load left the hand" in lost.faults


def test_different_contacts_at_two_contact_times_decide_nothing(known):
    touched = execute.Contact("panda_hand_0", "shelf", 0.001, 1.0)
    other = replace(known, contact_time=0.001, contacts=(touched,))
    outcome, why = agreed([known, other])
    assert outcome == Outcome.UNDECIDED
    assert why == "panda_hand_0 and shelf touch at one of the contact times 4 and 1 ms"
    assert agreed([known, known])[0] == Outcome.EXECUTED


def test_a_task_is_executed_by_contact_alone(task_solution, monkeypatch):
    found = execute_task(task_solution, "computed-torque")
    assert found.placed and not found.faults
    ends = found.samples[-1].doors
    assert ends["dagger_door_left"] < -1.3  # only the fingers can have opened it
    # without contact force the fingers cannot open a door
    monkeypatch.setattr(execute, "GRIP_FORCE_N", 0.0)
    task, kinds = task_solution.task, [type(phase) for phase in task_solution.task.phases]
    opening = task.changed(phases=task.phases[: kinds.index(Release) + 1])
    first = task_solution.outcomes[: len(opening.planned)]
    lost = execute_task(replace(task_solution, task=opening, outcomes=first), "computed-torque")
    assert lost.samples[-1].doors["dagger_door_left"] > -0.5


def test_motions_that_cannot_be_executed_are_refused(carrying, panda, task):
    problem, motion = carrying
    massless = replace(panda, model=panda.model.copy())
    for k in range(1, 8):
        massless.model.inertias[k] = pin.Inertia.Zero()
    refused("cannot be executed: efforts not limited", Controller, "computed-torque", massless)
    weightless = replace(problem, attachments=(replace(problem.attachments[0], mass=None),))
    how = {"controller": "computed-torque", "friction": True}
    refused("has no mass", execute_motion, weightless, motion, **how)
    other = replace(motion, joint_names=tuple("abcdefg"))
    refused("the motion is of joints a, b", execute_motion, problem, other, "computed-torque")


SHELL = np.random.default_rng(4).uniform((0.2, -0.6, 0.0), (0.6, 0.6, 0.9), (1500, 3))
MEASURED = {
    "map": map_of_points(SHELL, 0.05),
    "map with padding": map_of_points(SHELL[:200], 0.05, 0.03),
    "small cloud": PointCloud(SHELL[:300], 0.03),
    "large cloud": PointCloud(SHELL, 0.02),
}


@pytest.mark.parametrize("name", MEASURED)
def test_scanned_obstacles_touch_the_simulated_arm_where_planning_finds_collisions(panda, name):
    """They were refused, so that no scanned scene could be executed."""
    scene = Scene("s", (SceneObject("scan", MEASURED[name], pose((0.1, 0.0, 0.1), 0.3)),))
    control, checker = Controller("computed-torque", panda), CollisionChecker(panda, scene)
    states = panda.random_configurations(np.random.default_rng(0), 40)
    world = Simulation(panda, scene, states[0], control, Physics(0.004), False)
    touching = 0
    for q in states:
        if "scan" not in str(pair := checker.colliding_pair(q)) and pair is not None:
            continue  # links touch each other, which is not the question
        world.data.qpos[world._q] = q
        mujoco.mj_forward(world.model, world.data)
        found = world.data.contact
        depths = found.includemargin - found.dist
        geoms = {*world.obstacles["scan"]}
        deepest = max(
            (d for d, g in zip(depths, found.geom.tolist(), strict=True) if geoms & {*g}),
            default=-1.0,
        )
        assert abs(deepest) < 2e-4 or (deepest > 0.0) == (pair is not None)
        touching += deepest > 0.0
    assert 3 < touching < 37


def test_an_arm_without_fingers_on_sliders_cannot_hold_by_friction(carrying):
    arm = robot_from_source({"name": "ur5"})
    control, scene = Controller("computed-torque", arm), carrying[0].scene
    given = arm, scene, np.zeros(6), control, Physics(0.004), True
    refused("has no fingers: only fingers on sliders", execute.Simulation, *given)


@pytest.mark.parametrize("mimic", ["", '<mimic joint="left" multiplier="-1"/>'])
def test_two_opposite_sliders_of_any_urdf_close_on_what_is_between_them(tmp_path, mimic):
    """Fingers need no lock, and touch the flange and each other as little as planning does."""
    fingers = [
        joint(name, "flange", f"{name}_finger", "prismatic", (0, 1, 0), (0.1, 0.0, 0.0))
        for name in ("left", "right")
    ]
    fingers = [
        text.replace('lower="-3.0" upper="3.0"', f'lower="{low}" upper="{high}"')
        for text, low, high in zip(fingers, (0.0, -0.04), (0.04, 0.0), strict=True)
    ]
    (tmp_path / "arm.urdf").write_text(
        '<robot name="two-sliders">'
        + box("base", (0.02, 0.02, 0.02), (0.0, 0.0, -2.0))
        + box("flange", (0.1, 0.1, 0.1), (0.05, 0.0, 0.0))
        + box("left_finger", (0.1, 0.01, 0.02), (0.05, 0.005, 0.0))
        + box("right_finger", (0.1, 0.01, 0.02), (0.05, -0.005, 0.0))
        + joint("turn", "base", "flange", "revolute", (0, 0, 1))
        + fingers[0]
        + fingers[1].replace("</joint>", f"{mimic}</joint>")
        + "</robot>"
    )
    arm = load_robot(tmp_path / "arm.urdf", "flange")
    control = Controller("computed-torque", arm)
    given = arm, Scene("none", ()), np.zeros(1), control, Physics(0.004), True
    world = execute.Simulation(*given)
    places = {}
    for force in (execute.OPEN_FORCE_N, execute.GRIP_FORCE_N):
        world.force = force
        world.hold(np.zeros(1), 0.4)
        places[force] = [float(world.data.joint(name).qpos[0]) for name in ("left", "right")]
    np.testing.assert_allclose(places[execute.OPEN_FORCE_N], (0.04, -0.04), atol=2e-3)
    np.testing.assert_allclose(places[execute.GRIP_FORCE_N], (0.0, 0.0), atol=2e-3)
    assert not world.touched


def test_a_task_does_not_advise_to_weld(capsys):
    said = command_refused(capsys, "execute", "multi-sequence", "--hold", "weld")
    assert "--hold goes with a problem; in a task fingers hold by friction" in said


def test_the_suite_goes_on_where_it_stopped(tmp_path):
    experiment = Experiment("executed", (0,), ("birrt",), (0,), Budget(iterations=40_000))
    for again in (False, True):
        before = (tmp_path / RUNS_FILE).read_bytes() if again else b""
        with executor_for(experiment, 1) as executor:
            rows = run_experiment(experiment, tmp_path, executor, [], lambda *_: None)
        assert len(rows) == 2 and all(row.solved for row in rows)
        assert {row.measures["contacts"] for row in rows} == {0.0}
        assert not again or (tmp_path / RUNS_FILE).read_bytes() == before
    committed = {row.problem: row for row in read_rows(RESULTS / "executed" / RUNS_FILE)}
    assert all(row.problem in committed for row in rows)
    assert committed[rows[0].problem].measures.keys() == rows[0].measures.keys()


def test_what_is_not_planned_or_not_run_is_a_row_of_each_controller(monkeypatch):
    experiment = Experiment("executed", (118,), ("birrt",), (0,), Budget(iterations=1))
    (run,), item = experiment.runs, suite_named("executed").item(118)
    monkeypatch.setattr(executed, "_planned", lambda run, item: "not planned: timeout")
    rows = outcome_of(run, item, None).rows
    lost = failed_rows(run, item, FailReason.WORKER_DIED, "it ended")
    for found, reason in ((rows, "not_executed"), (lost, "worker_died")):
        assert [row.problem for row in found] == [
            "118/5-task, speed 1",
            "118/6-task, speed 1, load unknown",
        ]
        assert {row.fail_reason for row in found} == {reason}
    assert set(rows[0].measures.values()) == {None} and rows[0].detail == "not planned: timeout"


def test_execute_reports_and_answers_json(cvqmpt, tmp_path):
    words = "execute place-task-with-can --problem 3 --iterations 40000"
    assert "outcome     executed as planned" in cvqmpt(words)
    told = json.loads(cvqmpt(f"{words} --json --contact-time 0.002"))
    assert told["outcome"] == "executed as planned"
    assert told["executions"][0]["contact_time"] == 0.002


def test_a_load_rests_on_the_boxes_of_a_map_below_it_alone(panda):
    floor = [(i, j, 0) for i in range(-5, 5) for j in range(-5, 5)]
    cells = np.array([*floor, *((2, j, k) for j in range(-5, 5) for k in range(1, 6))])
    scan = SceneObject("scan", OccupancyMap(cells, 0.02), pose((0.5, 0.0, 0.2)))
    scene, q = Scene("s", (scan,)), 0.5 * (panda.lower + panda.upper)
    world = Simulation(panda, scene, q, Controller("position-servo", panda), Physics(0.004), False)
    load = Box((0.06, 0.06, 0.06)), pose((0.509, 0.0, 0.251))  # 1 mm from floor and wall
    (support,) = execute._rest(world, scene, [load]).supports
    assert len(world.obstacles["scan"]) == 3 and world.names[support] == "scan"
    assert world.model.geom_pos[support][2] == pytest.approx(0.01)


def test_a_scan_with_shadows_is_planned_in_and_executed(scan_folder, tmp_path, cvqmpt):
    """The story of a depth image broke at its last command. The arm's own shadow is free."""
    camera = ["--intrinsics", scan_folder / "depth.intrinsics.json"]
    camera += ["--extrinsics", scan_folder / "depth.extrinsics.json"]
    words = [*camera, "--arm-at", SCAN_START, "--plane", "box", "--unknown", "shadow"]
    cvqmpt("scan", scan_folder / "depth.png", *words, "--out", tmp_path / "scene.json")
    start = [float(x) for x in SCAN_START.split(",")]
    problem = {"schema": "cvqmpt-problem/1", "name": "scanned", "robot": {"name": "panda"}}
    problem |= {"scene": "scene.json", "constraint": [], "start": start}
    problem["goals"] = [[start[0] - 0.2, *start[1:]]]
    (tmp_path / "p.json").write_text(json.dumps(problem))
    cvqmpt("plan", tmp_path / "p.json", "--trajectory", tmp_path / "m.json", "--optimize", 0)
    words = ["--motion", tmp_path / "m.json", "--contact-time", "0.004"]
    told = cvqmpt("execute", tmp_path / "p.json", *words)
    assert "outcome     executed as planned" in told


@pytest.mark.parametrize("time", ["1e-7", "0.5"])
def test_contact_times_that_no_simulation_can_have_are_refused(capsys, time):
    """A step of 50 ns simulated for hours."""
    words = ("execute", "place-task-with-can", "--contact-time", time)
    said = command_refused(capsys, *words)
    assert f"--contact-time {float(time):g} s: give 0.0001 to 0.1 s" in said


def test_the_speed_of_a_timed_motion_is_its_own(carrying, capsys, tmp_path):
    problem, motion = carrying
    problem.save(tmp_path / "p.json")
    save_trajectory(motion, tmp_path / "m.json")
    words = ("execute", tmp_path / "p.json", "--motion", tmp_path / "m.json", "--speed", "0.3")
    assert "m.json has times of its own: leave it out" in command_refused(capsys, *words)


@pytest.mark.parametrize(
    "option",
    ["--margin 0.01", "--cutoff 1.0", "--iterations 5", "--cost 1.0"]
    + ["--seed 3", "--backend exact"],
)
def test_options_of_planning_are_refused_with_a_motion(option, carrying, capsys, tmp_path):
    """They were ignored without a word."""
    problem, motion = carrying
    problem.save(tmp_path / "p.json")
    save_trajectory(motion, tmp_path / "m.json")
    words = ("execute", tmp_path / "p.json", "--motion", tmp_path / "m.json", *option.split())
    said = command_refused(capsys, *words)
    assert f"cvqmpt: {option}" in said
    assert f" is for planning; the motion of {tmp_path / 'm.json'}" in said
