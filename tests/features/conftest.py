"""Fixtures of the tests of pictures and recordings."""

from collections import Counter

import pytest
from rerun.chunk import RrdReader

from cvqmpt_lab.planning.pipeline import solve
from cvqmpt_lab.search.result import Budget


@pytest.fixture(scope="package")
def unsolved(problem):
    """Result of `problem` with too little time."""
    return solve(problem, "birrt", Budget(iterations=1), seed=0)


@pytest.fixture(scope="session")
def recorded():
    """Counts the rows per entity of a recording on a timeline."""

    def rows_of(path, timeline="path_state"):
        rows = Counter()
        for chunk in RrdReader(path).stream():
            rows[chunk.entity_path] += chunk.num_rows * (timeline in chunk.timeline_names)
        return rows

    return rows_of
