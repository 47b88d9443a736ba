"""The command line as a whole:
bad words are one line and exit code 2, help is quick and has examples.
"""

import os
import statistics
import subprocess
import sys
import time
from pathlib import Path

import pytest
from command_line import refused

from cli.main import COMMANDS, main

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize(
    ("words", "value", "choice"),
    [
        ("plan place-task --planner nope", "'nope'", "ompl-projected"),
        ("plan nope", "'nope'", "place-task-with-can"),
        ("plan place-task --problem 150", "150", "0 to 149"),
        ("plan place-task --problem -1", "-1", "0 to 149"),
        ("plan place-task --backend nope", "'nope'", "compiled, exact"),
        ("plan place-task --seed -1", "-1", "0 or more"),
        ("plan place-task --clearance -0.1", "-0.1", "0 or more"),
        ("ik --problem-file x --pose 1 --seed -1", "-1", "0 or more"),
        ("plan multi-sequence --trajectory /tmp/x/ --speed 5", "5.0", "at most 1"),
        ("certify tests --clearance 0.05", "run", "directory alone"),
        ("certify tests --robot panda", "run", "directory alone"),
        ("problems export ./tests/data/ --out /tmp/x", "./tests/data/", "place-task"),
        ("plan", "--problem-file", "place-task"),
        ("plan place-task --problem-file x", "--problem-file", "one of the four"),
        ("plan --problem-file /nope", "/nope", "No such file"),
        ("plan place-task --save /nope/x.rrd", "/nope", "does not exist"),
        ("plan place-task --save-path /nope/x.csv", "/nope", "does not exist"),
        ("plan place-task --save-path /tmp", "/tmp", "folder"),
        ("plan place-task --robot ur5", "--robot", "go with --problem-file"),
        ("problems new README.md", "README.md", "is there already"),
        ("problems list place-task --robot panda", "--robot", "goes with new"),
        ("problems list place-task --goals", "--goals", "goes with export"),
        ("reproduce place-task --problems 1 --backend nope --out /nope/x", "'nope'", "compiled"),
        ("bench stages --json /proc/x.json", "/proc/x.json", "writable folder"),
        ("reproduce nope", "'nope'", "place-task"),
        ("figure nope", "'nope'", "histogram, concept"),
        ("figure cost", "cost", "name their folder with --rows"),
        (
            "figure cost --rows x --out paper_tables/results/place-task",
            "place-task",
            "committed results",
        ),
        ("robot gen3", "'gen3'", "ros2_kortex"),
        (
            "plan --task-file tests/data/problem-1.json",
            "cvqmpt-problem/1",
            "give it with --problem-file",
        ),
        ("reproduce place-task --planners birrt,nope", "'nope'", "ompl-projected"),
        ("reproduce place-task --planners ,", "planners", "at least one"),
        ("plan place-task --planner graph-cvq", "graph-cvq was removed", "roadmap-cvq"),
        ("plan place-task --planner cvq:graph+wide", "cvq:graph+wide was removed", "roadmap-cvq"),
        ("train edge-model", "edge-model was removed", "edge_costs.py"),
        ("problems nope place-task", "'nope'", "list, export"),
        ("problems list nope", "'nope'", "place-task-with-can"),
        ("problems export place-task", "--out", "DIR"),
        ("table /nope", "/nope", "not a directory"),
        ("bench nope", "'nope'", "stages, paper-check"),
        ("check-tables --expected /nope", "/nope", "check-tables --update"),
    ],
)
def test_unknown_choices_name_the_value_and_the_valid_ones(capsys, words, value, choice):
    line = refused(capsys, *words.split())
    assert value in line and choice in line


@pytest.mark.parametrize(
    "words",
    [
        *(
            "nope",
            "warmup nope",
            "bench",
            "table",
            "plan place-task --nope",
            "plan place-task --seed",
        ),
        *(f"plan place-task --cutoff {value}" for value in ("nan", "-1", "inf", "ten")),
        *("plan place-task --iterations 0", "plan place-task --problem one"),
        *(f"reproduce place-task {option}" for option in ("--problems 0", "--seeds x", "--jobs 0")),
    ],
)
def test_malformed_options_are_one_line_that_names_the_value_and_the_help(capsys, words):
    line = refused(capsys, *words.split())
    command = " ".join(["cvqmpt", *[word for word in words.split()[:1] if word in COMMANDS]])
    assert words.split()[-1] in line and f"{command} --help" in line


def test_help_is_fast():
    words, seconds = [sys.executable, "-m", "cli.main", "--help"], []
    for _ in range(3):
        began = time.perf_counter()
        subprocess.run(words, cwd=ROOT, capture_output=True, check=True)
        seconds.append(time.perf_counter() - began)
    assert statistics.median(seconds) < 1.5, "aim: 0.5 s; the rest is for busy machines"


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help_with_examples(capsys, command):
    with pytest.raises(SystemExit) as end:
        main([command, "--help"])
    out = capsys.readouterr().out
    assert end.value.code == 0 and "examples:\n  cvqmpt " in out


def test_as_a_process_an_error_is_one_line_without_traceback():
    words = [sys.executable, "-m", "cli.main", "plan", "nope"]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 2 and done.stdout == "" and len(done.stderr.splitlines()) == 1


@pytest.mark.parametrize(
    ("where", "code", "told"), [("/dev/full", 2, "cvqmpt: [Errno 28]"), ("closed", 141, "")]
)
def test_what_cannot_be_printed_is_no_success(where, code, told):
    words = [sys.executable, "-m", "cli.main", "problems", "list", "place-task", "--problems", "3"]
    if where == "closed":
        reading, writing = os.pipe()
        os.close(reading)
    else:
        writing = os.open(where, os.O_WRONLY)
    done = subprocess.run(words, cwd=ROOT, stdout=writing, stderr=subprocess.PIPE, text=True)
    os.close(writing)
    assert (
        done.returncode == code
        and done.stderr.startswith(told)
        and len(done.stderr.splitlines()) == bool(told)
    )
