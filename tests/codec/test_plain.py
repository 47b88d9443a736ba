"""The codec reads and writes JSON; `test_wrong_files` has the refusals."""

import re

import numpy as np
import pytest
from refusals import refused
from scipy.spatial.transform import Rotation

from cvqmpt_lab.base.codec import from_plain, to_plain
from cvqmpt_lab.base.poses import Placement, pose, rotation_matrices
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.scene.scene import Attachment

BALL = {"type": "sphere", "radius": 0.1}
CAN = {"name": "can", "shape": BALL, "T_hand_object": {"xyz": [1.0, 0.0, 0.0]}}


def test_defaults_are_left_out_and_may_be_missing_unless_complete():
    can = from_plain(Attachment, CAN)
    assert to_plain(can) == CAN
    assert to_plain(can, complete=True)["mass"] is None
    message = "mass is missing; fields: name, shape, T_hand_object"
    refused(message, from_plain, Attachment, CAN, complete=True)


def test_poses_have_three_forms_in_json():
    def placed(data):
        return from_plain(Attachment, CAN | {"T_hand_object": data}).T_hand_object

    turned = pose((1.0, 2.0, 3.0), np.pi / 2)
    quaternion = [0, 0, np.sqrt(0.5), np.sqrt(0.5)]
    turns = {"rpy": [0, 0, np.pi / 2]}, {"quaternion": quaternion}
    for data in (turned.tolist(), *({"xyz": [1, 2, 3], **turn} for turn in turns)):
        np.testing.assert_allclose(placed(data), turned, atol=1e-15)
    roll_first = placed({"rpy": [np.pi / 2, 0.0, np.pi / 2]})[:3, :3] @ (0, 1, 0)
    np.testing.assert_allclose(roll_first, (0, 0, 1), atol=1e-15)  # about the fixed x


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"goals": ' + "1" * 5000 + "}", "mine.json is not json"),
        ("[]", "mine.json must hold one json object"),
        ('{"goals": []}', "mine.json: schema is None; this version reads 'cvqmpt-problem/1'"),
        ('{"points": []}', "schema is None, a motion (cvqmpt certify MOTION PROBLEM judges it); "),
        ('{"schema": [], "goals": []}', "mine.json: schema is []; this version"),
    ],
)
def test_a_file_that_cannot_be_read_is_named_in_one_line(tmp_path, text, message):
    path = tmp_path / "mine.json"
    path.write_text(text)
    assert len(refused(re.escape(message), PlanningProblem.load, path)) < 400


def test_angles_and_quaternions_are_scipys_to_the_last_bit():
    rng = np.random.default_rng(0)
    for angles in [np.zeros(3), np.array([0.0, np.pi / 2, 0.0]), *rng.uniform(-6.2, 6.2, (300, 3))]:
        expected = Rotation.from_euler("xyz", angles).as_matrix()
        assert np.array_equal(Placement(rpy=tuple(angles)).matrix[:3, :3], expected)
    for q in rng.normal(size=(300, 4)):
        q *= rng.uniform(0.9992, 1.0008) / np.linalg.norm(q)
        expected = Rotation.from_quat(q).as_matrix()
        assert np.array_equal(Placement(quaternion=tuple(q)).matrix[:3, :3], expected)


def test_rotation_vectors_become_the_rotations_of_scipy_bit_for_bit():
    rng = np.random.default_rng(0)
    vectors = rng.standard_normal((200, 3)) * 10.0 ** rng.uniform(-5.0, 0.5, (200, 1))
    vectors[0] = 0.0
    assert np.array_equal(rotation_matrices(vectors), Rotation.from_rotvec(vectors).as_matrix())
    assert rotation_matrices(vectors[:0]).shape == (0, 3, 3)
