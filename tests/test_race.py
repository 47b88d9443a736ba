"""Runs in threads with several seeds: the winner alone finds the same path; all of them end."""

import threading

import numpy as np
import pytest
from refusals import refused

from cvqmpt_lab.benchmarks.passages import maze_problem
from cvqmpt_lab.planning.pipeline import solve
from cvqmpt_lab.planning.race import first_of
from cvqmpt_lab.search.result import Budget

ENOUGH = Budget(iterations=20_000)


@pytest.mark.parametrize("planner", ["roadmap", "birrt", "cells"])
def test_the_winner_alone_finds_the_same_path(planner):
    maze = maze_problem(0.1, 1)
    raced = solve(maze, planner, ENOUGH, 5, cores=2)
    assert raced.solved and raced.seed in (5, 6) and raced.seeds == 2
    assert f"--seed {raced.seed} repeats it" in str(raced.report())
    alone = solve(maze, planner, ENOUGH, raced.seed)
    np.testing.assert_array_equal(raced.path.states, alone.path.states)
    assert raced.plan.counters == alone.plan.counters


def test_without_a_path_the_first_seed_is_reported(problem):
    raced = solve(problem, "birrt", Budget(iterations=1), 3, cores=2)
    assert not raced.solved and raced.seed == 3


def test_searches_that_need_one_thread_are_refused(problem):
    for planner in ("ompl-projected", "cvq-mpt"):
        refused(f"cores: {planner} runs in one thread", solve, problem, planner, ENOUGH, 0, cores=2)
    refused("cores 65: give a number from 1 to 64", solve, problem, "birrt", ENOUGH, 0, cores=65)


class Waits:
    """A run that ends when it is asked to."""

    won = False

    def __init__(self):
        self.stopped = threading.Event()
        self.has_ended = False

    def ended(self):
        self.stopped.wait(timeout=20.0)
        self.has_ended = True
        return self

    def stop(self):
        self.stopped.set()


@pytest.mark.parametrize("error", [KeyboardInterrupt, ValueError])
def test_an_error_in_one_thread_ends_all(error):
    class Breaks(Waits):
        def ended(self):
            raise error

    waits, before = Waits(), threading.active_count()
    with pytest.raises(error):
        first_of([waits, Breaks()])
    assert waits.stopped.is_set() and waits.has_ended and threading.active_count() == before
