"""Newton projection onto the manifold: convergence, limits, reported failure."""

from dataclasses import replace

import numpy as np
import pytest

from cvqmpt_lab.constraints.project import PROJECTION_TOLERANCE
from cvqmpt_lab.constraints.region_constraint import RegionConstraint
from cvqmpt_lab.constraints.task_space_region import TaskSpaceRegion, upright


def region_at(position, half):
    """Return a region of half width [m] around a world position, for any orientation."""
    T0_w = np.eye(4)
    T0_w[:3, 3] = position
    return TaskSpaceRegion(T0_w, np.eye(4), np.array([(-half, half)] * 3 + [(-np.inf, np.inf)] * 3))


UNREACHABLE = region_at((5.0, 0.0, 0.0), 0.1)


def at_limits(robot, samples, share):
    """Return configurations with this fraction of joints at one of their limits."""
    place = np.random.default_rng(6).random(samples.shape) / share
    return np.where(place < 0.5, robot.lower, np.where(place < 1.0, robot.upper, samples))


def projected(manifold, samples, **options):
    """Return the samples whose projection succeeds (k, n)."""
    found = (manifold.project(q, **options) for q in samples)
    return np.array([q for q in found if q is not None])


@pytest.mark.parametrize(
    ("tilt", "share", "least"),
    [(0.1, 1e-9, 0.999), (0.0, 1e-9, 0.99), (0.1, 0.67, 0.98), (0.1, 1.0, 0.95)],
)
def test_the_upright_manifold_is_reached_inside_the_limits_from_anywhere(panda, tilt, share, least):
    manifold = RegionConstraint(panda, (upright(tilt),))
    samples = at_limits(panda, panda.random_configurations(np.random.default_rng(0), 5000), share)
    q = projected(manifold, samples)
    assert len(q) >= least * 5000
    assert len(projected(manifold, samples, max_iterations=6)) >= 0.5 * len(q)
    assert (q >= panda.lower).all() and (q <= panda.upper).all()
    assert np.linalg.norm(manifold.residual(q), axis=1).max() <= PROJECTION_TOLERANCE


@pytest.mark.parametrize("held", [1, 3, 5])
def test_what_a_held_joint_cannot_do_the_others_share(panda, held):
    """Joints 1, 3, 5 have parallel axes: each corrects a third of a tilt, or a half of it."""
    manifold = RegionConstraint(panda, (upright(0.0),))
    tilted = manifold.project(np.array([0.0, 0.3, 0.0, -2.0, 0.0, 2.0, 0.8]))
    tilted[5] += 0.3
    way = np.array([0.0, 1.0, 0.0, -1.0, 0.0, -1.0, 0.0])
    np.testing.assert_allclose(manifold.project(tilted) - tilted, 0.1 * way, atol=2e-3)
    lower, upper = panda.lower.copy(), panda.upper.copy()
    (lower if way[held] < 0.0 else upper)[held] = tilted[held]
    narrow = replace(panda, kinematics=panda.kinematics._replace(lower=lower, upper=upper))
    way[held] = 0.0
    q = RegionConstraint(narrow, (upright(0.0),)).project(tilted)
    np.testing.assert_allclose(q - tilted, 0.15 * way, atol=2e-3)


def test_the_input_is_not_changed_and_is_clipped_first(panda):
    far = np.full(7, 10.0)
    q = RegionConstraint(panda, ()).project(far)
    np.testing.assert_array_equal(q, panda.upper)
    assert (far == 10.0).all()
    manifold = RegionConstraint(panda, (upright(), region_at((0.4, 0.0, 0.5), 0.1)))
    q = projected(manifold, panda.random_configurations(np.random.default_rng(1), 50))
    assert len(q) > 0 and np.linalg.norm(manifold.residual(q), axis=1).max() <= PROJECTION_TOLERANCE


def test_an_unreachable_region_and_what_is_not_a_number_fail(panda):
    samples = panda.random_configurations(np.random.default_rng(2), 20)
    assert len(projected(RegionConstraint(panda, (UNREACHABLE,)), samples)) == 0
    manifold = RegionConstraint(panda, (upright(),))
    assert manifold.project(np.full(7, np.nan)) is None
    # with 0 iterations, a projection only checks the residual
    assert manifold.project(samples[0], max_iterations=0) is None
    there = manifold.project(samples[0])
    np.testing.assert_array_equal(manifold.project(there, max_iterations=0), there)
