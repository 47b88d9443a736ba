"""The edge validity model on made-up clouds, against distances measured one by one."""

import numpy as np
import pytest

from cvqmpt_lab.collision.arrays import robot_arrays
from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.robot.kinematics import link_poses
from cvqmpt_lab.robot.loading import panda
from cvqmpt_lab.training.edge_training import fit_edge_model
from cvqmpt_lab.vqmpt.clearances import FARTHEST, NEAREST
from cvqmpt_lab.vqmpt.edge_model import CELL, EdgeModel, SmallNetwork


@pytest.fixture(scope="module")
def cloud():
    rng = np.random.default_rng(0)
    return rng.uniform((-0.6, -0.6, 0.1), (0.6, 0.6, 1.0), (60, 3))


@pytest.fixture(scope="module")
def network():
    rng = np.random.default_rng(1)
    shapes = {"first": (6, 8), "first_bias": (6,), "second": (5, 6)}
    shapes |= {"second_bias": (5,), "last": (5,), "last_bias": (1,)}
    return {name: rng.normal(size=shape) for name, shape in shapes.items()}


def clearances(cloud, q):
    """Smallest distance of every joint's balls to the cloud (n,), measured one by one [m]."""
    robot = panda()
    geometry = robot_arrays(robot)
    rotation, translation = (poses[0] for poses in link_poses(robot.kinematics, q[None]))
    found = np.full(robot.dof, np.inf)
    for row, first, end in zip(geometry.body_link, geometry.body_start, geometry.body_end, strict=True):
        for ball in range(first, end):
            if row > 0 and geometry.leaf[ball] >= 0:
                centre = rotation[row] @ geometry.sphere[ball, :3] + translation[row]
                gap = np.linalg.norm(cloud - centre, axis=1).min() - geometry.sphere[ball, 3]
                found[row - 1] = min(found[row - 1], gap)
    return found


def test_clearances_are_those_measured_one_by_one_but_for_half_a_cell(cloud, network):
    robot, model = panda(), EdgeModel(SmallNetwork.of(network), panda())
    states = robot.random_configurations(np.random.default_rng(2), 50)
    features, _ = model.log_odds(cloud, np.stack([states, states], axis=1))
    truth = np.array([np.clip(clearances(cloud, q), NEAREST, FARTHEST) for q in states])
    assert np.abs(FARTHEST * features[:, :-1] - truth).max() < 0.5 * np.sqrt(3.0) * CELL + 1e-3
    assert (features[:, -1] == 0.0).all()


def test_a_motion_is_as_near_as_its_nearest_state(cloud, network):
    robot, model = panda(), EdgeModel(SmallNetwork.of(network), panda())
    a, b = robot.random_configurations(np.random.default_rng(3), 2)
    length = np.linalg.norm(b - a)
    pieces = int(np.ceil(length / 0.3))
    states = a + np.linspace(0.0, 1.0, pieces + 1)[:, None] * (b - a)
    along, _ = model.log_odds(cloud, np.stack([a, b])[None])
    alone, _ = model.log_odds(cloud, np.stack([states, states], axis=1))
    np.testing.assert_allclose(along[0, :-1], alone[:, :-1].min(axis=0))
    assert along[0, -1] == pytest.approx(length)


def test_training_finds_what_separates_free_from_blocked():
    rng = np.random.default_rng(5)
    features = rng.uniform(-0.6, 1.0, (4000, 8))
    free = features[:, [1, 4]].min(axis=1) > 0.0  # two joints matter
    sight = fit_edge_model(features, free, seed=0, epochs=20, batch=128)
    network = SmallNetwork.of(sight)
    said = network(features) > 0.0
    assert (said == free).mean() > 0.95
    one, again = (fit_edge_model(features, free, seed=0, epochs=1, batch=128) for _ in range(2))
    np.testing.assert_array_equal(one["first"], again["first"])


def test_edge_model_another_robot_are_refused(network):
    wide = SmallNetwork.untrained(7)
    with pytest.raises(InvalidInputError, match="for 6 joints; panda has 7"):
        EdgeModel(wide, panda())
