"""What holds for any input, tried on inputs that hypothesis draws, and makes small when they break it."""

from functools import cache

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from cvqmpt_lab.constraints.task_space_region import TOLERANCE, RegionConstraint, TaskSpaceRegion
from cvqmpt_lab.poses import Placement
from cvqmpt_lab.prediction.code_decoder import CodeDecoder
from cvqmpt_lab.prediction.weights import load_vq_mpt
from cvqmpt_lab.robot.loading import load_robot, panda
from experiments.trust.random_robots import TOOL, random_urdf

FEW = settings(max_examples=30, deadline=None, derandomize=True, database=None)
ARMS = 12

seeds = st.integers(0, 2**32 - 1)
metres = st.floats(-2.0, 2.0)
angles = st.floats(-np.pi, np.pi)
placements = st.builds(Placement, st.tuples(metres, metres, metres), st.tuples(angles, angles, angles))


@st.composite
def regions(draw):
    """Regions with frames anywhere, whose bounds are wide, narrow, a single value or none."""
    width = st.sampled_from([0.0, 2e-4, 0.1, 1.0, np.inf])
    halves = np.array([draw(width) for _ in range(6)])
    return TaskSpaceRegion(
        draw(placements).matrix, draw(placements).matrix, np.stack([-halves, halves], axis=1)
    )


@cache
def arm(number, folder):
    path = folder / f"arm{number}.urdf"
    path.write_text(random_urdf(np.random.default_rng(number)))
    return load_robot(path, TOOL)


@FEW
@given(placements)
def test_a_pose_and_its_inverse_make_the_identity(placement):
    T = placement.matrix
    inverse = np.eye(4)
    inverse[:3, :3], inverse[:3, 3] = T[:3, :3].T, -T[:3, :3].T @ T[:3, 3]
    np.testing.assert_allclose(T @ inverse, np.eye(4), atol=1e-12)
    assert abs(np.linalg.det(T[:3, :3]) - 1.0) < 1e-12


@FEW
@given(st.integers(0, ARMS - 1), regions(), seeds)
def test_a_projection_lies_on_the_manifold_inside_the_limits_or_is_none(
    tmp_path_factory, number, region, seed
):
    """On arms of two to nine joints, hinges and sliders."""
    robot = arm(number, tmp_path_factory.getbasetemp())
    manifold = RegionConstraint(robot, (region,))
    for q in robot.random_configurations(np.random.default_rng(seed), 20):
        found = manifold.project(q)
        if found is not None:
            assert np.linalg.norm(manifold.residual(found)) <= TOLERANCE
            assert robot.joint_outside_limits(found) is None


@FEW
@given(st.integers(0, ARMS - 1), regions(), seeds)
def test_the_jacobian_is_the_slope_of_the_residual(tmp_path_factory, number, region, seed):
    robot = arm(number, tmp_path_factory.getbasetemp())
    manifold = RegionConstraint(robot, (region,))
    rng = np.random.default_rng(seed)
    q, direction = robot.random_configurations(rng, 1)[0], rng.standard_normal(robot.dof)
    residual, jacobian = manifold.residual_and_jacobian(q)
    step = 1e-6
    ahead, behind = (manifold.residual(q + side * step * direction) for side in (1.0, -1.0))
    slopes = (ahead - residual) / step, (residual - behind) / step
    smooth = np.abs(slopes[0] - slopes[1]) < 1e-3 * (1.0 + np.abs(slopes[0]))  # else a bound lies between
    np.testing.assert_allclose((jacobian @ direction)[smooth], slopes[0][smooth], rtol=1e-3, atol=1e-3)
    assert 2 * smooth.sum() >= len(smooth)


@FEW
@given(arrays(float, st.integers(1, 4).map(lambda count: (count, 8)), elements=st.floats(-1e3, 1e3)))
def test_any_latent_decodes_to_a_gaussian_with_a_positive_definite_covariance(z):
    model = load_vq_mpt(panda())
    width = model.config.dictionary.code_dim
    gaussians = CodeDecoder(model, np.float64).decode(np.resize(z, (len(z), width)))
    covariance = gaussians.scale @ gaussians.scale.transpose(0, 2, 1)
    assert np.isfinite(gaussians.mean).all() and ((gaussians.mean >= 0.0) & (gaussians.mean <= 1.0)).all()
    assert (np.linalg.eigvalsh(covariance)[:, 0] > 0.0).all()
