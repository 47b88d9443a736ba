"""Problem files of two hands that are wrong: each one line that says what, and by how much."""

import json

import pytest
from command_line import refused

from cvqmpt_lab.benchmarks.two_arms import two_arms_problem

OFF = 0.05  # [rad] of a wrist at the start


@pytest.fixture(scope="module")
def tray():
    """The json form of a tray that baxter's hands carry over a table."""
    return json.dumps(two_arms_problem(0).to_dict())


def test_a_start_off_the_chain_is_refused_with_F_or_projected(cvqmpt, capsys, tray, tmp_path):
    data, path = json.loads(tray), tmp_path / "mine.json"
    data["start"][6] += OFF
    path.write_text(json.dumps(data))
    line = refused(capsys, "plan", "--problem-file", path)
    assert f"start breaks `pose` by {OFF:g} rad" in line and "|F| = 0.0" in line
    assert "--project-start" in line
    assert "certificate valid" in cvqmpt("plan --project-start --problem-file", path)
