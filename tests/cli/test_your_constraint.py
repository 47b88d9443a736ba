"""The page on constraints of the user's own: its commands work in the order printed."""

import json
import re
import shlex
import sys
from pathlib import Path

import pytest

from cvqmpt_lab.cli.main import main
from cvqmpt_lab.problem import PlanningProblem

PAGE = Path(__file__).parents[2] / "docs" / "your_constraint.md"


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """An empty folder, in which the modules of no other test are known."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "my_module", raising=False)
    yield tmp_path
    sys.modules.pop("my_module", None)


def test_the_commands_of_the_page_work_in_the_order_printed(folder, capsys):
    blocks = re.findall(r"^```(\w*)\n(.*?)^```$", PAGE.read_text(), re.M | re.S)
    assert [kind for kind, _ in blocks[:2]] == ["python", ""]
    (folder / "my_module.py").write_text(blocks[0][1])
    commands = [shlex.split(line)[1:] for line in blocks[1][1].splitlines()]
    assert [words[0] for words in commands] == ["problems", "plan", "certify", "ik"]
    for words in commands:
        assert main(words) == 0, words
    said = capsys.readouterr().out
    assert "plan it with: cvqmpt plan mine.json --constraint my_module:F" in said
    assert "3 postures found, 3 asked" in said
    from my_module import on_circle

    # start and goal keep the function, and so do the configurations of ik
    problem = PlanningProblem.load(folder / "mine.json")
    assert abs(on_circle(problem.start)[0]) <= 1e-4 and abs(on_circle(problem.goals[0])[0]) <= 1e-4
    found = [json.loads(line) for line in said.splitlines() if line.startswith("[")]
    assert len(found) == 3
    bounds = '{"function": "my_module:F", "lower": -0.05, "upper": 0.1}'
    assert main(["plan", "mine.json", "--constraint", bounds]) == 0
    assert "-0.05 <= circle <= 0.1" in capsys.readouterr().out


def test_a_constraint_of_another_kind_is_refused_where_a_function_is_asked(folder, capsys):
    for words, told in (
        ("problems new p.json --constraint upright", "give a function, module:F; a region stands"),
        ("problems new p.json --task --constraint m:F", "there is no module 'm'"),
        ("problems list place-task --constraint m:F", "goes with new, not with list"),
        ("problems new p.json --robot baxter --constraint own_constraints:circle", "of two hands"),
    ):
        assert main(shlex.split(words)) == 2
        assert told in capsys.readouterr().err
    assert not (folder / "p.json").exists()
