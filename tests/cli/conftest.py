"""A problem file that tests may change."""

import json

import pytest


@pytest.fixture
def data(problem):
    """The json form of a place problem with one goal."""
    return json.loads(json.dumps(problem.changed(goals=problem.goals[:1]).to_dict()))


@pytest.fixture
def problem_file(tmp_path, data):
    path = tmp_path / "mine.json"
    path.write_text(json.dumps(data))
    return path
