"""Regions on moving frames: projection, json, errors; doors opened and certified."""

import json
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from constraints.test_task_space_region import of_hand
from refusals import refused

from cvqmpt_lab.base.codec import from_plain, to_plain
from cvqmpt_lab.base.errors import CvqmptError
from cvqmpt_lab.base.poses import pose
from cvqmpt_lab.benchmarks.kitchen import kitchen
from cvqmpt_lab.benchmarks.place_task import (
    DOOR_OPEN_RAD,
    HANDLE_BAR,
    SHELF_DOOR,
    bar_pose,
    door_problem,
    door_world,
    handle_region,
)
from cvqmpt_lab.certificate.certificate import certify
from cvqmpt_lab.collision.exact import CollisionChecker
from cvqmpt_lab.constraints.goals import sample_region
from cvqmpt_lab.constraints.named import Region
from cvqmpt_lab.constraints.project import PROJECTION_TOLERANCE
from cvqmpt_lab.constraints.region_constraint import RegionConstraint
from cvqmpt_lab.planning.pipeline import solve, with_drawn_goals
from cvqmpt_lab.planning.planners import planner_named
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.load import robot_from_source
from cvqmpt_lab.scene.scene import Scene, SceneObject
from cvqmpt_lab.scene.shapes import Box
from cvqmpt_lab.search.result import Budget, JointPath


@pytest.fixture(scope="module")
def door():
    """A door problem with its goals."""
    return with_drawn_goals(door_problem(0))


@pytest.fixture(scope="module")
def opened(door):
    return solve(door, planner_named("birrt"), Budget(iterations=5000), seed=0)


def test_projection_lands_on_the_handle():
    """From anywhere, door and arm move until the hand holds the bar, by pinocchio's poses."""
    chain, robot = handle_region(), door_world()[1]
    constraint = RegionConstraint(robot, (chain,))
    starts = robot.random_configurations(np.random.default_rng(0), 100)
    landed = [q for start in starts if (q := constraint.project(start)) is not None]
    assert len(landed) > 50
    angles = np.array(landed)[:, 7]
    assert angles.min() >= -1.57 and angles.max() <= 0.0 and np.ptp(angles) > 1.0
    for q in landed:
        assert np.linalg.norm(of_hand(robot, chain, q)[:5]) <= PROJECTION_TOLERANCE + 1e-9
        bar = np.linalg.inv(robot.pose(q)) @ robot.pose(q, HANDLE_BAR)
        np.testing.assert_allclose(bar[:3, 3], (0.0, 0.0, 0.10), atol=2e-4)


def test_goals_have_the_door_where_the_hand_takes_it(door):
    """Goal poses do not set the door angle: it follows from the held handle."""
    assert len(door.goals) == 20
    np.testing.assert_allclose(door.goals[:, 7], DOOR_OPEN_RAD, atol=1e-5)
    np.testing.assert_allclose(door.start[7], 0.0, atol=1e-5)
    rng, checker = np.random.default_rng(0), door.collision_checker()
    free = sample_region(door.robot, door.goal_region, checker, rng, count=5)
    assert np.abs(free.configurations[:, 7] - DOOR_OPEN_RAD).max() > 0.1


def test_chains_survive_json_and_need_their_base(panda):
    chain = handle_region()
    leaning = replace(chain, tilt=0.2)
    for written in (handle_region(np.inf), handle_region(0.7), leaning):
        for region in (written, written.at(np.eye(4))):
            assert region.tilt == written.tilt
            again = from_plain(Region, json.loads(json.dumps(to_plain(region, Region))))
            assert type(again) is type(region) and again == region
    told = r"frame of robot panda '.*handle_bar'.*panda_hand"
    refused(told, chain.links, panda, error=CvqmptError)


@pytest.mark.parametrize("hand", ["right_gripper", "base"])
def test_a_base_that_stands_still_is_refused_unless_the_region_says_so(hand):
    """The other arm's hand, which does not move, must not be taken for a frame of the world."""
    arm, region = robot_from_source({"name": "baxter-left"}), to_plain(handle_region())
    zero = np.zeros(arm.dof)
    problem = PlanningProblem("two arms", arm, Scene("empty", ()), zero, zero[None]).to_dict()

    def with_region(**changes):
        return problem | {"constraint": region | changes}

    told = rf"base '{hand}' stands still: none of the planned joints \(left_"
    refused(told, PlanningProblem.from_dict, with_region(base=hand))
    made = PlanningProblem.from_dict(with_region(base=hand, fixed=True))
    assert made.constraint[0].fixed and PlanningProblem.from_dict(made.to_dict()) == made
    moved = with_region(base="left_gripper", fixed=True)
    refused("'left_gripper' is moved by the planned joints", PlanningProblem.from_dict, moved)


def handle_errors(problem, states, resolution=0.002):
    """Return largest distance [m] and angle [rad] between hand and bar, except about its axis."""
    metres = radians = 0.0
    for a, b in pairwise(states):
        for s in np.linspace(0.0, 1.0, max(2, int(np.ceil(np.linalg.norm(b - a) / resolution)))):
            x = of_hand(problem.robot, handle_region(), a + s * (b - a))
            metres = max(metres, float(np.linalg.norm(x[:3])))
            radians = max(radians, float(np.linalg.norm(x[3:5])))
    return metres, radians


@pytest.mark.parametrize("name", ["birrt", "ompl-projected", "atlas-rrt", "tb-rrt"])
def test_every_planner_opens_the_door(panda, door, name):
    """Paths are certified and keep the hand at the handle; at the end the fingers can open."""
    found = solve(door, planner_named(name), Budget(seconds=30.0), seed=0)
    assert found.solved, (found.plan.status, found.certificate and found.certificate.reasons)
    states = found.path.states
    assert abs(states[0, 7]) < 1e-5 and abs(states[-1, 7] - DOOR_OPEN_RAD) < 1e-5
    metres, radians = handle_errors(door, states)
    assert metres < 2e-3 and radians < np.deg2rad(0.5)
    scene = kitchen(door_angles={SHELF_DOOR: float(states[-1, 7])})
    np.testing.assert_allclose(scene[HANDLE_BAR].T_world_object, bar_pose(DOOR_OPEN_RAD), atol=1e-5)
    assert not CollisionChecker(panda, scene).in_collision(states[-1, :7])


def test_the_certificate_sees_a_hand_that_lets_go(door, opened):
    states = opened.path.states.copy()
    assert certify(door, JointPath(states)).valid
    states[len(states) // 2, 7] += 0.01
    reasons = certify(door, JointPath(states)).reasons
    assert len(reasons) == 1 and reasons[0].startswith("off the manifold")


def test_the_certificate_sees_the_door_hit_something(door, opened):
    """A brick is in the path of the panel's upper end, not in the path of the arm."""
    brick = SceneObject("brick", Box((0.1, 0.1, 0.1)), pose((0.35, -0.3, 1.33)))
    blocked = replace(door, scene=door.scene.with_objects(brick))
    checker = blocked.collision_checker()
    assert not checker.in_collision(door.start)
    assert f"in collision: {SHELF_DOOR}/panel and brick" in certify(blocked, opened.path).reasons


def test_the_certificate_sees_an_end_with_the_door_elsewhere(door, opened):
    """Hand region of the goal without its states: a path that stops half way fails."""
    half = opened.path.states[: len(opened.path.states) // 2]
    reasons = certify(replace(door, goals=np.empty((0, 8))), JointPath(half)).reasons
    assert reasons == ("does not end at a goal",)
