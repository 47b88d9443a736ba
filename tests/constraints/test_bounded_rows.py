"""Joint couplings and the centre of mass: machine code, numpy, slopes, refusals."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from refusals import refused

from cvqmpt_lab.benchmarks.declarations import SUITES
from cvqmpt_lab.collision.world import World
from cvqmpt_lab.constraints.centre_of_mass import CentreOfMass
from cvqmpt_lab.constraints.joint_coupling import JointCoupling
from cvqmpt_lab.constraints.region_constraint import JumpingConstraint, RegionConstraint
from cvqmpt_lab.constraints.regions import no_regions
from cvqmpt_lab.constraints.task_space_region import upright
from cvqmpt_lab.planning.pipeline import solve
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.dynamics import Load, loaded_model
from cvqmpt_lab.robot.load import robot_from_source
from cvqmpt_lab.scene.scene import Scene
from cvqmpt_lab.search.result import Budget
from cvqmpt_lab.search.space import ConstrainedSpace, Tolerances

SQUARE = np.array([[0.1, 0.1], [-0.1, 0.1], [-0.1, -0.1], [0.1, -0.1]])
LOAD = Load(np.eye(4), 5.0, np.array([0.0, 0.1, 0.2]), np.zeros((3, 3)))


@pytest.fixture(scope="module")
def talos():
    return robot_from_source({"name": "talos-left-arm"})


def test_machine_code_and_numpy_agree_and_slopes_are_those_of_differences(talos):
    first, second = talos.joint_names[:2]
    coupling = JointCoupling({first: 1.0, second: -0.5}, lower=None, upper=0.1)
    balanced = CentreOfMass(SQUARE, margin=0.09).carrying((LOAD,))
    for member in (coupling, balanced):
        alone, both = member.on(talos), RegionConstraint(talos, (upright(0.5), member))
        space = ConstrainedSpace(
            World(talos, Scene("empty", ())), both, tolerances=Tolerances(inset=0.0)
        )
        for q in talos.random_configurations(np.random.default_rng(0), 20):
            F, J = space.residual_and_jacobian(q)
            np.testing.assert_allclose(F[1:], alone.residual(q), atol=1e-9)
            np.testing.assert_allclose(J[1:], alone.jacobian(q), atol=1e-9)
            near = q + 1e-6 * np.concatenate([np.eye(talos.dof), -np.eye(talos.dof)])
            ahead, back = np.split(alone.values(near), 2)
            np.testing.assert_allclose(alone.slopes(q[None])[0], (ahead - back).T / 2e-6, atol=1e-6)
            projected = q.copy()
            if space.project(projected):
                assert np.abs(both.residual(projected)).max() <= 1e-4


def test_the_centre_of_mass_is_that_of_all_bodies_and_the_load(talos):
    q = talos.random_configurations(np.random.default_rng(0), 1)
    model = loaded_model(talos, [LOAD])
    data = model.createData()
    pin.forwardKinematics(model, data, q[0])
    bodies = list(zip(data.oMi, model.inertias, strict=True))
    mass = sum(body.mass for _, body in bodies)
    c = sum(body.mass * (T * body.lever) for T, body in bodies) / mass
    assert mass > 80.0
    x = CentreOfMass(SQUARE).carrying((LOAD,)).on(talos).values(q)[0]
    np.testing.assert_allclose(x, [c[1], -c[0], -c[1], c[0]], atol=1e-12)


@pytest.mark.parametrize("name", ["panda", "talos-left-arm"])
def test_a_base_elsewhere_moves_the_mass_of_all_links_over_corners_in_the_world(name):
    base = {"xyz": [1.0, 0.5, 0.2], "rpy": [0.0, 0.0, 0.5 * np.pi]}
    at_origin, moved = (robot_from_source({"name": name, **more}) for more in ({}, {"base": base}))
    q = at_origin.random_configurations(np.random.default_rng(0), 1)
    x, y = CentreOfMass(SQUARE).on(at_origin).values(q)[0][[3, 0]]
    there = CentreOfMass(SQUARE).on(moved)
    np.testing.assert_allclose(there.values(q)[0][[3, 0]], [1.0 - y, 0.5 + x], atol=1e-12)
    both = RegionConstraint(moved, (CentreOfMass(SQUARE),))
    space = ConstrainedSpace(
        World(moved, Scene("empty", ())), both, tolerances=Tolerances(inset=0.0)
    )
    np.testing.assert_allclose(
        space.residual_and_jacobian(q[0])[0], there.residual(q[0]), atol=1e-9
    )


def test_wrong_polygons_joints_and_robots_without_masses_are_refused(talos, slider_arm):
    refused("3 or more of a convex polygon", CentreOfMass, SQUARE[[0, 2, 1, 3]])
    angles = 0.8 * np.pi * np.arange(5)
    star = np.column_stack([np.cos(angles), np.sin(angles)])
    refused("3 or more of a convex polygon", CentreOfMass, star)
    refused("no mass at joint", CentreOfMass(SQUARE).on, slider_arm)
    refused("unknown joint of robot talos", JointCoupling({"nope": 1.0}).on, talos)
    refused("a factor other than 0", JointCoupling, {"a": 0.0})
    refused("lower <= upper", JointCoupling, {"a": 1.0}, 1.0, 0.0)
    assert replace(CentreOfMass(SQUARE), margin=0.1).on(talos).describe().endswith("0.1 m inside")


def test_the_published_jump_aims_at_the_only_bound_of_a_row():
    rows = no_regions()._replace(lower=np.array([-np.inf, -1.0]), upper=np.array([2.0, 3.0]))
    for residual, jumped in (([0.5, -0.5], [0.5, -2.5]), ([0.0, 0.0], [0.0, 0.0])):
        np.testing.assert_equal(JumpingConstraint.jumped(np.array(residual), rows), jumped)


def test_they_stand_in_problem_files_and_their_paths_are_proven():
    for index in (82, 100):
        problem = SUITES["constraints-more"].solvable(index)
        data = problem.to_dict()
        again = PlanningProblem.from_dict(data)
        assert again.to_dict() == data and again.constraint[0].named == data["constraint"][0]
        certificate = solve(again, "birrt", Budget(iterations=3000), seed=0).certificate
        assert certificate.valid and certificate.constraint_states == 0
        refused(
            "no region", PlanningProblem.from_dict, data | {"goal_region": data["constraint"][0]}
        )
        held = [{"name": "box", "shape": {"type": "sphere", "radius": 0.01}, "T_hand_object": {}}]
    balanced = data | {"attachments": held}
    refused("attachment 'box' has no mass", PlanningProblem.from_dict, balanced)
    held[0]["mass"] = 2.0
    assert PlanningProblem.from_dict(balanced).constraint[0].loads[0].mass == 2.0
