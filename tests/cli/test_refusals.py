"""Wrong command lines, from a table: each is one line that names the value and the cure."""

import csv
import shlex
from pathlib import Path

import pytest
from command_line import refused

with Path(__file__).with_name("refused.csv").open(newline="") as file:
    TABLE = list(csv.DictReader(file))


@pytest.mark.parametrize("row", TABLE, ids=[row["command"] for row in TABLE])
def test_a_wrong_command_is_one_line(row, problem_file, capsys):
    """{problem} stands for a problem file; the exit code is 2."""
    before = set(Path().iterdir())
    line = refused(capsys, *shlex.split(row["command"].replace("{problem}", str(problem_file))))
    assert row["says"] in line and row["and says"] in line
    assert set(Path().iterdir()) == before
