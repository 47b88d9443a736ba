"""Motions proven free: no sample of them collides; the proof finds every sampled collision."""

from itertools import pairwise

import numpy as np
import pytest

from cvqmpt_lab.benchmarks.place_task import carried_can
from cvqmpt_lab.collision.exact import CollisionChecker
from cvqmpt_lab.collision.motion_proof import prove_free
from cvqmpt_lab.poses import pose
from cvqmpt_lab.scene.families import random_scene
from cvqmpt_lab.scene.scene import Attachment, Scene, SceneObject
from cvqmpt_lab.scene.shapes import Box, PointCloud

HOME = np.array([0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785])


def sampled(motion, spacing):
    """States of straight motions through rows of motion, at most `spacing` [rad] apart."""
    counts = (2 + int(np.linalg.norm(b - a) / spacing) for a, b in pairwise(motion))
    return np.concatenate(
        [np.linspace(a, b, n) for (a, b), n in zip(pairwise(motion), counts, strict=True)]
    )


@pytest.mark.parametrize("seed", range(3))
def test_proofs_and_samples_agree(panda, open_kitchen, seed):
    """Motions of three segments: proven free, or seen to collide, and never both."""
    scene = open_kitchen if seed == 0 else random_scene(seed)
    checker = CollisionChecker(panda, scene, (carried_can(),) if seed == 2 else ())
    rng = np.random.default_rng(seed)
    starts = [q for q in panda.random_configurations(rng, 160) if not checker.in_collision(q)][:60]
    verdicts = []
    for q in starts:
        motion = q + np.cumsum(rng.normal(0.0, 0.06, (4, 7)), axis=0)
        proof = prove_free(checker, motion)
        hits = checker.in_collision_batch(sampled(motion, 0.005)).any()
        assert not (hits and proof.colliding is None)
        if proof.colliding is None:
            assert proof.unproven is None
            assert not checker.in_collision_batch(sampled(motion, 0.001)).any()
        else:
            assert checker.in_collision(proof.colliding)
        verdicts.append(proof.colliding is None)
    assert 5 < sum(verdicts) < 60


def test_a_cloud_is_proven_like_any_obstacle(panda):
    down = np.array([HOME, HOME + (0.0, 0.5, 0.0, 0.0, 0.0, 0.0, 0.0)])
    points = panda.pose(down[1])[:3, 3] + np.random.default_rng(0).uniform(-0.02, 0.02, (2000, 3))
    scene = Scene("cloud", (SceneObject("cloud", PointCloud(points, 0.002), np.eye(4)),))
    checker = CollisionChecker(panda, scene)
    assert not checker.in_collision(HOME) and prove_free(checker, down).colliding is not None
    aside = prove_free(checker, np.array([HOME, HOME + 0.5 * np.eye(7)[0]]))
    assert aside.colliding is None and aside.unproven is None


@pytest.mark.parametrize("gap", [0.0, 1e-18, 1e-16])
def test_states_that_are_repeated_or_hardly_apart_change_nothing(panda, open_kitchen, gap):
    """OMPL's paths hold such states; late in a path a tiny step does not change its distance."""
    motion = HOME + np.linspace(0.0, 0.3, 20)[:, None] * np.eye(7)[5]
    apart = gap * np.tile([[0.0], [1.0], [2.0]], (20, 1)) * np.eye(7)[0]
    repeated = np.repeat(motion, 3, axis=0) + apart
    checker = CollisionChecker(panda, open_kitchen)
    plain, again = prove_free(checker, motion), prove_free(checker, repeated)
    assert plain.colliding is None and again.colliding is None
    assert again.looks == plain.looks and again.unproven is plain.unproven is None


@pytest.mark.parametrize(("thickness", "lever"), [(1e-6, 0.3), (1e-5, 0.3), (2e-4, 8.0)])
def test_a_thin_sheet_in_the_hand_is_seen_to_pass_through_another(panda, thickness, lever):
    """At the end of a long lever the overlap lasts less than 2e-4 rad."""
    rng, T_hand_tip = np.random.default_rng(0), pose((0.0, 0.0, lever))
    for way in rng.normal(0.0, 0.02, (5, 7)):
        before, middle, after = (
            panda.pose(HOME + share * way) @ T_hand_tip for share in (0.499, 0.5, 0.501)
        )
        normal = after[:3, 3] - before[:3, 3]
        side = np.cross(normal, rng.normal(size=3))
        R = np.stack([side, np.cross(normal, side), normal], axis=1)
        middle[:3, :3] = R / np.linalg.norm(R, axis=0)
        in_hand = np.linalg.inv(panda.pose(HOME + 0.5 * way)) @ middle
        scene = Scene("sheets", (SceneObject("wall", Box((0.1, 0.1, thickness)), middle),))
        sheet = Attachment("sheet", Box((0.05, 0.05, thickness)), in_hand)
        proof = prove_free(CollisionChecker(panda, scene, (sheet,)), np.array([HOME, HOME + way]))
        assert proof.colliding is not None


@pytest.mark.parametrize("seed", range(3))
def test_no_sampled_state_is_closer_than_the_least_distance_less_its_bound(
    panda, open_kitchen, seed
):
    scene = open_kitchen if seed == 0 else random_scene(seed)
    checker = CollisionChecker(panda, scene, (carried_can(),) if seed == 2 else ())
    rng, judged = np.random.default_rng(seed), 0
    for q in panda.random_configurations(rng, 60):
        motion = q + np.cumsum(rng.normal(0.0, 0.05, (4, 7)), axis=0)
        proof = prove_free(checker, motion, clearance=True)
        if proof.colliding is not None:
            continue
        judged += 1
        states = sampled(motion, 0.005)
        for least, nearest in (
            (proof.obstacles, checker.nearest_obstacle),
            (proof.itself, checker.nearest_of_itself),
        ):
            closest = min(nearest(state).distance for state in states)
            assert least.distance == pytest.approx(nearest(least.q).distance, abs=1e-9)
            assert least.distance - least.bound <= closest + 1e-6
            # distances above 0.1 m are proven to exceed 0.1 m only
            assert min(least.distance, 0.1) - closest <= max(1e-3, 0.2 * least.distance) + 1e-6
            assert least.bound <= max(1e-3, 0.2 * least.distance, least.distance - 0.08) + 1e-9
    assert judged > 5
