"""The command line: a table of commands, fast help with examples, errors of one line."""

import csv
import os
import shlex
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from command_line import ROOT, SCAN_START, run

from cvqmpt_lab.cli import main as main_module
from cvqmpt_lab.cli.main import COMMANDS, entry_point, main

with Path(__file__).with_name("commands.csv").open(newline="") as file:
    TABLE = list(csv.DictReader(file))


@pytest.fixture
def places(problem_file, scan_folder, tmp_path):
    """Return the replacements of placeholders in the table of commands, for files and options."""
    for suffix in ("csv", "json", "yaml", "ply", "png", "urdf", "srdf"):
        os.mkfifo(tmp_path / f"pipe.{suffix}")
    depth = scan_folder / "depth"
    extrinsics = f"--extrinsics {depth}.extrinsics.json"
    return {
        "{problem}": problem_file,
        "{task}": "tests/data/task-1.json",
        "{path}": "x.csv",
        "{pipe}": tmp_path / "pipe",
        "{scan}": f"{depth}.png --intrinsics {depth}.intrinsics.json {extrinsics}",
        "{cloud}": f"--cloud {scan_folder / 'cloud.ply'}",
        "{ends}": f"--start {SCAN_START} --goal {SCAN_START[1:]}",
        "{start}": SCAN_START,
    }


@pytest.mark.parametrize("row", TABLE, ids=[row["command"] for row in TABLE])
def test_a_command_ends_with_its_code_and_first_line(row, places, capsys, monkeypatch):
    """A refusal is one line on standard error, and no file is written."""
    monkeypatch.chdir(ROOT)
    before, command = set(Path().iterdir()), row["command"]
    for name, meaning in places.items():
        command = command.replace(name, str(meaning))
    signal.alarm(60)  # ends this process where a command waits for a pipe
    code = main(shlex.split(command))
    signal.alarm(0)
    out, err = (text.splitlines() for text in capsys.readouterr())
    assert code == int(row["code"]), (out, err)
    if code == 2:
        assert out == [] and len(err) == 1 and err[0].startswith("cvqmpt: ")
    (line, *_) = err if code == 2 else out
    assert row["line"] in line and row["also"] in line
    assert set(Path().iterdir()) == before


def test_help_is_fast():
    words, before = [sys.executable, "-m", "cvqmpt_lab.cli.main", "--help"], os.times()
    subprocess.run(words, cwd=ROOT, capture_output=True, check=True)
    now = os.times()
    seconds = now.children_user + now.children_system
    seconds -= before.children_user + before.children_system
    assert seconds < 1.5, "aim: 0.5 s of processor time"


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help_with_examples(capsys, command):
    with pytest.raises(SystemExit) as end:
        main([command, "--help"])
    out = capsys.readouterr().out
    assert end.value.code == 0 and "examples:\n  cvqmpt " in out


def test_no_verdict_where_standard_output_is_closed():
    said = run(["certify", "x.csv", "place-task"], lambda: os.close(1), code=2)
    assert said == "cvqmpt: standard output is closed; redirect it, as to /dev/null\n"
    run(["plan", "nope"], lambda: os.close(2), code=2)


def test_a_fault_of_ours_is_no_verdict(monkeypatch, capsys):
    monkeypatch.setattr("cvqmpt_lab.cli.main.main", lambda: 1 // 0)
    with pytest.raises(SystemExit, match="2"):
        entry_point()
    assert "ZeroDivisionError" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("where", "words", "code", "told"),
    [
        (os.devnull, ("plan", "nope"), 2, "cvqmpt: unknown suite 'nope'"),
        ("/dev/full", ("problems", "list", "place-task", "--problems", "3"), 2, "cvqmpt: [Errno"),
        ("closed", ("problems", "list", "place-task", "--problems", "3"), 141, ""),
    ],
)
def test_a_process_that_cannot_do_or_print_it_ends_in_one_line(where, words, code, told):
    if where == "closed":
        reading, writing = os.pipe()
        os.close(reading)
    else:
        writing = os.open(where, os.O_WRONLY)
    words = [sys.executable, "-m", "cvqmpt_lab.cli.main", *words]
    done = subprocess.run(words, cwd=ROOT, stdout=writing, stderr=subprocess.PIPE, text=True)
    os.close(writing)
    assert done.returncode == code and done.stderr.startswith(told)
    assert len(done.stderr.splitlines()) == bool(told)


def test_an_interrupted_command_says_what_is_kept(monkeypatch, capsys):
    def interrupt(name):
        raise KeyboardInterrupt

    monkeypatch.setattr(main_module, "command_named", interrupt)
    for command, told in (("plan", "nothing else"), ("reproduce", "the same command continues")):
        assert main_module.main([command, "place-task"]) == 130
        assert told in capsys.readouterr().err
