"""Natural mistakes are answered by one line with the value, the valid choices and a fix."""

import json
import shutil
import tomllib

import pytest
from refusals import DATA

from cvqmpt_lab.cli.main import main

FILE = tomllib.loads((DATA / "mistakes.toml").read_text(encoding="utf-8"))
ANSWERED = [each for each in FILE["mistake"] if each.get("exit") != 0]


def changed_problem(mistake):
    """Return the text of the problem file with a mistake."""
    data = holder = json.loads(FILE["problem"])
    if "set" in mistake:
        field, value = mistake["set"]
        *keys, last = [int(key) if key.isdecimal() else key for key in field.split(".")]
        for key in keys:
            holder = holder[key]
        if not value:
            del holder[last]
        elif isinstance(holder, list) and last == len(holder):
            holder.append(json.loads(value))
        else:
            holder[last] = json.loads(value)
    return json.dumps(data, indent=1).replace(*mistake.get("text", ("", "")), 1)


@pytest.mark.parametrize("mistake", ANSWERED, ids=[each["name"] for each in ANSWERED])
def test_the_answer_is_the_one_that_is_stored(mistake, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    shutil.copy(DATA / "slider_arm.urdf", "arm.urdf")
    shutil.copy(DATA / "task-1.json", "task.json")
    (tmp_path / "mine.json").write_text(changed_problem(mistake))
    assert main(mistake["words"].split()) == mistake.get("exit", 2)
    said = capsys.readouterr()
    if "exit" in mistake:  # a problem without a solution, in the report
        assert f"status      {mistake['now']}" in said.out.splitlines()
    else:
        assert said.err == f"cvqmpt: {mistake['now']}\n" and not said.out


def test_none_is_left_out_and_every_answer_is_one_line():
    assert len(FILE["mistake"]) == 48
    for mistake in FILE["mistake"]:
        assert mistake["then"] and mistake["now"].isprintable()
