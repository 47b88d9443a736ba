"""Where shorter paths are looked for."""

import numpy as np

from cvqmpt_lab.search.anytime import ShortWays

LOWER, UPPER = np.full(7, -9.0), np.full(7, 9.0)


def test_spheroid_keeps_detours_short():
    rng = np.random.default_rng(0)
    start, goal = np.zeros(7), np.array([1.0, 0.5, 0.0, 0.0, 0.0, -0.5, 0.2])
    samples = ShortWays(start, goal[None], np.array([1.5]), LOWER, UPPER).sample(rng, 2000)
    detour = np.linalg.norm(samples - start, axis=1) + np.linalg.norm(samples - goal, axis=1)
    assert detour.max() <= 1.5 + 1e-9
    assert detour.max() > 1.49 and np.abs(samples.mean(axis=0) - goal / 2).max() < 0.02


def test_short_ways_are_shared_out_among_goals_and_never_longer_than_told():
    rng, start = np.random.default_rng(0), np.zeros(7)
    goals, lengths = np.array([np.eye(7)[0], 3.0 * np.eye(7)[1]]), np.array([1.1, 3.3])
    samples = ShortWays(start, goals, lengths, LOWER, UPPER).sample(rng, 1000)
    to_goals = np.linalg.norm(samples[:, None] - goals, axis=2)
    detours = np.linalg.norm(samples - start, axis=1)[:, None] + to_goals
    within = detours <= lengths + 1e-9
    assert samples.shape == (1000, 7) and within.any(axis=1).all()
    assert (within.sum(axis=0) > 400).all()


def test_a_goal_where_the_start_is_leaves_a_ball():
    here = np.ones(7)
    ways = ShortWays(here, here[None], np.array([0.5]), LOWER, UPPER)
    samples = ways.sample(np.random.default_rng(0), 100)
    assert (
        np.isfinite(samples).all() and np.linalg.norm(samples - here, axis=1).max() <= 0.25 + 1e-9
    )
