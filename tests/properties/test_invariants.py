"""Invariants of any input, tried on inputs that hypothesis draws and shrinks."""

import json
from functools import cache

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from random_arms import ARMS, WIDTHS, arm, problem_around
from scipy.spatial.transform import Rotation

from cvqmpt_lab.base.codec import from_plain, to_plain
from cvqmpt_lab.base.poses import Placement
from cvqmpt_lab.benchmarks.families import random_scene
from cvqmpt_lab.constraints.project import PROJECTION_TOLERANCE
from cvqmpt_lab.constraints.region_constraint import RegionConstraint
from cvqmpt_lab.constraints.task_space_region import FREE, TaskSpaceRegion, TaskSpaceRegionChain
from cvqmpt_lab.planning.pipeline import solve
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.load import panda
from cvqmpt_lab.search.birrt import BiRRT
from cvqmpt_lab.search.planner_interface import GaussianMixture, Query, Uniform
from cvqmpt_lab.search.result import Budget
from cvqmpt_lab.search.space import ConstrainedSpace
from cvqmpt_lab.vqmpt.codebook import CodeDecoder
from cvqmpt_lab.vqmpt.weights import load_vq_mpt

FEW = Budget(iterations=60)
STEP = 1e-6  # [rad or m] of finite differences
DRAWS = 4000  # from a mixture, to compare moments with

seeds = st.integers(0, 2**32 - 1)
arms = st.integers(0, ARMS - 1).map(arm)
metres = st.floats(-2.0, 2.0)
angles = st.floats(-np.pi, np.pi)
placements = st.builds(Placement, st.tuples(*[metres] * 3), st.tuples(*[angles] * 3))
half_widths = st.tuples(*[st.sampled_from(WIDTHS)] * 6).map(np.array)
bounds = half_widths.map(lambda halves: np.stack([-halves, halves], axis=1))
frames = placements.map(lambda placement: placement.matrix)
tilts = st.sampled_from([None, 0.0, 2e-4, 0.3, 2.0, 3.15])
# wide, narrow, a single value or no bound
regions = st.builds(TaskSpaceRegion, frames, frames, bounds, tilt=tilts)
shorts = st.sampled_from([1e-4, 1e-3, 0.01, 0.1])
shapes = st.integers(1, 4).map(lambda count: (count, 8))
latents = arrays(float, shapes, elements=st.floats(-1e3, 1e3))


@pytest.mark.promise("poses compose and invert", "cases")
@given(one=placements, other=placements, robot=arms, seed=seeds)
def test_poses(one, other, robot, seed):
    """A product with its inverse is the identity; the kernels find a hand where pinocchio does."""
    T = one.matrix @ other.matrix
    inverse = np.eye(4)
    inverse[:3, :3], inverse[:3, 3] = T[:3, :3].T, -T[:3, :3].T @ T[:3, 3]
    np.testing.assert_allclose(T @ inverse, np.eye(4), atol=1e-11)
    inverses = np.linalg.inv(other.matrix) @ np.linalg.inv(one.matrix)
    np.testing.assert_allclose(inverses, inverse, atol=1e-11)
    q = robot.random_configurations(np.random.default_rng(seed), 1)[0]
    hand = TaskSpaceRegion(robot.pose(q) @ np.linalg.inv(one.matrix), one.matrix, np.zeros((6, 2)))
    assert np.abs(RegionConstraint(robot, (hand,)).residual(q)).max() < 1e-9


@pytest.mark.promise("a projection is on the manifold inside limits, or none", "cases")
@given(robot=arms, region=regions, seed=seeds)
def test_projection(robot, region, seed):
    manifold = RegionConstraint(robot, (region,))
    for q in robot.random_configurations(np.random.default_rng(seed), 20):
        found = manifold.project(q)
        if found is not None:
            assert np.linalg.norm(manifold.residual(found)) <= PROJECTION_TOLERANCE
            assert robot.joint_outside_limits(found) is None


def slopes_agree(manifold, q, direction):
    """J is the derivative of F if no bound lies between the two states."""
    residual, jacobian = manifold.residual_and_jacobian(q)
    ahead, behind = (manifold.residual(q + side * STEP * direction) for side in (1.0, -1.0))
    slopes = (ahead - residual) / STEP, (residual - behind) / STEP
    smooth = np.abs(slopes[0] - slopes[1]) < 1e-3 * (1.0 + np.abs(slopes[0]))
    found = (jacobian @ direction)[smooth]
    np.testing.assert_allclose(found, slopes[0][smooth], rtol=1e-3, atol=1e-3)
    assert 2 * smooth.sum() >= len(smooth) and np.isfinite(jacobian).all()


@pytest.mark.promise("the Jacobian is the derivative of the residual", "cases")
@given(robot=arms, region=regions, seed=seeds)
def test_jacobian(robot, region, seed):
    rng = np.random.default_rng(seed)
    q, direction = robot.random_configurations(rng, 1)[0], rng.standard_normal(robot.dof)
    slopes_agree(RegionConstraint(robot, (region,)), q, direction)


@pytest.mark.promise(
    "the Jacobian is the derivative of the residual also near rotations of π and for regions "
    "relative to a moving link",
    "cases",
)
@given(robot=arms, short=shorts, in_chain=st.booleans(), seed=seeds)
def test_jacobian_near_half_a_turn(robot, short, in_chain, seed):
    """`short` [rad] of a rotation by pi between frame and hand; frame of the world or of link 1."""
    rng = np.random.default_rng(seed)
    q, direction = robot.random_configurations(rng, 1)[0], rng.standard_normal(robot.dof)
    axis = rng.standard_normal(3)
    turned = robot.pose(q)
    turn = Rotation.from_rotvec((np.pi - short) * axis / np.linalg.norm(axis))
    turned[:3, :3] @= turn.as_matrix().T
    Bw = np.array([[-FREE, FREE]] * 3 + [[-0.1, 0.1]] * 3)
    region = TaskSpaceRegion(turned, np.eye(4), Bw)
    if in_chain:
        in_link = np.linalg.inv(robot.pose(q, "link1")) @ turned
        region = TaskSpaceRegionChain(in_link, np.eye(4), Bw, "link1")
    slopes_agree(RegionConstraint(robot, (region,)), q, direction / np.linalg.norm(direction))


@cache
def decoder():
    model = load_vq_mpt(panda())
    return model.config.dictionary.code_dim, CodeDecoder(model, np.float64)


@pytest.mark.promise("any latent decodes to positive definite covariances", "cases")
@given(z=latents)
def test_decoder(z):
    width, decode = decoder()
    gaussians = decode.decode(np.resize(z, (len(z), width)))
    assert ((gaussians.mean >= 0.0) & (gaussians.mean <= 1.0)).all()  # no NaN either
    assert (np.linalg.eigvalsh(gaussians.covariance)[:, 0] > 0.0).all()


@pytest.mark.promise("samples of mixtures have the stated weights, means and covariances", "cases")
@given(seed=seeds, k=st.integers(1, 3), n=st.integers(1, 3), share=st.sampled_from([0.0, 0.2, 1.0]))
def test_mixture(seed, k, n, share):
    """Draws follow the mixture: weight, mean and spread of each Gaussian, and the uniform part."""
    rng = np.random.default_rng(seed)
    # each sample can be assigned to its Gaussian
    means = 100.0 * np.arange(k)[:, None] + rng.uniform(-1.0, 1.0, (k, n))
    roots = np.tril(rng.normal(size=(k, n, n)), -1) + rng.uniform(0.3, 2.0, (k, 1, n)) * np.eye(n)
    covariances, weights = roots @ roots.swapaxes(1, 2), rng.dirichlet(np.ones(k))
    uniform = Uniform(np.full(n, -2000.0), np.full(n, -1000.0))
    draws = GaussianMixture(means, covariances, weights, uniform, share).sample(rng, DRAWS)
    elsewhere = draws[:, 0] < -900.0
    far = 5.0 / np.sqrt(DRAWS)  # five standard errors of a share are at most half of this
    assert abs(elsewhere.mean() - share) < far
    whose = np.abs(draws[:, :1] - means[:, 0]).argmin(axis=1)
    for one in range(k):
        own = draws[(whose == one) & ~elsewhere]
        assert abs(len(own) / DRAWS - (1.0 - share) * weights[one]) < far
        if len(own) > 50 * n:
            white = np.linalg.solve(roots[one], (own - means[one]).T)
            assert np.abs(white.mean(axis=1)).max() < 6.0 / np.sqrt(len(own))
            assert np.abs(np.cov(white) - np.eye(n)).max() < 10.0 / np.sqrt(len(own))


@pytest.mark.promise("json round trips", "cases")
@given(seed=seeds, region=regions, placement=placements)
def test_json(seed, region, placement):
    """Every json value, or part of one, survives write, read and write again unchanged."""
    scene, robot = random_scene(seed % 1000, n_cubes=2, n_spheres=2), panda()
    shapes = [item.shape for item in scene.objects]
    for value in (region, placement, scene, *scene.objects, *shapes):
        read = from_plain(type(value), json.loads(json.dumps(to_plain(value), allow_nan=False)))
        assert read == value
        text = json.dumps(to_plain(read))  # of a value as read, in which -0.0 is 0.0
        assert json.dumps(to_plain(from_plain(type(value), json.loads(text)))) == text
    start = robot.random_configurations(np.random.default_rng(seed), 1)[0]
    regions = {"constraint": (region,), "goal_region": region}
    data = PlanningProblem("drawn", robot, scene, start, **regions).to_dict()
    assert PlanningProblem.from_dict(json.loads(json.dumps(data))).to_dict() == data


@pytest.mark.promise("trees are acyclic, of free nodes on the manifold", "cases")
@given(seed=seeds)
def test_trees(seed):
    """Parents precede children; nodes are free and on the manifold, edges within one step."""
    problem = problem_around(seed)
    if problem is None:
        return
    space, rng, search = ConstrainedSpace.of(problem), np.random.default_rng(seed), BiRRT()
    sampler = Uniform(problem.robot.lower, problem.robot.upper)
    checker = problem.collision_checker()
    query = Query.of(space, problem.start, problem.goals, FEW, rng)
    for tree in search.search(query, sampler).trees:
        children = np.flatnonzero(tree.parent >= 0)
        assert (tree.parent[children] < children).all() and (tree.parent >= -1).all()
        steps = np.linalg.norm(tree.nodes[children] - tree.nodes[tree.parent[children]], axis=1)
        kept = np.abs(tree.nodes).max(axis=1) < 1e5  # removed ones are put far away
        both, nodes = kept[children] & kept[tree.parent[children]], tree.nodes[kept]
        assert (steps[both] <= 2.0 * search.step + 1e-9).all()
        assert not checker.in_collision_batch(nodes).any()
        assert (
            np.linalg.norm(problem.manifold.residual(nodes), axis=1) <= PROJECTION_TOLERANCE
        ).all()


@pytest.mark.promise("paths begin and end where they should, certified", "cases")
@given(seed=seeds)
@example(268)  # F rose to its kink at a region's half turn between two states of a shortened motion
def test_paths(seed):
    problem = problem_around(seed)
    solution = problem and solve(problem, "birrt", FEW, seed=seed)
    if solution is None or solution.plan.path is None:
        return
    for path in (solution.plan.path, solution.path):
        np.testing.assert_array_equal(path.states[0], problem.start)
        assert (path.states[-1] == solution.goals).all(axis=1).any()
    assert solution.certificate.valid, solution.certificate.reasons
