"""Adapters of planners of others; tests that need their packages (extra `peers`) are skipped."""

from dataclasses import replace
from importlib import metadata

import numpy as np
import pinocchio as pin
import pytest
from refusals import refused

from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.benchmarks.declarations import SUITES
from cvqmpt_lab.benchmarks.place_task import (
    place_problem,
    single_goal_problem,
    with_first_goal,
)
from cvqmpt_lab.benchmarks.two_arms import carrying_problem
from cvqmpt_lab.constraints.task_space_region import upright
from cvqmpt_lab.external.door import external_planner
from cvqmpt_lab.external.names import entry_point_names
from cvqmpt_lab.features.peers import fixed_holds, rpy_box, upright_region, versions
from cvqmpt_lab.features.peers.world_files import unchecked_pairs, urdf_of
from cvqmpt_lab.planning.pipeline import solve
from cvqmpt_lab.robot.load import robot_from_source
from cvqmpt_lab.scene.scene import Scene
from cvqmpt_lab.search.result import Budget

TUNING = 1000  # a problem that is not reported
NEEDS = {
    **{"drake": "drake", "hpp": "hpp-python", "roboplan": "roboplan"},
    **{"roboplan-star": "roboplan", "sscbirrt": "sscbirrt"},
}


@pytest.fixture(scope="module")
def problem():
    return single_goal_problem(TUNING)


@pytest.fixture(scope="module")
def tray():
    """Problem in which both hands of a baxter carry a tray; no table reports it."""
    robot = robot_from_source({"name": "baxter"})
    return with_first_goal(carrying_problem(robot, "tray-through-window", 102))


def test_the_suites_adapters_are_entry_points():
    assert set(entry_point_names()) >= set(SUITES["peers"].planners) & NEEDS.keys() == NEEDS.keys()


@pytest.mark.parametrize("name", NEEDS)
def test_an_adapter_plans_a_certified_path_or_names_what_installs_it(problem, name):
    try:
        versions(name, NEEDS[name])
    except InvalidInputError:
        module = name.removesuffix("-star")
        missing = rf"planner {module} needs .*{NEEDS[name]}.*not installed: .*\[peers\]"
        refused(missing, external_planner, name)
        return
    made_by = f"{NEEDS[name]} {metadata.version(NEEDS[name])}"
    assert external_planner(name).made_by.startswith(made_by)
    if name == "drake":  # in the kitchen it may need hours
        problem = replace(problem, scene=Scene("empty", ()))
    # these planners ignore iterations; the time limit only ends one that hangs
    solution = solve(problem, name, Budget(seconds=1200.0), seed=0)
    assert solution.solved, (solution.plan.detail, solution.certificate)


def test_hpp_carries_a_tray_in_two_hands(tray):
    try:
        versions("hpp", NEEDS["hpp"])
    except InvalidInputError:
        pytest.skip("needs hpp-python")
    solution = solve(tray, "hpp", Budget(seconds=1200.0), seed=0)
    assert solution.solved, (solution.plan.detail, solution.certificate)


def test_a_hold_with_freedom_is_refused(tray):
    (held,) = fixed_holds(tray)
    loose = held.changed(Bw=np.vstack([held.Bw[:5], [[-0.1, 0.1]]]))
    with_play = replace(tray, constraint=(loose, *tray.constraint[1:]))
    told = r"frame of 'left_gripper' has bounds .*\[-0.1, 0.1\].*set all six to 0"
    refused(told, fixed_holds, with_play)
    refused("one upright constraint", upright_region, tray)


@pytest.mark.parametrize("name", ["problem", "tray"])
def test_the_urdf_has_the_kinematics_and_collisions_of_the_problem(name, request, tmp_path):
    problem = request.getfixturevalue(name)
    carried = problem.attachments
    urdf, srdf = urdf_of(problem.robot, problem.scene, tmp_path, np.eye(4), carried)
    model = pin.buildModelFromXML(urdf)
    assert tuple(model.names)[1:] == problem.robot.joint_names
    bodies = pin.buildGeomFromUrdfString(model, urdf, pin.GeometryType.COLLISION)
    bodies.addAllCollisionPairs()
    (tmp_path / "arm.srdf").write_text(srdf)
    pin.removeCollisionPairs(model, bodies, str(tmp_path / "arm.srdf"))
    data, results = model.createData(), pin.GeometryData(bodies)
    checker, tool = problem.collision_checker(), model.getFrameId("tool")
    near = np.random.default_rng(0).normal(problem.start, 0.2, (100, problem.robot.dof))
    drawn = problem.robot.random_configurations(np.random.default_rng(0), 200)
    for q in (*drawn, *np.clip(near, problem.robot.lower, problem.robot.upper)):
        collides = pin.computeCollisions(model, data, bodies, results, q, True)
        assert collides == checker.in_collision(q)
        pin.framesForwardKinematics(model, data, q)
        assert np.allclose(data.oMf[tool].homogeneous, problem.robot.pose(q), atol=1e-9)
    checked = len(problem.robot.self_collision_pairs)
    bodies = len(problem.robot.links)
    assert len(list(unchecked_pairs(problem.robot))) == bodies * (bodies - 1) / 2 - checked


def test_the_box_of_roll_pitch_and_yaw_lies_in_the_bounds_with_a_twelfth_left(problem):
    region = upright_region(problem)
    rng, box = np.random.default_rng(0), rpy_box(region)
    tilts = rng.choice((-1.0, 1.0), (4000, 2)) * box[4:, 1]
    angles = np.column_stack([np.linspace(-3.14, 3.14, 4000), tilts])
    vectors = np.abs([pin.log3(pin.rpy.rpyToMatrix(*each))[1:] for each in angles])
    assert 0.09 < vectors.max() < 0.092


@pytest.mark.parametrize("tilt", [0.1, 1.5])
def test_the_same_box_lies_in_a_cone(problem, tilt):
    """Angle between the cone's axis and the vertical at corners of the box, for any roll."""
    cone = upright(tilt, "-z")
    region = upright_region(replace(problem, constraint=(cone,)))
    for roll, *rest in np.column_stack(
        [np.linspace(-3.14, 3.14, 400), np.tile(rpy_box(region)[4:].T, (200, 1))]
    ):
        T = np.eye(4)
        T[:3, :3] = pin.rpy.rpyToMatrix(roll, *rest)
        hand = region.T0_w @ T @ region.Tw_e
        assert 0.7 * tilt < np.arccos(-hand[2, 2]) < 0.8 * tilt


def test_other_constraints_and_goals_are_refused(problem):
    two = place_problem(TUNING).changed(goals=np.stack([problem.goals[0]] * 2))
    refused("one goal", upright_region, two)
    refused("one upright constraint", upright_region, replace(problem, constraint=()))
