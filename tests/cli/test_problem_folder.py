"""`cvqmpt reproduce --problems-dir`: a folder of problem files as a suite."""

import json
import re

import pytest
from command_line import refused

from cli.main import main
from cvqmpt_lab.benchmarks.place_task import DOOR, DOOR_ANGLE, place_problem
from cvqmpt_lab.codec import to_plain
from cvqmpt_lab.files import json_text
from cvqmpt_lab.results.provenance import ProvenanceFile
from cvqmpt_lab.results.row import RUNS_FILE, read_rows
from cvqmpt_lab.scene.kitchen import kitchen

BUDGET = ("--planners", "birrt", "--iterations", "20000", "--jobs", "1")


def changed(path, **fields):
    """Give a problem file other fields."""
    path.write_text(json_text({**json.loads(path.read_text()), **fields}))


def reproduce(folder, out, *more):
    assert (
        main(["reproduce", "--problems-dir", str(folder), *BUDGET, "--out", str(out), *more]) == 0
    )
    return read_rows(out / RUNS_FILE)


@pytest.fixture
def folder(tmp_path):
    """Two problems, one of which names its scene; the schema, a hidden file and a note."""
    folder = tmp_path / "my shelves"
    folder.mkdir()
    for index, name in enumerate(("b2", "b10")):
        place_problem(index).save(folder / f"{name}.json")
    changed(folder / "b2.json", name="first/2-carry", scene="room.json")
    room = to_plain(kitchen(door_angles={DOOR: DOOR_ANGLE}))
    (folder / "room.json").write_text(json_text(room))
    changed(folder / "b10.json", name="second")
    for name in ("problem.schema.json", ".hidden.json", "notes.txt"):
        (folder / name).write_text("no problem")
    return folder


def test_it_has_rows_a_table_a_report_and_is_continued(folder, tmp_path, capsys):
    out = tmp_path / "out"
    rows = reproduce(folder, out, "--problems", "1")
    assert [(row.suite, row.problem, row.solved) for row in rows] == [
        ("my shelves", "first-2-carry", True)
    ]
    both = reproduce(folder, out)
    assert both[0] == rows[0] and [row.problem for row in both] == ["first-2-carry", "second"]
    assert reproduce(folder, out) == both and both[1].solved
    assert "Suite my shelves: 2 problems" in capsys.readouterr().out
    assert main(["report", str(out)]) == 0
    assert "cvqmpt plan --problem-file FILE --planner PLANNER" in (out / "report.html").read_text()
    capsys.readouterr()
    assert "name it with --problems-dir" in refused(capsys, "certify", out)
    assert main(["certify", str(out), "--problems-dir", str(folder)]) == 0
    assert capsys.readouterr().out == "2 paths, 2 certified, 0 refused, 0 unlike their rows\n"


def test_a_changed_file_is_not_mixed_with_earlier_rows_and_a_new_one_is_added(
    folder, tmp_path, capsys
):
    out = tmp_path / "out"
    rows = reproduce(folder, out)
    changed(folder / "b10.json", name="third")
    added = reproduce(folder, out)
    assert [row.problem for row in added] == ["first-2-carry", "second", "third"]
    assert [added[0], added[1]] == rows and set(
        ProvenanceFile(out).read()["continued"][0]["problem_files"]
    ) == {"first-2-carry", "third"}
    capsys.readouterr()
    room = json.loads((folder / "room.json").read_text())
    (folder / "room.json").write_text(json_text({**room, "name": "another room"}))
    again = ("reproduce", "--problems-dir", folder, *BUDGET, "--out", out)
    assert re.search(
        r'problem_files.first-2-carry was "[0-9a-f]{64}", now "[0-9a-f]{64}".*--out',
        refused(capsys, *again),
    )
    certified = refused(capsys, "certify", out, "--problems-dir", folder)
    assert "problem 'first-2-carry' of" in certified and "is not the one that was run" in certified
    assert read_rows(out / RUNS_FILE) == added


def test_folders_that_are_no_suite_are_refused_before_anything_runs(folder, tmp_path, capsys):
    def told(where=folder, *more):
        out = tmp_path / "out"
        message = refused(
            capsys, "reproduce", "--problems-dir", where, *(more or BUDGET), "--out", out
        )
        assert not out.exists()
        return message

    assert "No such file or directory; name a folder of problem files" in told(tmp_path / "none")
    (tmp_path / "empty").mkdir()
    assert "holds no problem files (*.json); write one with: cvqmpt problems new" in told(
        tmp_path / "empty"
    )
    assert "as a suite of ours; give it another name" in told(
        folder.rename(tmp_path / "place-task")
    )
    (tmp_path / "place-task").rename(folder)
    assert "unknown planner 'nobody'" in told(folder, "--planners", "nobody")
    changed(
        folder / "b2.json",
        constraint=4 * json.loads((folder / "b2.json").read_text())["constraint"],
    )
    assert "first-2-carry: atlas-rrt: it needs more joints" in told(
        folder, "--planners", "atlas-rrt"
    )
    changed(folder / "b2.json", name="=1+2")
    assert "b2.json: name '=1+2' cannot stand in a table" in told()
    changed(folder / "b2.json", name="second")
    assert re.search(r"b2.json and .*b10.json are both named 'second'.*another 'name'", told())
    changed(folder / "b2.json", name="first", tilt=3)
    assert re.search(r"b2.json: tilt is unknown; fields: name, robot", told())
    (folder / "b2.json").write_text('{"schema": "cvqmpt-problem/1",\n "name": }')
    assert re.search(r"b2.json is not json: .*line 2", told())


def test_without_named_planners_all_run_that_can(folder, tmp_path):
    changed(
        folder / "b10.json",
        constraint=4 * json.loads((folder / "b10.json").read_text())["constraint"],
    )
    out, few = tmp_path / "out", ("--iterations", "1", "--jobs", "1")
    assert main(["reproduce", "--problems-dir", str(folder), *few, "--out", str(out)]) == 0
    planners = {row.planner for row in read_rows(out / RUNS_FILE)}
    assert {"birrt", "roadmap", "cvq-mpt", "ompl-projected"} <= planners and not {
        "atlas-rrt",
        "tb-rrt",
    } & planners
