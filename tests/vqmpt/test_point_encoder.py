"""Farthest points, balls and set abstraction against brute force."""

import numpy as np
import pytest
import torch

from cvqmpt_lab.vqmpt.config import SetAbstractionConfig
from cvqmpt_lab.vqmpt.published_network import (
    SetAbstraction,
    ball_query,
    farthest_point_sampling,
)


@pytest.fixture
def points():
    return torch.rand(2, 60, 3, generator=torch.Generator().manual_seed(0))


def near(cloud, centre, radius):
    return [n for n, point in enumerate(cloud) if ((point - centre) ** 2).sum().sqrt() < radius]


def farthest_by_hand(cloud, count):
    chosen = [0]
    while len(chosen) < count:
        to_chosen = [min(float(((p - cloud[c]) ** 2).sum()) for c in chosen) for p in cloud]
        chosen.append(int(np.argmax(to_chosen)))
    return chosen


def test_farthest_points(points):
    indices = farthest_point_sampling(points, 20)
    assert indices.tolist() == [farthest_by_hand(cloud, 20) for cloud in points]
    assert sorted(farthest_point_sampling(points, 60)[0].tolist()) == list(range(60))
    assert farthest_point_sampling(torch.zeros(1, 4, 3), 2).tolist() == [[0, 0]]


@pytest.mark.parametrize("pairs_at_once", [1, 500, 1 << 17])
@pytest.mark.parametrize("most", [3, 64])
def test_ball_query_takes_the_first_points_within_the_radius(points, most, pairs_at_once):
    centres = points[:, 5:17]
    found = ball_query(points, centres, 0.4, most, pairs_at_once)
    expected = [
        (60 * b + n, 12 * b + m)
        for b in range(2)
        for m in range(12)
        for n in near(points[b], centres[b, m], 0.4)[:most]
    ]
    assert list(zip(*(part.tolist() for part in found), strict=True)) == expected


def test_set_abstraction_is_the_maximum_over_a_perceptron_of_each_ball(points):
    module = SetAbstraction(
        4, SetAbstractionConfig(ratio=0.75, radius=0.3, widths=(8, 12), max_neighbours=5)
    )
    features = torch.rand(2, 60, 4)
    module(features, points)  # moves the running statistics of the batch norms
    module.eval()
    found, centres = module(features, points)
    assert found.shape == (2, 45, 12)
    chosen = farthest_point_sampling(points, 45)
    for b in range(2):
        for m in range(45):
            centre, messages = points[b, chosen[b, m]], []
            for n in near(points[b], centre, 0.3)[:5]:
                x = torch.cat((features[b, n], points[b, n] - centre))
                for linear, _, norm in module.conv.local_nn:
                    x = (linear.weight @ x + linear.bias).clamp(min=0.0) - norm.running_mean
                    x = x / torch.sqrt(norm.running_var + 1e-5) * norm.weight + norm.bias
                messages.append(x)
            expected = torch.stack(messages).max(0).values
            torch.testing.assert_close(found[b, m], expected, rtol=1e-4, atol=1e-5)
            torch.testing.assert_close(centres[b, m], centre)
