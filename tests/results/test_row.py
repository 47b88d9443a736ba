import pytest
from made_rows import a_row
from refusals import refused

from cvqmpt_lab.errors import CvqmptError, RunStoreError
from cvqmpt_lab.results.row import COLUMNS, one_line, read_rows, write_rows


def test_files_from_before_the_last_columns_are_read(tmp_path):
    path, row = tmp_path / "rows.csv", a_row(t_total_s=1.5, path_sha256="0" * 64)
    for gone in (1, len(COLUMNS) - COLUMNS.index("t_sense_s")):
        write_rows(path, [row])
        lines = path.read_text().splitlines()
        path.write_text("".join(",".join(line.split(",")[:-gone]) + "\n" for line in lines))
        assert read_rows(path) == [row]
    lines = path.read_text().splitlines()
    path.write_text("".join(line.rpartition(",")[0] + "\n" for line in lines))
    refused("column 31: expected path_sha256, found nothing", read_rows, path, error=RunStoreError)


@pytest.mark.parametrize(
    ("values", "word"),
    [
        ({"path_length_rad": -1.0}, "path_length_rad"),
        ({"t_total_s": float("nan")}, "t_total_s"),
        ({"vertices": 3.0}, "vertices"),
        ({"vertices": True}, "vertices"),
        ({"detail": ""}, "detail"),
        ({"detail": "two\nlines"}, "detail"),
        ({"suite": "=1+1"}, "suite is '=1[+]1'.*formula"),
        ({"planner": "@x"}, "planner"),
        ({"solved": False, "fail_reason": "bored"}, "'bored'; valid choices: timeout, iteration"),
        ({"solved": False}, "solved is False but fail_reason is None"),
        ({"fail_reason": "timeout"}, "solved is True but fail_reason is timeout"),
        ({"seed": None}, "seed"),
        ({"solved": 1}, "solved"),
        ({"certified": False}, "certified"),
        ({"schema": "0"}, "schema"),
    ],
)
def test_bad_values_are_refused_by_name(values, word):
    refused(word, a_row, error=CvqmptError, **values)


TEXTS = {"two\n lines\x1b": "two lines", "=1+1": "'=1+1", "-3 off": "'-3 off", " \t": None}


@pytest.mark.parametrize("text", [*TEXTS, "ok"])
def test_any_text_becomes_a_cell_that_no_spreadsheet_runs(text):
    assert one_line(text) == TEXTS.get(text, text)
    assert a_row(detail=one_line(text)).detail == TEXTS.get(text, text)


FIELDS = {"seed": "one", "t_total_s": "nan", "vertices": "-1", "solved": "True", "schema": "1"}


@pytest.mark.parametrize(("column", "text"), [*FIELDS.items(), ("t_total_s", "fast")])
def test_a_bad_field_is_named_with_file_line_and_column(tmp_path, column, text):
    path = tmp_path / "rows.csv"
    write_rows(path, [a_row("p1", t_total_s=1.0), a_row("p2", t_total_s=1.0)])
    *lines, last = path.read_text().splitlines()
    fields = last.split(",")
    fields[COLUMNS.index(column)] = text
    path.write_text("\n".join([*lines, ",".join(fields)]) + "\n")
    told = f"rows.csv, line 3: {column} is '?{text}"
    refused(told, read_rows, path, error=RunStoreError)


def test_a_foreign_header_or_a_short_row_is_named(tmp_path):
    path = tmp_path / "rows.csv"
    write_rows(path, [a_row()])
    good = path.read_text()
    for text, words in (
        (good.replace("backend", "engine"), "line 1, column 7: expected backend, found engine"),
        ("schema\x1b[31m" + "x" * 9000, "found schema.*use another --out"),
        ("", "expected schema, found nothing"),
        (good[:-3], f"line 2: {len(COLUMNS) - 2} fields, expected {len(COLUMNS)}"),
    ):
        path.write_text(text)
        line = refused(words, read_rows, path, error=RunStoreError)
        assert line.isprintable() and len(line) < 600
