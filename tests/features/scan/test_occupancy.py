"""Occupancy maps have the cells of points and unknown cells, which no ray crosses."""

from dataclasses import replace

import numpy as np
import pytest
from refusals import refused

from cvqmpt_lab.base.poses import pose
from cvqmpt_lab.collision.exact import CollisionChecker
from cvqmpt_lab.features.scan.scan import Arm, MapSettings, occupancy_map, unseen_share
from cvqmpt_lab.scene.cloud_files import Cloud
from cvqmpt_lab.scene.scene import Scene, SceneObject

EYE = np.array([-1.0, 0.05, 0.45])
ROOM = MapSettings(unknown="occupied", lower=(-0.5, -0.5, 0.0), upper=(1.0, 0.5, 0.8))


def grid(spacing, x, half=0.5, height=0.8):
    """Points of a grid on the plane at `x`."""
    y, z = np.meshgrid(np.arange(-half, half, spacing), np.arange(0.0, height, spacing))
    return np.column_stack([np.full(y.size, x), y.ravel(), z.ravel()])


def occupied(scanned, places):
    """Return for each place (k, 3) [m] whether it is in an occupied cell."""
    taken = set(map(tuple, scanned.cells.astype(int)))
    cells = np.floor(np.array(places) / scanned.resolution).astype(int)
    return [tuple(cell) in taken for cell in cells]


def sight(origin, points):
    """Capture of world points (m, 3) by a camera at origin (3,)."""
    return Cloud(points - origin, T_world_camera=pose(origin))


def test_cells_behind_a_surface_are_unknown(panda):
    """A plate at x = 0.2 seen from -1: free in front, unknown behind, known next to its shadow."""
    plate, back = grid(0.01, 0.2, half=0.15, height=0.3), grid(0.01, 1.5, half=2.0, height=2.0)
    to_plate = (back - EYE) * ((0.2 - EYE[0]) / (1.5 - EYE[0]))
    hidden = (np.abs(EYE[1] + to_plate[:, 1]) < 0.16) & (EYE[2] + to_plate[:, 2] < 0.31)
    seen = [sight(EYE, np.concatenate([plate, back[~hidden]]))]
    scanned = occupancy_map(plate, ROOM, seen)
    before, on, behind, above = (0.0, 0.0, 0.2), (0.205, 0.0, 0.1), (0.5, 0.0, 0.1), (0.5, 0.0, 0.7)
    assert occupied(scanned, [before, on, behind, above]) == [False, True, True, False]
    q = np.array([0.0, 0.9, 0.0, -1.9, 0.0, 2.8, 0.8])
    hand = panda.pose(q)[:3, 3]
    assert 0.3 < hand[0] < 0.7 and occupied(scanned, [hand]) == [True]
    spared = occupancy_map(plate, ROOM, seen, Arm(panda, q))
    assert occupied(spared, [hand, on, (0.95, 0.0, 0.05)]) == [False, True, True]
    coarse = replace(ROOM, resolution=0.1, robot_margin=0.0)
    for arm, meets in ((None, True), (Arm(panda, q), False)):
        unseen = SceneObject("map", occupancy_map(plate[:0], coarse, seen, arm), np.eye(4))
        assert CollisionChecker(panda, Scene("unseen", (unseen,))).in_collision(q) == meets


def test_rays_cross_the_cells_of_fine_samples_along_them():
    rng = np.random.default_rng(1)
    ends = rng.uniform(-2.0, 2.0, (40, 3))
    origin = np.array([0.31, -0.12, 0.4])
    scanned = occupancy_map(np.empty((0, 3)), ROOM, [sight(origin, ends)])
    to_cells = (np.floor(ends / 0.02) + 0.5) * 0.02
    walked = origin + np.linspace(0.0, 1.0, 4000)[:, None, None] * (to_cells - origin)
    above, below = walked > np.add(ROOM.lower, 1e-6), walked < np.subtract(ROOM.upper, 1e-6)
    inside = (above & below).all(axis=-1)
    assert inside.sum() > 1000 and not any(occupied(scanned, walked[inside]))
    box = np.prod(np.round(np.subtract(ROOM.upper, ROOM.lower) / 0.02))
    few = len(np.unique(np.floor(walked[inside] / 0.02), axis=0))
    assert 0.97 * few <= box - len(scanned.cells) <= 1.1 * few


def test_only_what_a_measured_body_hides_is_in_the_shadow(panda):
    """A plate at x = 0.2: behind it is the shadow; beside it, where no ray went, all stays free."""
    plate = grid(0.01, 0.2, half=0.15, height=0.3)
    seen, shadow = [sight(EYE, plate)], replace(ROOM, unknown="shadow")
    scanned = occupancy_map(plate, shadow, seen)
    before, on, behind = (0.0, 0.0, 0.2), (0.205, 0.0, 0.1), (0.6, 0.0, 0.1)
    beside, above = (0.3, 0.4, 0.1), (0.5, 0.0, 0.7)
    assert occupied(scanned, [before, on, behind, beside, above]) == [
        False,
        True,
        True,
        False,
        False,
    ]
    everything = occupancy_map(plate, ROOM, seen)
    assert {*map(tuple, scanned.cells)} < {*map(tuple, everything.cells)}
    centres = scanned.centres[~(np.abs(scanned.centres[:, 0] - 0.21) < 1e-6)]
    met = EYE + (centres - EYE) * ((0.2 - EYE[0]) / (centres[:, :1] - EYE[0]))
    assert (np.abs(met[:, 1]) < 0.17).all() and (met[:, 2] < 0.33).all(), "on rays of the plate"
    small = occupancy_map(plate, replace(shadow, upper=(0.4, 0.5, 0.8)), seen)
    assert small.centres[:, 0].max() < 0.4 and occupied(small, [(0.3, 0.0, 0.1)]) == [True]
    q = np.array([0.0, 0.9, 0.0, -1.9, 0.0, 2.8, 0.8])
    hand = panda.pose(q)[:3, 3]
    assert occupied(scanned, [hand]) == [True]
    spared = occupancy_map(plate, shadow, seen, Arm(panda, q))
    assert occupied(spared, [hand, on]) == [False, True]
    obstacle = Scene("map", (SceneObject("map", spared, np.eye(4)),))
    assert not CollisionChecker(panda, obstacle).in_collision(q)


def test_a_shadow_of_another_camera_is_free_where_one_looks_behind():
    plate = grid(0.01, 0.2, half=0.15, height=0.3)
    other = np.array([1.6, 0.05, 0.45])
    shadow = replace(ROOM, unknown="shadow")
    two = occupancy_map(plate, shadow, [sight(EYE, plate), sight(other, plate)])
    one = occupancy_map(plate, shadow, [sight(EYE, plate)])
    behind, on = (0.6, 0.0, 0.2), (0.205, 0.0, 0.1)
    assert occupied(one, [behind, on]) == [True, True]
    assert occupied(two, [behind, on]) == [False, True]


@pytest.mark.parametrize("unknown", ["shadow", "occupied"])
def test_what_a_camera_at_an_unknown_place_did_not_see_is_not_guessed(unknown):
    """Rays from the robot's base freed cells that nobody had seen."""
    plate = grid(0.01, 0.2)
    told = refused(
        "no camera's pose", occupancy_map, plate, replace(ROOM, unknown=unknown), [Cloud(plate)]
    )
    assert f"unknown cells are to be {unknown}" in told and "--extrinsics or --level" in told


def test_shadows_do_not_count_as_free():
    plate = grid(0.01, 0.2)
    seen, shadow = (
        [sight(EYE, plate)],
        replace(ROOM, unknown="shadow", lower=(-1.0,) * 3, upper=(1.0,) * 3),
    )
    unseen = unseen_share(seen, 1.0)
    assert 0.05 < unseen - unseen_share(seen, 1.0, shadows=shadow) < 0.5
