"""A folder of problems and what is expected there of planners, one's own among them."""

import json

import pytest
from command_line import refused

from cli.main import main
from cvqmpt_lab.benchmarks.place_task import place_problem

PLANNER = """import numpy as np


def plan(problem, budget, seed):
    nearest = np.linalg.norm(problem.goals - problem.start, axis=1).argmin()
    return np.array([problem.start, problem.goals[nearest]])
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Two problems, in a folder beside a planner."""
    folder = tmp_path / "problems"
    folder.mkdir()
    for index in (2, 8):
        place_problem(index).save(folder / f"{index}.json")
    (tmp_path / "guarded.py").write_text(PLANNER)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    return folder


def test_a_folder_is_green_until_a_planner_or_problem_changes(folder, capsys):
    check = ["check-tables", str(folder), "--jobs", "1"]
    update = [*check, "--update", "--planners", "birrt,guarded:plan"]
    assert "write it with: cvqmpt check-tables" in refused(capsys, *check)
    assert main(update) == 0 and main(check) == 0
    out = capsys.readouterr().out
    assert "4 runs, 2 solved; expectations written to" in out
    assert "4 runs compared exactly" in out and "no difference" in out
    path = folder / "expected.json"
    assert "t_total_s" not in path.read_text()
    folder = folder.rename(folder.parent / "moved")
    check[1], path = str(folder), folder / "expected.json"
    assert main([*check, "--planners", "birrt"]) == 0
    assert "2 runs compared" in capsys.readouterr().out

    record = json.loads(path.read_text())
    (first, *_) = (run for run in record["runs"] if run["planner"] == "birrt")
    first["expected"]["n_state_checks"] += 1
    path.write_text(json.dumps(record))
    assert main([*check, "--planners", "birrt"]) == 1
    told = capsys.readouterr().out
    assert "differs: birrt, problem 2 of the folder" in told and "n_state_checks was" in told
    record["made_with"]["cpu_model"] = "another one"
    path.write_text(json.dumps(record))
    assert main([*check, "--planners", "birrt"]) == 0
    assert main([*check, "--planners", "birrt", "--within", "0"]) == 1
    assert "n_state_checks of 2 runs: was" in capsys.readouterr().out
    place_problem(5).save(folder / "5.json")
    assert main([*check, "--planners", "birrt"]) == 1
    told = capsys.readouterr().out
    assert "problem 5 of the folder, seed 0, 20000 iterations: either expected or run" in told


def test_what_does_not_go_together_is_refused(folder, capsys):
    check = ("check-tables", folder)
    assert "--planners A,B" in refused(capsys, *check, "--update")
    assert main(["check-tables", str(folder), "--update", "--planners", "roadmap"]) == 0
    capsys.readouterr()
    assert "only of roadmap" in refused(capsys, *check, "--planners", "birrt")
    assert "go with --update" in refused(capsys, *check, "--seeds", "2")
    assert "go without a folder" in refused(capsys, *check, "--all")
