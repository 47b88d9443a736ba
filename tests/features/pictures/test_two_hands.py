"""Robots with two hands in pictures, recordings, pages, the studio and the simulation."""

import numpy as np
import pytest
from refusals import refused

from cvqmpt_lab.benchmarks.suite import suite_named
from cvqmpt_lab.features.motion.motion_check import certified_motion
from cvqmpt_lab.features.motion.timing import TimingSettings
from cvqmpt_lab.features.physics.execute import execute_motion
from cvqmpt_lab.features.pictures import picture
from cvqmpt_lab.features.pictures.recording import log_solution
from cvqmpt_lab.features.pictures.web_page import save_page
from cvqmpt_lab.features.studio.studio_planning import Studio
from cvqmpt_lab.planning.pipeline import solve
from cvqmpt_lab.robot.load import robot_from_source
from cvqmpt_lab.search.result import Budget


@pytest.fixture(scope="module")
def carried():
    """A tray that both hands of a robot carry over a table, planned."""
    problem = suite_named("two-arms").solvable(0)
    solution = solve(problem, "birrt", Budget(iterations=20000), seed=0)
    assert solution.solved
    return solution


def test_a_recording_and_a_page_have_a_trace_and_axes_of_each_hand(carried, recorded, tmp_path):
    log_solution(carried, tmp_path / "run.rrd")
    rows = recorded(tmp_path / "run.rrd")
    for hand in carried.problem.robot.end_effectors:
        assert f"/world/path/{hand}/hand" in rows
        assert rows[f"/world/hand/{hand}/x"] == len(carried.path.states)
    save_page(carried, tmp_path / "run.html")
    page = (tmp_path / "run.html").read_text()
    assert page.count('"path of the hand"') >= 2 and "right_w2" in page


def test_a_picture_shows_both_hands_from_in_front_of_the_torso(carried, monkeypatch):
    renderers = []
    made = picture.renderer_of
    monkeypatch.setattr(
        picture, "renderer_of", lambda *a: renderers.append(made(*a)) or renderers[-1]
    )
    size = (300, 200)
    picture.problem_image(carried.problem, carried.path, size)
    viewpoint, robot = renderers[0].viewpoint, carried.problem.robot
    assert viewpoint.eye[0] > viewpoint.target[0]
    for hand in robot.end_effectors:
        ends = robot.poses(carried.path.states, hand)[:, :3, 3]
        columns, rows, _ = viewpoint.screen(ends, size[::-1]).T
        assert np.all((columns > 0) & (columns < size[0]) & (rows > 0) & (rows < size[1]))


def test_in_the_studio_hands_keep_hold_of_what_they_carry(carried):
    live = Studio(carried.problem)
    try:
        assert live.wait().verdict == "certified"
        chain = carried.problem.constraint[0]
        assert all(chain in regions for regions in live.constraints.values())
        T = carried.problem.robot.pose(live.response.path.states[-1])
        T[2, 3] += 0.01
        response = live.wait(live.move_goal(T))
        assert response.verdict == "certified" and response.message == ""
    finally:
        live.stop()


def test_a_motion_has_the_joints_of_both_arms_and_its_load_is_not_simulated(carried):
    limits = {"acceleration_limits": 5.0, "effort_limits": 200.0}
    robot = robot_from_source({**carried.problem.robot.source, **limits})
    problem = carried.problem.changed(robot=robot)
    motion = certified_motion(problem, carried.path, TimingSettings())
    assert motion.joint_names == problem.robot.joint_names and len(motion.joint_names) == 14
    refused("tray is held by 2 hands", execute_motion, problem, motion, "computed-torque")
