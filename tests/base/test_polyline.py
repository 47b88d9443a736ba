"""Polylines: places, cuts and stretches against dense sampling."""

import numpy as np
import pytest

from cvqmpt_lab.base.polyline import (
    Polyline,
    cut,
    distances_along,
    evenly_along,
    nearest_places,
    parts_within,
    states_at,
    step_lengths,
)


@pytest.fixture
def states():
    walked = np.cumsum(np.random.default_rng(0).normal(0.0, 0.2, (12, 4)), axis=0)
    walked[5] = walked[4]  # a step of length 0
    return walked


def test_a_cut_keeps_the_states_and_makes_even_parts(states):
    counts = parts_within(states, 0.07)
    fine = cut(states, counts)
    assert np.array_equal(fine[np.concatenate([[0], np.cumsum(counts)])], states)
    assert step_lengths(fine).max() <= 0.07 + 1e-12
    np.testing.assert_allclose(step_lengths(fine), np.repeat(step_lengths(states) / counts, counts))
    assert distances_along(fine)[-1] == pytest.approx(distances_along(states)[-1])


def test_even_states_have_even_distances_along(states):
    along = distances_along(states)
    found = evenly_along(states, 0.1)
    marks = np.linspace(0.0, along[-1], len(found))
    assert marks[1] <= 0.1 and np.array_equal(found[[0, -1]], states[[0, -1]])
    np.testing.assert_allclose(found, states_at(states, along, marks))


def test_the_nearest_place_is_that_of_dense_sampling(states):
    points = states[:9] + np.random.default_rng(1).normal(0.0, 0.1, (9, 4))
    places, distances = nearest_places(states, points)
    marks = np.arange(len(states))
    fine = np.linspace(0.0, len(states) - 1.0, 200_000)
    sampled = states_at(states, marks, fine)
    for point, place, distance in zip(points, places, distances, strict=True):
        off = np.linalg.norm(sampled - point, axis=1)
        assert distance <= off.min() + 1e-12 and off.min() - distance < 1e-5
        found = states_at(states, marks, np.array([place]))
        assert np.linalg.norm(found - point) == pytest.approx(distance)


def test_a_stretch_has_its_middle_its_ends_and_the_states_between(states):
    line, along = Polyline(states), distances_along(states)
    begins = np.linspace(0.0, 0.8 * line.length, 7)
    halves = np.full(7, 0.1 * line.length)
    middles, hulls = line.stretches(begins, halves)
    np.testing.assert_allclose(middles, states_at(states, along, begins + halves), atol=1e-12)
    for begin, half, hull in zip(begins, halves, hulls, strict=True):
        inside = (along > begin) & (along < begin + 2.0 * half)
        ends = states_at(states, along, np.array([begin, begin + 2.0 * half]))
        for state in (*states[inside], *ends):
            assert np.abs(hull - state).max(axis=1).min() < 1e-12
        assert len(np.unique(hull.round(9), axis=0)) <= inside.sum() + 2


def test_a_polyline_that_stands_still_is_one_state(states):
    line = Polyline(np.repeat(states[:1], 3, axis=0))
    middles, hulls = line.stretches(np.zeros(1), np.zeros(1))
    assert line.length == 0.0 and np.array_equal(middles, states[:1])
    assert np.array_equal(hulls, states[None, :1])
