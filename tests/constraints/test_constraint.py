"""The interface of constraints: projection, search and update of codes with a new class."""

import pickle
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import pytest

from cvqmpt_lab.base.poses import pose
from cvqmpt_lab.collision.world import World
from cvqmpt_lab.constraints.by_name.plane import plane
from cvqmpt_lab.constraints.constraint import Constraint
from cvqmpt_lab.constraints.project import PROJECTION_TOLERANCE
from cvqmpt_lab.constraints.region_constraint import RegionConstraint
from cvqmpt_lab.constraints.task_space_region import upright, upright_box
from cvqmpt_lab.scene.scene import Scene, SceneObject
from cvqmpt_lab.scene.shapes import Box
from cvqmpt_lab.search.birrt import BiRRT
from cvqmpt_lab.search.planner_interface import Query, Uniform
from cvqmpt_lab.search.result import Budget
from cvqmpt_lab.search.shortcut import simplify
from cvqmpt_lab.search.space import CERTIFIED_CHORD, ConstrainedSpace, Tolerances
from cvqmpt_lab.vqmpt.codebook import Codebook
from cvqmpt_lab.vqmpt.latent_update import LatentOptimizer, LatentSettings
from cvqmpt_lab.vqmpt.learned_sampler import model_of

HOME = np.array([0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785])


@dataclass(frozen=True)
class JointsOnCircle(Constraint):
    """Two joints lie on a circle around a centre: F(q) = |q_ij - centre|^2 - radius^2."""

    first: int
    second: int
    centre: tuple[float, float]
    radius: float
    joints: int

    @property
    def dim(self):
        return 1

    def _offset(self, q):
        return np.asarray(q)[..., [self.first, self.second]] - self.centre

    def residual(self, q):
        return (self._offset(q) ** 2).sum(axis=-1, keepdims=True) - self.radius**2

    def jacobian(self, q):
        jacobian = np.zeros((*np.shape(q)[:-1], 1, self.joints))
        jacobian[..., 0, [self.first, self.second]] = 2.0 * self._offset(q)
        return jacobian

    def describe(self):
        return f"joints {self.first} and {self.second} on a circle of {self.radius} rad"


CIRCLE = JointsOnCircle(0, 2, (0.0, 0.5), 0.5, 7)


@pytest.fixture(scope="module")
def pole(panda):
    """Return a thin wall beside the arm's home pose, between the two sides of the circle."""
    return Scene("pole", (SceneObject("pole", Box((0.05, 0.05, 1.2)), pose((0.45, 0.3, 0.6))),))


def test_a_constraint_in_python_is_searched_on(panda, pole):
    space = ConstrainedSpace(World(panda, pole), CIRCLE)
    goal = np.array([0.5, -0.785, 0.5, -2.356, 0.0, 1.571, 0.785])
    assert not CIRCLE.residual(HOME).any() and not CIRCLE.residual(goal).any()
    uniform, rng = Uniform(panda.lower, panda.upper), np.random.default_rng(0)
    query = Query.of(space, HOME, goal[None], Budget(iterations=3000), rng)
    found = BiRRT().search(query, uniform)
    assert found.path is not None and found.counters.projections > 0
    shorter = simplify(space, found.path, rng).path
    for path in (found.path, shorter):
        fine = path.spaced(0.01)
        assert np.abs(CIRCLE.residual(fine)).max() < 2.0 * CERTIFIED_CHORD
        assert np.abs(CIRCLE.residual(path.states)).max() <= PROJECTION_TOLERANCE
        np.testing.assert_array_equal(path.states[[0, -1]], [HOME, goal])
    assert space.dim == 1 and shorter.length <= found.path.length


@dataclass(frozen=True)
class AsFunction(Constraint):
    """A constraint whose Python functions compiled code calls."""

    given: Constraint

    @property
    def dim(self):
        return self.given.dim

    def residual(self, q):
        return self.given.residual(q)

    def jacobian(self, q):
        return self.given.jacobian(q)

    def describe(self):
        return "called"


def test_a_function_is_projected_onto_as_the_regions_that_it_computes(panda):
    """Alone, and beside a region; in another process it has other addresses."""
    tilted = RegionConstraint(panda, (upright_box(0.05),))
    for region in ((), (plane((0.0, 0.0, 1.0), (0.0, 0.0, 0.5)),)):
        regions = RegionConstraint(panda, (*region, *tilted.members))
        mixed = RegionConstraint(panda, (*region, AsFunction(tilted)))
        again = pickle.loads(pickle.dumps(mixed))
        assert mixed.regions.functions[0, 0] != again.regions.functions[0, 0] > 0
        spaces = [
            ConstrainedSpace(
                World(panda, Scene("empty", ())), one, tolerances=Tolerances(inset=0.0)
            )
            for one in (regions, mixed, again)
        ]
        for q in panda.random_configurations(np.random.default_rng(1), 50):
            ends = q, q.copy(), q.copy()
            done = [space.project(end) for space, end in zip(spaces, ends, strict=True)]
            np.testing.assert_allclose(ends[1:], ends[:1] * 2, atol=1e-9)
            assert done[0] == done[1] == done[2]
        assert spaces[0].counters == spaces[1].counters


def test_what_a_constraint_raises_reaches_the_caller(panda):
    class Broken(JointsOnCircle):
        def residual(self, q):
            raise ZeroDivisionError("by nothing")

    space = ConstrainedSpace(World(panda, Scene("empty", ())), Broken(0, 2, (0.0, 0.5), 0.5, 7))
    uniform, rng = Uniform(panda.lower, panda.upper), np.random.default_rng(0)
    query = Query.of(space, HOME, HOME[None] + 0.1, Budget(iterations=10), rng)
    with pytest.raises(ZeroDivisionError, match="by nothing"):
        BiRRT().search(query, uniform)


def test_algorithm_2_moves_codes_towards_a_constraint_in_python(panda):
    codebook = Codebook(model_of("vq_mpt"), panda)
    optimizer = LatentOptimizer(codebook, LatentSettings())
    rng = np.random.default_rng(0)
    moved = optimizer.optimize(codebook.vectors[:40], CIRCLE, rng)
    assert moved.g_after.mean() < 0.7 * moved.g_before.mean()


def test_regions_describe_themselves_and_bound_what_lies_between_states(panda):
    regions = RegionConstraint(panda, (upright(0.3), upright_box(0.2)))
    assert regions.describe().startswith("tilt 0 to 0.3 rad; rotation about y -0.2 to 0.2 rad")
    rng = np.random.default_rng(2)
    states = HOME + np.cumsum(0.02 * rng.standard_normal((50, 7)), axis=0)
    bound = regions.bound_between(states)
    at = np.abs(regions.residual(states)).max(axis=1)
    for k, (a, b) in enumerate(pairwise(states)):
        between = np.abs(regions.residual(np.linspace(a, b, 30))).max()
        assert between <= max(at[k], at[k + 1]) + bound[k] + 1e-12
    assert bound.shape == (49,) and CIRCLE.bound_between(states) is None
    residual = regions.residual(states)
    np.testing.assert_array_equal(regions.jacobian(states).shape, (50, residual.shape[1], 7))
