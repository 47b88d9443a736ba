"""Robots other than the Panda, from their URDF to a certified path."""

import numpy as np
import pytest
from refusals import refused

from cvqmpt_lab.constraints.task_space_region import RegionConstraint, TaskSpaceRegion
from cvqmpt_lab.errors import InvalidProblemError
from cvqmpt_lab.pipeline import solve
from cvqmpt_lab.planners import planner_named
from cvqmpt_lab.poses import pose
from cvqmpt_lab.problem import PlanningProblem, check_problem
from cvqmpt_lab.robot.load import load_robot
from cvqmpt_lab.scene.scene import Attachment, Scene, SceneObject
from cvqmpt_lab.scene.shapes import Box, Sphere
from cvqmpt_lab.search.result import Budget
from cvqmpt_lab.search.space import ConstrainedSpace
from cvqmpt_lab.trajectory.timing import time_path

NOTHING = Scene("nothing", ())
ENOUGH = Budget(iterations=20_000)
TOOL_BOX = 'size="0.02 0.06 0.02"'


def at_height(z, half=0.02):
    """The tool keeps its height [m]; all else is free."""
    bounds = np.array([(-np.inf, np.inf)] * 6)
    bounds[2] = (-half, half)
    return TaskSpaceRegion(pose((0.0, 0.0, z)), np.eye(4), bounds)


@pytest.fixture(scope="module")
def slider_problem(slider_arm):
    """Past a ball at one height; slider and hinges must move together."""
    region = at_height(0.6)
    middle_of_it = RegionConstraint(slider_arm, (at_height(0.6, 0.0),))
    rough = np.array([[-0.4, 1.3, 0.6, -1.6], [0.6, -1.8, -1.2, -2.1]])
    start, goal = (middle_of_it.project(q) for q in rough)
    middle = slider_arm.pose(0.5 * (start + goal))[:3, 3]
    ball = SceneObject("ball", Sphere(0.06), pose(middle))
    scene = Scene("ball", (ball,))
    return PlanningProblem("slide", slider_arm, scene, start, goal[None], (region,))


@pytest.mark.parametrize("name", ["birrt", "guided-birrt", "ompl-projected"])
@pytest.mark.parametrize("backend", ["compiled", "exact"])
def test_an_arm_with_a_slider_is_planned_past_a_ball(slider_problem, name, backend):
    direct = np.linspace(slider_problem.start, slider_problem.goals[0], 50)
    assert slider_problem.collision_checker().in_collision_batch(direct).any()
    solution = solve(slider_problem, planner_named(name), ENOUGH, seed=0, backend=backend)
    assert solution.certificate.reasons == () and solution.solved
    assert np.ptp(solution.simplified.path.states[:, 0]) > 0.1, "the slider took part"


ONE_JOINT = """<robot name="one"><link name="base"/><link name="arm">\
<collision><origin xyz="0.3 0 0.3"/>
<geometry><box size="0.4 0.05 0.05"/></geometry></collision></link>
<joint name="only" type="{kind}"><parent link="base"/><child link="arm"/><axis xyz="0 0 1"/>
<limit lower="-1" upper="1" velocity="1" effort="1"/></joint></robot>"""


CAN = Attachment("can", Box((0.05, 0.05, 0.1)), pose((0.6, 0.0, 0.3)))
WALLS = {"revolute": (0.0, 0.5, 0.3), "prismatic": (0.4, 0.0, 1.0)}


@pytest.mark.parametrize("backend", ["compiled", "exact"])
@pytest.mark.parametrize("carried", [(), (CAN,)])
@pytest.mark.parametrize(("kind", "wall"), WALLS.items())
def test_robots_of_one_joint_are_planned_for(tmp_path, kind, wall, carried, backend):
    (tmp_path / "one.urdf").write_text(ONE_JOINT.format(kind=kind))
    robot = load_robot(tmp_path / "one.urdf", "arm", acceleration_limits=[1.0])
    scene = Scene("wall", (SceneObject("wall", Box((0.1, 0.1, 0.1)), pose(wall)),))
    start, goal = np.array([-0.5]), np.array([[0.4]])
    for region in ((), (TaskSpaceRegion(np.eye(4), np.eye(4), np.array([(-2.0, 2.0)] * 6)),)):
        problem = PlanningProblem("one", robot, scene, start, goal, region, attachments=carried)
        solution = solve(problem, planner_named("birrt"), ENOUGH, seed=0, backend=backend)
        assert solution.certificate.reasons == ()
        assert 0.0 < solution.certificate.min_clearance_m < 0.5
        assert time_path(solution.simplified.path.states, robot.joint_limits).duration > 0.0
    refused("1 joints and 6 entries", solve, problem, planner_named("atlas-rrt"), ENOUGH, seed=0)


def test_an_srdf_that_keeps_overlapping_pairs_is_named_by_the_pair(slider_arm_urdf, tmp_path):
    """The SRDF decides which pairs are skipped; a tool of 0.9 m always overlaps the upper arm."""
    urdf, srdf = tmp_path / "bulky.urdf", tmp_path / "bulky.srdf"
    urdf.write_text(slider_arm_urdf.read_text().replace(TOOL_BOX, 'size="0.9 0.9 0.9"'))
    srdf.write_text('<?xml version="1.0"?>\n<robot name="slider_arm"/>\n')
    robot = load_robot(urdf, "tool", srdf=srdf)
    assert robot.left_out_pairs == ()
    problem = PlanningProblem("bulky", robot, NOTHING, np.zeros(4), [[0.1, 0.05, -0.1, 0.2]])
    told = r"start is in collision: .*_0 and tool_0"
    refused(told, check_problem, problem, error=InvalidProblemError)
    assert not ConstrainedSpace(problem).valid(problem.start)
