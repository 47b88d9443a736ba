"""The pairs of links that sampling leaves out: which, always the same, kept as an SRDF file."""

import tempfile

import numpy as np
import pinocchio as pin
import pytest

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.robot.loading import load_robot
from cvqmpt_lab.robot.robot import LeftOut
from cvqmpt_lab.robot.self_collision import NEAR, cache_file, read_srdf, srdf_text

TOOL = 'size="0.02 0.06 0.02"'


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    """A cache folder of the test's own."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache"


def test_a_pair_that_is_not_checked_never_comes_near_or_nearly_always_overlaps(edited):
    """On configurations other than those that decided; a large tool makes pairs of every kind."""
    robot = load_robot(edited((TOOL, 'size="0.4 0.4 0.4"')), "tool")
    reasons = {frozenset((p.first, p.second)): p.reason for p in robot.left_out_pairs}
    assert {"Adjacent", "Never"} <= set(reasons.values())
    geometry = pin.GeometryModel(robot.collision_model)
    geometry.addAllCollisionPairs()
    names = [
        frozenset(geometry.geometryObjects[i].name[:-2] for i in (p.first, p.second))
        for p in geometry.collisionPairs
    ]
    data, geometry_data = robot.model.createData(), pin.GeometryData(geometry)
    least = np.full(len(names), np.inf)
    for q in robot.random_configurations(np.random.default_rng(7), 500):
        pin.computeDistances(robot.model, data, geometry, geometry_data, q)
        least = np.minimum(least, [result.min_distance for result in geometry_data.distanceResults])
    for name, distance in zip(names, least, strict=True):
        if reasons.get(name) == "Never":
            assert distance > 0.5 * NEAR
        if name not in reasons:
            assert distance < 5.0 * NEAR


def test_the_pairs_are_kept_and_a_spoilt_file_is_replaced(slider_arm_urdf, cache):
    robot = load_robot(slider_arm_urdf, "tool")
    (kept,) = (cache / "cvqmpt_lab" / "self_collision").iterdir()
    assert kept == cache_file(robot.model, robot.links) and read_srdf(kept) == robot.left_out_pairs
    kept.write_text(srdf_text("x", [LeftOut("base", "tool", "Never")]))
    assert len(load_robot(slider_arm_urdf, "tool").left_out_pairs) == 1, "the file is what counts"
    kept.chmod(0o666)
    assert load_robot(slider_arm_urdf, "tool").left_out_pairs == robot.left_out_pairs, "others could write it"
    kept.chmod(0o644)
    whole = srdf_text(robot.name, robot.left_out_pairs)
    kept.write_text(whole[: len(whole) // 2])
    again = load_robot(slider_arm_urdf, "tool")
    assert again.left_out_pairs == robot.left_out_pairs and kept.read_text() == whole


def test_without_a_place_for_the_cache_pairs_are_sampled_all_the_same(slider_arm_urdf, tmp_path, monkeypatch):
    expected = load_robot(slider_arm_urdf, "tool").left_out_pairs
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    assert load_robot(slider_arm_urdf, "tool").left_out_pairs == expected


@pytest.mark.parametrize(("text", "pattern"), [("<robot", "cannot read SRDF"), ("<a/>", "root <a>")])
def test_a_file_that_is_no_srdf_is_named(slider_arm_urdf, tmp_path, refused, text, pattern):
    (tmp_path / "bad.srdf").write_text(text)
    refused(InvalidInputError, pattern, load_robot, slider_arm_urdf, "tool", srdf=tmp_path / "bad.srdf")
