import numpy as np
import pytest
from made_rows import a_failure, a_row

from cvqmpt_lab.errors import CvqmptError, RunStoreError
from cvqmpt_lab.results.row import COLUMNS, one_line, read_rows, write_rows


def test_columns_are_the_documented_ones():
    assert ",".join(COLUMNS) == (
        "schema,suite,problem,planner,sampler_used,seed,backend,solved,fail_reason,detail,fallback,certified,"
        "t_total_s,t_goals_s,t_encode_s,t_predict_s,t_optimize_s,t_plan_s,t_simplify_s,"
        "n_projections,n_newton_iterations,n_state_checks,n_iterations,vertices,path_length_raw_rad,"
        "path_length_rad,execution_time_s,max_violation_rad,max_violation_m,min_clearance_m,path_sha256,"
        "t_sense_s,t_whole_s,true_free,true_clearance_m,t_improve_s,n_restarts,path_length_first_rad"
    )


def test_files_from_before_the_last_columns_are_read(tmp_path):
    path, row = tmp_path / "rows.csv", a_row(t_total_s=1.5, path_sha256="0" * 64)
    write_rows(path, [row])
    for gone in (1, 7):
        lines = path.read_text().splitlines()
        path.write_text("".join(",".join(line.split(",")[:-gone]) + "\n" for line in lines))
        if gone == 1:
            assert read_rows(path) == [row]
            write_rows(path, [row])
    assert read_rows(path) == [row]
    path.write_text("".join(line.rpartition(",")[0] + "\n" for line in path.read_text().splitlines()))
    with pytest.raises(RunStoreError, match="column 31: expected path_sha256, found nothing"):
        read_rows(path)


def test_rows_come_back_exactly(tmp_path):
    rng = np.random.default_rng(1)
    rows = [a_row(f"p{i}", t_total_s=float(x)) for i, x in enumerate(rng.lognormal(size=50) * 1e-3)]
    rows += [
        a_failure("p50", fail_reason="worker_died", detail='said "no", twice', n_projections=2**60),
        a_row("p51", t_total_s=0.1 + 0.2, sampler_used="μ, σ", path_sha256="0" * 64, vertices=0),
    ]
    write_rows(tmp_path / "rows.csv", rows)
    assert read_rows(tmp_path / "rows.csv") == rows


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
        ({"solved": False, "fail_reason": "bored"}, "'bored'; valid choices: timeout, iteration_limit"),
        ({"solved": False}, "solved is False but fail_reason is None"),
        ({"fail_reason": "timeout"}, "solved is True but fail_reason is timeout"),
        ({"seed": None}, "seed"),
        ({"solved": 1}, "solved"),
        ({"certified": False}, "certified"),
        ({"schema": "0"}, "schema"),
    ],
)
def test_bad_values_are_refused_by_name(values, word):
    with pytest.raises(CvqmptError, match=word):
        a_row(**values)


@pytest.mark.parametrize(
    ("text", "cell"),
    [("two\n lines\x1b", "two lines"), ("=1+1", "'=1+1"), ("-3 off", "'-3 off"), (" \t", None), ("ok", "ok")],
)
def test_any_text_becomes_a_cell_that_no_spreadsheet_runs(text, cell):
    assert one_line(text) == cell
    assert a_row(detail=one_line(text)).detail == cell


def test_order_is_deterministic_and_counts_numbers(tmp_path):
    rows = [a_row(p, planner=m, seed=s) for p in ("p10", "p2", "p02") for m in ("b", "a") for s in (1, 0)]
    write_rows(tmp_path / "one.csv", rows)
    write_rows(tmp_path / "two.csv", rows[::-1])
    assert (tmp_path / "one.csv").read_bytes() == (tmp_path / "two.csv").read_bytes()
    keys = [(r.problem, r.planner, r.seed) for r in read_rows(tmp_path / "one.csv")]
    assert keys[:4] == [("p02", "a", 0), ("p02", "a", 1), ("p02", "b", 0), ("p02", "b", 1)]
    assert [k[0] for k in keys[::4]] == ["p02", "p2", "p10"]


FIELDS = {"seed": "one", "t_total_s": "nan", "vertices": "-1", "solved": "True", "schema": "1"}


@pytest.mark.parametrize(("column", "text"), [*FIELDS.items(), ("t_total_s", "fast")])
def test_a_bad_field_is_named_with_file_line_and_column(tmp_path, column, text):
    path = tmp_path / "rows.csv"
    write_rows(path, [a_row("p1", t_total_s=1.0), a_row("p2", t_total_s=1.0)])
    *lines, last = path.read_text().splitlines()
    fields = last.split(",")
    fields[COLUMNS.index(column)] = text
    path.write_text("\n".join([*lines, ",".join(fields)]) + "\n")
    with pytest.raises(RunStoreError, match=f"rows.csv, line 3, column {column}") as caught:
        read_rows(path)
    assert "\n" not in str(caught.value)


def test_a_foreign_header_or_a_short_row_is_named(tmp_path):
    path = tmp_path / "rows.csv"
    write_rows(path, [a_row()])
    good = path.read_text()
    for text, words in (
        (good.replace("backend", "engine"), "line 1, column 7: expected backend, found engine"),
        ("schema\x1b[31m" + "x" * 9000, "found schema.*use another --out"),
        ("", "expected schema, found nothing"),
        (good[:-3], "line 2: 36 fields, expected 38"),
    ):
        path.write_text(text)
        with pytest.raises(RunStoreError, match=words) as caught:
            read_rows(path)
        assert str(caught.value).isprintable() and len(str(caught.value)) < 600
