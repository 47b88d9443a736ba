"""Rows for tests that need no run."""

from cvqmpt_lab.results.row import ResultRow

CONFIGURATION = {"suite": "place", "cutoff_s": 10.0, "tolerance": {"rad": 0.1}}


def a_row(problem="place_0", planner="birrt", **values):
    defaults = {"suite": "place", "seed": 0, "backend": "compiled", "solved": True}
    return ResultRow(problem=problem, planner=planner, **{**defaults, "certified": True, **values})


def a_failure(problem="place_0", planner="birrt", **values):
    return a_row(problem, planner, solved=False, certified=None, **{"fail_reason": "timeout", **values})


def names(directory):
    return sorted(path.name for path in directory.iterdir())
