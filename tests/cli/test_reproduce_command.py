"""`cvqmpt reproduce`: the files it writes, and folders that it refuses."""

import os

import pytest
from command_line import refused

from cli.main import main


def test_it_writes_its_files_and_refuses_to_mix_them_with_another_run(capsys, tmp_path):
    words = ["reproduce", "place-task", "--problems", "1", "--planners", "birrt", "--jobs", "1"]
    words += ["--out", str(tmp_path)]
    assert main([*words, "--iterations", "20000"]) == 0
    out = capsys.readouterr().out
    assert str(tmp_path / "table.md") in out and "birrt" in out
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    assert {"runs.csv", "table.md", "table.tex", "table.csv"} <= before.keys()
    assert "iterations was 20000, now 9" in refused(capsys, *words, "--iterations", "9")
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


@pytest.mark.parametrize("out", ["/dev/null", "/dev/null/x"])
def test_a_directory_that_cannot_be_made_is_refused(capsys, out):
    assert out in refused(capsys, "reproduce", "place-task", "--problems", "1", "--out", out)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_read_only_directory_is_refused(capsys, tmp_path):
    tmp_path.chmod(0o555)
    assert "read-only" in refused(capsys, "reproduce", "place-task", "--problems", "1", "--out", tmp_path)
