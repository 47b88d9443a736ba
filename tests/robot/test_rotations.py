"""Rotations of files are scipy's to the last bit, without its import."""

import numpy as np
from scipy.spatial.transform import Rotation

from cvqmpt_lab.poses import Placement


def test_angles_and_quaternions_are_scipys_to_the_last_bit():
    rng = np.random.default_rng(0)
    for angles in [np.zeros(3), np.array([0.0, np.pi / 2, 0.0]), *rng.uniform(-6.2, 6.2, (300, 3))]:
        expected = Rotation.from_euler("xyz", angles).as_matrix()
        assert np.array_equal(Placement(rpy=tuple(angles)).matrix[:3, :3], expected)
    for q in rng.normal(size=(300, 4)):
        q *= rng.uniform(0.9992, 1.0008) / np.linalg.norm(q)
        expected = Rotation.from_quat(q).as_matrix()
        assert np.array_equal(Placement(quaternion=tuple(q)).matrix[:3, :3], expected)
