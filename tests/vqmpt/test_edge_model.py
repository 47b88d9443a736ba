"""The edge validity model on made-up clouds, against distances measured one by one."""

import numpy as np
import pytest

from cvqmpt_lab.collision.arrays import robot_arrays
from cvqmpt_lab.robot.kinematics import link_poses
from cvqmpt_lab.robot.loading import panda
from cvqmpt_lab.training.edge_training import fit_logistic, fit_network
from cvqmpt_lab.vqmpt.clearances import FARTHEST, NEAREST
from cvqmpt_lab.vqmpt.edge_curve import CLOUD, shipped_curve
from cvqmpt_lab.vqmpt.edge_model import CELL, EdgeModel


@pytest.fixture(scope="module")
def cloud():
    rng = np.random.default_rng(0)
    return rng.uniform((-0.6, -0.6, 0.1), (0.6, 0.6, 1.0), (60, 3))


def clearances(cloud, q):
    """Smallest distance of every joint's balls to the cloud (n,), measured one by one [m]."""
    robot = panda()
    geometry = robot_arrays(robot)
    rotation, translation = (poses[0] for poses in link_poses(robot.kinematics, q[None]))
    found = np.full(robot.dof, np.inf)
    for row, first, end in zip(
        geometry.body_link, geometry.body_start, geometry.body_end, strict=True
    ):
        for ball in range(first, end):
            if row > 0 and geometry.leaf[ball] >= 0:
                centre = rotation[row] @ geometry.sphere[ball, :3] + translation[row]
                gap = np.linalg.norm(cloud - centre, axis=1).min() - geometry.sphere[ball, 3]
                found[row - 1] = min(found[row - 1], gap)
    return found


def test_clearances_are_those_measured_one_by_one_but_for_half_a_cell(cloud):
    robot, model = panda(), EdgeModel(panda())
    states = robot.random_configurations(np.random.default_rng(2), 50)
    found, odds = model.log_odds(cloud, np.stack([states, states], axis=1))
    truth = np.array([np.clip(clearances(cloud, q), NEAREST, FARTHEST) for q in states])
    assert np.abs(found - truth).max() < 0.5 * np.sqrt(3.0) * CELL + 1e-3
    curve = shipped_curve(CLOUD)
    np.testing.assert_allclose(odds, curve.slope * found.min(axis=1) + curve.bias)


def test_a_motion_is_as_near_as_its_nearest_state(cloud):
    robot, model = panda(), EdgeModel(panda())
    a, b = robot.random_configurations(np.random.default_rng(3), 2)
    pieces = int(np.ceil(np.linalg.norm(b - a) / 0.3))
    states = a + np.linspace(0.0, 1.0, pieces + 1)[:, None] * (b - a)
    along, _ = model.log_odds(cloud, np.stack([a, b])[None])
    alone, _ = model.log_odds(cloud, np.stack([states, states], axis=1))
    np.testing.assert_allclose(along[0], alone.min(axis=0))


def test_a_curve_is_found_from_verdicts_drawn_with_its_odds_and_a_network_separates():
    rng = np.random.default_rng(5)
    features = rng.uniform(-0.1, 0.15, (20_000, 1))
    free = rng.random(20_000) < 1.0 / (1.0 + np.exp(-(80.0 * features[:, 0] + 2.0)))
    np.testing.assert_allclose(fit_logistic(features, free), (80.0, 2.0), rtol=0.05)
    one, again = (fit_network(features, free, seed=0, epochs=2)(features) for _ in range(2))
    np.testing.assert_array_equal(one, again)
    assert ((one > 0.0) == free).mean() > 0.9
