"""Bounds on how far links move: they hold for every point, and are not so loose that proofs would crawl."""

import numpy as np
import pinocchio as pin
import pytest

from cvqmpt_lab.robot.hulls import hull_vertices
from cvqmpt_lab.robot.sweep import Sweep


def placed(robot, geometry, q):
    """World points (k, 3) of every piece, by pinocchio."""
    data, results = robot.model.createData(), pin.GeometryData(geometry)
    pin.updateGeometryPlacements(robot.model, data, geometry, results, q)
    return [
        hull_vertices(item.geometry) @ results.oMg[k].rotation.T + results.oMg[k].translation
        for k, item in enumerate(geometry.geometryObjects)
    ]


@pytest.mark.parametrize("name", ["panda", "slider_arm"])
def test_no_point_moves_further_than_the_bound(request, name):
    robot = request.getfixturevalue(name)
    geometry = robot.collision_model
    joints = [item.parentJoint for item in geometry.geometryObjects]
    links = sorted({k for k in joints if k > 0})
    sweep = Sweep(robot, geometry, links)
    rng, used = np.random.default_rng(0), []
    for size in 10.0 ** rng.uniform(-3.0, -0.7, 40):
        q = robot.random_configurations(rng, 1)[0]
        hull = q + size * rng.standard_normal((3, robot.dof))
        (bounds,), (between,) = sweep.in_world(q[None], hull[None]), sweep.between(q[None], hull[None])
        before = placed(robot, geometry, q)
        for weights in rng.dirichlet(np.ones(4), 10):
            after = placed(robot, geometry, weights @ np.vstack([hull, q]))
            for piece, joint in enumerate(joints):
                if joint > 0 and np.isfinite(bound := bounds[links.index(joint)]):
                    moved = np.linalg.norm(after[piece] - before[piece], axis=1).max()
                    assert moved <= bound + 1e-9
                    used.append(moved / bound)
            for pair, bound in zip(geometry.collisionPairs, between, strict=True):
                gaps = [
                    np.linalg.norm(p[pair.first][:8, None] - p[pair.second][:8], axis=2)
                    for p in (before, after)
                ]
                assert np.abs(gaps[1] - gaps[0]).max() <= bound + 1e-9
    assert max(used) > 0.6
