"""`check-tables FOLDER`: expectations of planners, also of the user's, on a folder of problems."""

import json

import pytest
from command_line import refused

from cvqmpt_lab.base.modules import Code
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


def test_a_folder_is_green_until_a_planner_or_problem_changes(folder, cvqmpt, capsys, monkeypatch):
    check = f"check-tables {folder} --jobs 1"
    assert "write it with: cvqmpt check-tables" in refused(capsys, *check.split())
    told = cvqmpt(f"{check} --update --planners birrt,guarded:plan")
    assert "4 runs, 2 solved; expectations written to" in told
    monkeypatch.setattr(Code, "allowed", False)
    told = refused(capsys, *check.split())
    assert "names the planner guarded:plan, whose module would run: add --allow-code" in told
    assert "or name it: --planners birrt,guarded:plan" in told
    told = cvqmpt(f"{check} --allow-code")
    assert "4 runs compared exactly" in told and "no difference" in told
    assert "t_total_s" not in (folder / "expected.json").read_text()
    folder = folder.rename(folder.parent / "moved")
    check, path = f"check-tables {folder} --jobs 1 --planners birrt", folder / "expected.json"
    assert "2 runs compared" in cvqmpt(check)

    record = json.loads(path.read_text())
    (first, *_) = (run for run in record["runs"] if run["planner"] == "birrt")
    first["expected"]["n_state_checks"] += 1
    path.write_text(json.dumps(record))
    told = cvqmpt(check, code=1)
    assert "differs: birrt, problem 2 of the folder" in told and "n_state_checks was" in told
    record["made_with"]["numba for"] = "another one"
    path.write_text(json.dumps(record))
    told = cvqmpt(check)
    assert "since numba for another one -> x86-64-v3" in told
    first["expected"]["n_state_checks"] *= 2
    path.write_text(json.dumps(record))
    assert "90% quantile of the factors" in cvqmpt(check, code=1)
    cvqmpt(check, "--within", 110)
    for column in ("n_state_checks", "path_length_rad"):
        kept, first["expected"][column] = first["expected"][column], float("nan")
        path.write_text(json.dumps(record))  # a sum that is NaN was within all bounds
        assert f"{column} is nan; it must be a finite float" in refused(capsys, *check.split())
        first["expected"][column] = kept
    path.write_text(json.dumps(record))
    place_problem(5).save(folder / "5.json")
    told = cvqmpt(check, code=1)
    assert "problem 5 of the folder, seed 0, 20000 iterations: either expected or run" in told


def test_what_does_not_go_together_is_refused(folder, cvqmpt, capsys):
    check = ("check-tables", folder)
    assert "--planners A,B" in refused(capsys, *check, "--update")
    cvqmpt(f"check-tables {folder} --update --planners roadmap")
    assert "choose from roadmap" in refused(capsys, *check, "--planners", "birrt")
    assert "go with --update" in refused(capsys, *check, "--seeds", "2")
    assert "go without a folder" in refused(capsys, *check, "--all")
