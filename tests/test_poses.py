import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cvqmpt_lab.poses import rotation_matrices, rotation_vectors

SIZES = (0.0, 1e-9, 1e-4, 1e-3, 0.5, 3.0)


@pytest.mark.parametrize("size", SIZES)
def test_rotation_matrices_are_those_of_scipy_to_the_last_bit(size):
    """Starts and goals are drawn through them: another last digit would be another problem."""
    vectors = size * np.random.default_rng(0).normal(size=(500, 3))
    np.testing.assert_array_equal(rotation_matrices(vectors), Rotation.from_rotvec(vectors).as_matrix())


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 0.1, 2.0, np.pi - 1e-3, np.pi - 1e-7])
def test_rotation_vectors_of_matrices_are_those_of_scipy(angle):
    axes = np.random.default_rng(1).normal(size=(200, 3))
    matrices = Rotation.from_rotvec(angle * axes / np.linalg.norm(axes, axis=1, keepdims=True)).as_matrix()
    np.testing.assert_allclose(
        rotation_vectors(matrices), Rotation.from_matrix(matrices).as_rotvec(), atol=1e-12
    )
