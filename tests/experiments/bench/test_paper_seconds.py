"""Seconds of searches in PyBullet: its checks, residual and Jacobian are ours; ratios."""

import numpy as np
import pytest

from cvqmpt_lab.collision.world import World
from cvqmpt_lab.experiments.bench.paper_check import Simulator
from cvqmpt_lab.experiments.bench.paper_seconds import SimulatedSpace, Timed, ratios
from cvqmpt_lab.experiments.bench.stage_times import tuning_problems
from cvqmpt_lab.search.motion import PROJECTIONS, STATE_CHECKS
from cvqmpt_lab.search.space import ConstrainedSpace


def test_operations_of_pybullet_are_those_of_the_compiled_code():
    pytest.importorskip("pybullet")
    (problem,) = tuning_problems(1)
    ours = ConstrainedSpace(World(problem.robot, problem.scene), problem.manifold)
    configurations = problem.robot.random_configurations(np.random.default_rng(3), 10)
    with Simulator(problem) as simulator:
        space = SimulatedSpace(problem, simulator)
        assert [space.valid(q) for q in configurations] == [ours.valid(q) for q in configurations]
        for q in configurations:
            for found, known in zip(
                space.residual_and_jacobian(q), ours.residual_and_jacobian(q), strict=True
            ):
                np.testing.assert_allclose(found, known, atol=1e-5)
        projected = [q for q in configurations if space.project(q)]
        assert projected and space.tally[[STATE_CHECKS, PROJECTIONS]].tolist() == [10, 10]
        assert all(np.linalg.norm(ours.residual_and_jacobian(q)[0]) < 2e-4 for q in projected)


def test_ratios_are_of_means_over_problems():
    runs = [
        Timed(planner, str(k), True, 1, 1, 1, scale * (k + 1.0), k + 1.0, (k + 1.0) / 2)
        for planner, scale in (("a", 2.0), ("b", 1.0))
        for k in range(12)
    ]
    found = {line.name: (line.median, line.low, line.high) for line in ratios(runs)}
    assert found["a: measured / predicted seconds"] == (2.0, 2.0, 2.0)
    assert found["b: measured / published seconds"] == (2.0, 2.0, 2.0)
    assert found["b / a, measured"] == (0.5, 0.5, 0.5)
    assert found["b / a, predicted"] == (1.0, 1.0, 1.0)
