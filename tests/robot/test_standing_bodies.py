"""Floors, tables and pedestals in a URDF: fixed bodies of any size are planned with."""

import numpy as np
from refusals import refused

from cvqmpt_lab.collision.exact import CollisionChecker
from cvqmpt_lab.collision.world import World
from cvqmpt_lab.constraints.region_constraint import RegionConstraint
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.load import load_robot
from cvqmpt_lab.scene.scene import Scene
from cvqmpt_lab.search.space import ConstrainedSpace

BASE = '<link name="base"/>'
EMPTY = Scene("empty", ())


def fixed(name, size, at):
    """A link with a box, fixed to the link "base"."""
    geometry = f'<geometry><box size="{size}"/></geometry>'
    return (
        f'<link name="{name}"><collision><origin xyz="{at}"/>{geometry}</collision></link>'
        f'<joint name="{name}_mount" type="fixed"><parent link="base"/><child link="{name}"/>'
        "</joint>"
    )


def test_a_floor_and_a_wall_of_any_size_are_planned_with(edited):
    bodies = fixed("floor", "60 80 0.02", "0 0 -1.2") + fixed("wall", "3 0.1 40", "0 0.55 0")
    robot = load_robot(edited(("</robot>", bodies + "</robot>")), "tool")
    states = robot.random_configurations(np.random.default_rng(0), 400)
    exact = CollisionChecker(robot, EMPTY)
    truth = exact.in_collision_batch(states)
    plain = CollisionChecker(load_robot(edited(), "tool"), EMPTY).in_collision_batch(states)
    # some states touch the floor or the wall alone
    assert 20 < (truth & ~plain).sum() < 300
    space = ConstrainedSpace(World(robot, EMPTY), RegionConstraint(robot, ()))
    wrong = np.flatnonzero(space.valid_batch(states) == truth)
    assert all(0.0 < exact.clearance(states[k]) < 1e-3 for k in wrong)


def test_a_moving_body_that_is_too_large_is_still_refused(edited):
    robot = load_robot(edited(('radius="0.04"', 'radius="2.5"')), "tool")
    problem = PlanningProblem("large", robot, EMPTY, np.zeros(4), np.zeros((1, 4)))
    refused("too large to plan with: give sizes in metres", ConstrainedSpace.of, problem)
