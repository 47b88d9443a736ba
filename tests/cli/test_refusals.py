"""Wrong command lines, from a table: each is one line that names the value and the cure."""

import csv
import shlex
from pathlib import Path

import pytest
from command_line import SCAN_START, refused

with Path(__file__).with_name("refused.csv").open(newline="") as file:
    TABLE = list(csv.DictReader(file))


@pytest.mark.parametrize("row", TABLE, ids=[row["command"] for row in TABLE])
def test_a_wrong_command_is_one_line(row, problem_file, scan_folder, capsys):
    """{problem} stands for a problem file, {scan} for a depth image, and so on; exit code 2."""
    before, depth, start = set(Path().iterdir()), scan_folder / "depth", SCAN_START
    extrinsics = f"--extrinsics {depth}.extrinsics.json"
    command = row["command"].replace("{problem}", str(problem_file))
    command = command.replace("{task}", "tests/data/task-1.json").replace("{path}", "x.csv")
    command = command.replace(
        "{scan}", f"{depth}.png --intrinsics {depth}.intrinsics.json {extrinsics}"
    )
    command = command.replace("{cloud}", f"--cloud {scan_folder / 'cloud.ply'} {extrinsics}")
    command = command.replace("{ends}", f"--start {start} --goal {start[1:]}")
    line = refused(capsys, *shlex.split(command.replace("{start}", start)))
    assert row["says"] in line and row["and says"] in line
    assert set(Path().iterdir()) == before
