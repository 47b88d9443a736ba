"""`cvqmpt reproduce FOLDER`: a folder of problem files as a suite."""

import json
import re

import pytest
from command_line import refused, run_here

from cvqmpt_lab.base.codec import to_plain
from cvqmpt_lab.base.files import json_text
from cvqmpt_lab.benchmarks.place_task import place_kitchen, place_problem
from cvqmpt_lab.benchmarks.results.provenance import ProvenanceFile
from cvqmpt_lab.benchmarks.results.row import RUNS_FILE, read_rows

BUDGET = ("--planners", "birrt", "--iterations", "20000", "--jobs", "1")


def changed(path, **fields):
    """Give a problem file other fields."""
    path.write_text(json_text({**json.loads(path.read_text()), **fields}))


def reproduce(folder, out, *more, budget=BUDGET):
    run_here(["reproduce", folder, *budget, "--out", out, *more])
    return read_rows(out / RUNS_FILE)


def with_four_constraints(path):
    changed(path, constraint=4 * json.loads(path.read_text())["constraint"])


@pytest.fixture
def folder(tmp_path):
    """Two problems, one of which names its scene; the schema, a hidden file and a note."""
    folder = tmp_path / "my shelves"
    folder.mkdir()
    for index, name in enumerate(("b2", "b10")):
        place_problem(index).save(folder / f"{name}.json")
    changed(folder / "b2.json", name="first/2-carry", scene="room.json")
    room = to_plain(place_kitchen())
    (folder / "room.json").write_text(json_text(room))
    changed(folder / "b10.json", name="second")
    for name in ("problem.schema.json", ".hidden.json", "notes.txt"):
        (folder / name).write_text("no problem")
    return folder


def test_it_has_rows_a_table_a_report_and_is_continued(folder, tmp_path, cvqmpt, capsys):
    out = tmp_path / "out"
    rows = reproduce(folder, out, "--problems", "1")
    (row,) = rows
    assert (row.suite, row.problem, row.solved) == ("my shelves", "first-2-carry", True)
    both = reproduce(folder, out)
    assert both[0] == rows[0] and [row.problem for row in both] == ["first-2-carry", "second"]
    assert reproduce(folder, out) == both and both[1].solved
    assert "my shelves: 2 problems" in capsys.readouterr().out
    cvqmpt("report", out)
    assert "cvqmpt plan FILE --planner PLANNER" in (out / "report.html").read_text()
    assert f"name it: cvqmpt certify {out} FOLDER" in refused(capsys, "certify", out)
    told = cvqmpt("certify", out, folder)
    assert told == "2 paths, 2 certified, 0 not certified, 0 differ from their rows\n"


def test_a_changed_file_is_not_mixed_with_earlier_rows_and_a_new_one_is_added(
    folder, tmp_path, capsys
):
    out = tmp_path / "out"
    rows = reproduce(folder, out)
    changed(folder / "b10.json", name="third")
    added = reproduce(folder, out)
    assert [row.problem for row in added] == ["first-2-carry", "second", "third"]
    (session,) = ProvenanceFile(out).read()["continued"]
    assert added[:2] == rows and {*session["problem_files"]} == {"first-2-carry", "third"}
    capsys.readouterr()
    changed(folder / "room.json", name="another room")
    again = refused(capsys, "reproduce", folder, *BUDGET, "--out", out)
    told = r'problem_files.first-2-carry was "[0-9a-f]{64}", now "[0-9a-f]{64}".*--out'
    assert re.search(told, again)
    certified = refused(capsys, "certify", out, folder)
    assert "problem 'first-2-carry' of" in certified and "is not the one that was run" in certified
    assert read_rows(out / RUNS_FILE) == added


def test_folders_that_are_no_suite_are_refused_before_anything_runs(folder, tmp_path, capsys):
    out = tmp_path / "out"

    def check(told, where=folder, *more):
        words = ["reproduce", where, *(more or BUDGET), "--out", out]
        assert re.search(told, refused(capsys, *words))
        assert not out.exists()

    check("No such file or directory; name a folder of problem files", tmp_path / "none")
    (tmp_path / "empty").mkdir()
    told = r"holds no problem files \(\*.json\); write one with: cvqmpt problems new"
    check(told, tmp_path / "empty")
    check("as a suite of ours; give it another name", folder.rename(tmp_path / "place-task"))
    (tmp_path / "place-task").rename(folder)
    check("unknown planner 'nobody'", folder, "--planners", "nobody")
    with_four_constraints(folder / "b2.json")
    told = "first-2-carry: atlas-rrt: it needs more joints"
    check(told, folder, "--planners", "atlas-rrt")
    for fields, told in (
        ({"name": "=1+2"}, r"b2.json: name '=1\+2' cannot stand in a table"),
        ({"name": "second"}, "b2.json and .*b10.json are both named 'second'.*another 'name'"),
        ({"name": "first", "tilt": 3}, "b2.json: tilt is unknown; fields: name, robot"),
    ):
        changed(folder / "b2.json", **fields)
        check(told)
    (folder / "b2.json").write_text('{"schema": "cvqmpt-problem/1",\n "name": }')
    check("b2.json is not json: .*line 2")


def test_without_named_planners_all_run_that_can(folder, tmp_path):
    with_four_constraints(folder / "b10.json")
    rows = reproduce(folder, tmp_path / "out", budget=("--iterations", "1", "--jobs", "1"))
    planners = {row.planner for row in rows}
    assert {"birrt", "roadmap", "cvq-mpt", "ompl-projected"} <= planners
    assert not {"atlas-rrt", "tb-rrt"} & planners
