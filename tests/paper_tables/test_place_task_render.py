import csv
import io
import json
from dataclasses import replace

import pytest

from cvqmpt_lab.errors import InvalidInputError, RunStoreError
from cvqmpt_lab.results.row import ResultRow, write_rows
from cvqmpt_lab.results.statistics import wilson_interval
from cvqmpt_lab.results.store import PARTIAL_FILE, RunStore
from experiments.suites.table import SUITES
from paper_tables.paper_numbers import read_published
from paper_tables.place_task_render import render_latex, render_markdown, render_place
from paper_tables.place_task_statements import place_verdicts
from paper_tables.place_task_summary import HEADLINES, build_place_table
from paper_tables.render import TABLES, render_directory

PAPER = read_published("place_task.csv", "Place Task")
CONFIGURATION = {"suite": "place-task", "cutoff_s": 10.0}


def run(planner, problem, time=None, seed=0, suite="place-task", backend="compiled", **values):
    """A row; a failure where `time` is None."""
    solved = time is not None
    return ResultRow(
        suite=suite,
        problem=f"p{problem}",
        planner=planner,
        seed=seed,
        backend=backend,
        solved=solved,
        fail_reason=None if solved else values.pop("fail_reason", "timeout"),
        certified=solved or None,
        t_total_s=time if solved else 10.0,
        **values,
    )


def some_rows():
    rows = [run("birrt", i, 0.1 * (i + 1), path_length_rad=5.0 + i, vertices=10 + i) for i in range(10)]
    rows += [run("ompl-projected", i, 0.4 * (i + 1), path_length_rad=8.0, vertices=40) for i in range(8)]
    rows += [
        run("ompl-projected", 8, detail="no path"),
        run("ompl-projected", 9, fail_reason="uncertified_goal"),
    ]
    return rows


def summaries(table):
    return {summary.name: summary for summary in table.planners}


# ---------------------------------------------------------------- published numbers


def test_the_published_files_hold_every_cell_of_both_tables():
    assert len(read_published("place_task.csv")) == 2 * 6 * 4
    assert len(PAPER) == 6 * 4
    cells = {(value.planner, value.metric): value.value for value in PAPER}
    assert cells["ompl-projected", "time"] == "22.95" and cells["opt-cvq-mpt", "path_length"] == "5.507"
    assert cells["mpnet", "accuracy"] == "33.85" and cells["tb-rrt", "vertices"] == "32"
    assert {metric for _, metric in cells} == {headline.published for headline in HEADLINES}


def test_the_published_totals_are_sums_and_accuracies_are_127ths():
    values = {(v.planner, v.metric): float(v.value) for v in read_published("multi_sequence.csv")}
    assert len(values) == 15
    for planner in {planner for planner, _ in values}:
        parts = values[planner, "planning_time"] + values[planner, "execution_time"]
        assert values[planner, "total_time"] == pytest.approx(parts)
    for value in PAPER:
        if value.metric == "accuracy":
            solved = round(float(value.value) * 1.27)
            assert f"{solved}/127" in value.note
            assert int(solved / 127 * 1e4) / 100 == float(value.value)


# ---------------------------------------------------------------- the table


def test_metrics_are_computed_as_stated():
    table = build_place_table(some_rows(), PAPER)
    birrt, ompl = summaries(table)["birrt"].measured, summaries(table)["ompl-projected"].measured
    assert ompl["accuracy"] == wilson_interval(8, 10).scaled(100)
    assert birrt["time_median"].estimate == pytest.approx(0.55)
    assert ompl["time_median"].estimate == pytest.approx(0.4 * 5.5) and ompl["time_median"].n == 10
    assert ompl["time_median"].high == float("inf")
    assert ompl["time_mean"].estimate == pytest.approx(0.4 * 4.5) and ompl["time_mean"].n == 8
    assert birrt["vertices_mean"].estimate == 14.5
    assert table.n_joint == birrt["path_length_median"].n == 8
    assert birrt["path_length_mean"].estimate == pytest.approx(8.5)  # problems 0..7 only
    assert (birrt["time_ratio"].estimate, birrt["time_ratio"].n) == (pytest.approx(0.25), 8)
    assert birrt["projections_median"].estimate is None
    assert birrt["solved_within_0.1_s"].estimate == pytest.approx(10)


def test_planners_come_in_the_papers_order_then_others():
    rows = [*some_rows(), run("a-new-planner", 0, 1.0)]
    rows += [run("tb-rrt", 0, 1.0)]
    names = [summary.name for summary in build_place_table(rows, PAPER).planners]
    assert names == ["ompl-projected", "tb-rrt", "a-new-planner", "birrt"]


def test_planners_that_were_not_run_are_left_out_with_the_papers_notes_on_them():
    made = render_place(some_rows(), PAPER)
    for text in (made.markdown, made.latex, made.csv, "\n".join(made.brief)):
        assert "ompl-projected" in text and "mpnet" not in text and "Atlas-RRT" not in text


def test_fallbacks_are_counted_and_solved_runs_stay_solved():
    rows = [run("roadmap-cvq", i, 1.0, fallback=f"no path after {i} searches: birrt") for i in range(2)]
    rows += [run("roadmap-cvq", i, 1.0) for i in range(2, 10)]
    (summary,) = build_place_table(rows, PAPER).planners
    assert summary.measured["fallbacks"] == wilson_interval(2, 10).scaled(100)
    assert summary.measured["accuracy"].estimate == 100 and summary.n_fallen_back == 2
    made = render_place(rows, PAPER)
    section = made.markdown.split("## Fallbacks")[1].split("##")[0]
    assert "no path after 0 searches: birrt" in section and "2 of 10" in section
    assert made.brief[-1] == "by fallback: roadmap-cvq 2 of 10"


def test_a_planner_that_solves_nothing_does_not_empty_the_joint_set():
    rows = [*some_rows(), *(run("tb-rrt", i) for i in range(10))]
    table = build_place_table(rows, PAPER)
    assert table.n_joint == 8
    assert "left out of the jointly solved set: tb-rrt" in " ".join(table.footnotes)
    assert summaries(table)["tb-rrt"].measured["time_median"].estimate == float("inf")


def test_backends_of_one_planner_are_kept_apart():
    rows = [*some_rows(), *(run("birrt", i, 1.0, backend="python") for i in range(10))]
    table = summaries(build_place_table(rows, PAPER))
    assert table["birrt [python]"].measured["time_median"].estimate == 1.0
    assert table["birrt [compiled]"].measured["time_median"].estimate == pytest.approx(0.55)


def test_seeds_of_a_problem_are_one_pair():
    rows = [run("birrt", 0, t, seed=s) for s, t in enumerate((1.0, 4.0))] + [run("birrt", 1, 1.0)]
    rows += [run("ompl-projected", 0, 1.0, seed=s) for s in range(2)] + [run("ompl-projected", 1, 1.0)]
    table = build_place_table(rows, PAPER)
    ratio = summaries(table)["birrt"].measured["time_ratio"]
    assert (ratio.estimate, ratio.n) == (pytest.approx(2**0.5), 2)
    assert any("Several seeds" in note for note in table.footnotes)


def test_the_same_runs_again_under_other_seeds_make_nothing_surer():
    once = [replace(row, n_state_checks=i, n_projections=1) for i, row in enumerate(some_rows())]
    five_times = [replace(row, seed=seed) for seed in range(5) for row in once]
    for one, five in zip(
        *(build_place_table(rows, PAPER).planners for rows in (once, five_times)), strict=True
    ):
        assert five.n_runs == 5 * one.n_runs
        for name, interval in one.measured.items():
            same = five.measured[name]
            assert same.n == interval.n
            assert (same.estimate, same.low, same.high) == pytest.approx(
                (interval.estimate, interval.low, interval.high)
            ), name
    verdicts = (
        place_verdicts([*rows, *(replace(row, planner="cvq-mpt") for row in rows)], PAPER)
        for rows in (once, five_times)
    )
    assert next(verdicts) == next(verdicts) != ()


def test_a_problem_solved_by_some_seeds_is_solved_in_part():
    rows = [run("birrt", i, 1.0, seed=s) for i in range(10) for s in range(2)]
    rows = [run("birrt", 0, seed=0), *rows[1:]]
    measured = summaries(build_place_table(rows, PAPER))["birrt"].measured
    assert measured["accuracy"] == wilson_interval(9.5, 10).scaled(100)
    assert measured["time_median"].n == 10 and measured["time_mean"].estimate == 1.0


def test_who_ran_fewer_seeds_is_named():
    rows = [*some_rows(), *(run("birrt", i, 1.0, seed=1) for i in range(10))]
    (note,) = [note for note in build_place_table(rows, PAPER).footnotes if "fewer" in note]
    assert note == "Seeds, where they are fewer than 2: ompl-projected 1."


def test_unequal_problem_sets_are_pointed_out():
    assert "did not all run" not in " ".join(build_place_table(some_rows(), PAPER).footnotes)
    assert "did not all run" in " ".join(build_place_table(some_rows()[:-1], PAPER).footnotes)


def test_a_table_is_of_one_suite():
    for rows in ([], [run("birrt", 0, 1.0), run("birrt", 0, 1.0, suite="random")]):
        with pytest.raises(InvalidInputError, match="one suite"):
            build_place_table(rows, PAPER)


# ---------------------------------------------------------------- renderings


def test_the_same_rows_give_the_same_bytes():
    assert render_place(some_rows(), PAPER) == render_place(some_rows()[::-1], PAPER)


def test_a_terminal_gets_a_line_a_planner_within_100_columns():
    times = dict.fromkeys(
        ("birrt", "guided-birrt", "ompl-projected", "opt-cvq-mpt", "roadmap-cvq"), 1234.5678
    )
    rows = [run(name, i, t + i, path_length_rad=12.3) for name, t in times.items() for i in range(9)]
    lines = render_place(rows, PAPER).brief
    assert [line.split()[0] for line in lines[1:]] == [
        "planner",
        "ompl-projected",
        "opt-cvq-mpt",
        "birrt",
        "guided-birrt",
        "roadmap-cvq",
    ]
    assert max(map(len, lines)) <= 100 and "22.95" in lines[2]
    assert "paper" not in render_place(rows, ()).brief[1]


def test_markdown_columns_line_up_and_show_paper_and_ours():
    text = render_markdown(build_place_table([*some_rows(), run("odd|name", 0, 1.0)], PAPER))
    for block in text.split("\n\n"):
        if block.startswith("|"):
            lines = block.strip().split("\n")
            assert len({len(line) for line in lines}) == 1
            assert len({line.replace("\\|", "").count("|") for line in lines}) == 1
    line = next(line for line in text.splitlines() if line.startswith("| ompl-projected (CBiRRT)"))
    cells = [cell.strip() for cell in line.strip("|").split("|")]
    assert cells[1:6] == ["10", "93.7", "80.0 [49.0, 94.3]", "22.95", "2.20 [0.800, ∞]"]
    assert "119/127" in text and "114/127" not in text


def test_small_samples_show_a_range_in_round_brackets():
    text = render_markdown(build_place_table([run("birrt", i, 1.0 + i) for i in range(3)], ()))
    assert "2.00 (1.00, 3.00)" in text


def test_markdown_counts_failures_by_reason_with_an_example():
    text = render_markdown(build_place_table(some_rows(), PAPER))
    failures = text.split("## Failures")[1].split("##")[0]
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in failures.strip().split("\n")]
    assert rows[2:] == [
        ["ompl-projected", "timeout", "no path", "1 of 10"],
        ["ompl-projected", "uncertified_goal", "–", "1 of 10"],
    ]
    only_solved = build_place_table([run("birrt", 0, 1.0)], PAPER)
    assert "## Failures\n\nNone." in render_markdown(only_solved)


def test_latex_is_balanced_escaped_and_in_the_papers_layout():
    text = render_latex(build_place_table([*some_rows(), run("my_50%_planner", 0, 1.0)], PAPER))
    assert r"my\_50\%\_planner" in text and "∞" not in text and "–" not in text
    assert text.count(r"\begin{") == text.count(r"\end{") == 2
    tabular = text.split(r"\toprule")[1].split(r"\bottomrule")[0]
    lines = [line for line in tabular.strip().splitlines() if "rule" not in line]
    assert {line.count("&") for line in lines} == {1 + 3}
    assert r"Accuracy (\%) & paper & 93.7 & -- & -- \\" in text


def test_csv_is_long_and_exact():
    table = build_place_table(some_rows(), PAPER)
    records = list(csv.DictReader(io.StringIO(render_place(some_rows(), PAPER).csv)))
    found = {(r["planner"], r["metric"], r["source"]): r for r in records}
    assert len(found) == len(records)
    assert found["ompl-projected", "time_mean", "paper"]["value"] == "22.95"
    ours = found["ompl-projected", "time_median", "ours"]
    measured = summaries(table)["ompl-projected"].measured["time_median"]
    assert (float(ours["value"]), ours["high"], ours["n"]) == (measured.estimate, "inf", "10")
    assert found["birrt", "projections_median", "ours"]["value"] == ""
    assert not [key for key in found if key[0] == "cvq-mpt"]


# ---------------------------------------------------------------- directories


def store(directory, rows, **provenance):
    with RunStore.open(directory, CONFIGURATION, provenance) as opened:
        opened.append(rows)


def test_a_directory_is_rendered_beside_its_runs(tmp_path):
    store(
        tmp_path,
        some_rows(),
        git_commit="a" * 40,
        cpu_model="Fast CPU",
        cpu_count=2,
        weights={"mpnet": "f" * 64},
    )
    written = render_directory(tmp_path)
    assert [path.name for path in written.paths] == ["table.md", "table.tex", "table.csv"]
    texts = [path.read_bytes() for path in written.paths]
    title, _, head, *_ = texts[0].decode().splitlines()
    assert title == f"# {TABLES['place-task'].title}"
    assert written.brief[0] == f"{TABLES['place-task'].title}: 10 problems, cutoff 10 s"
    assert head.startswith(
        f"cutoff 10 s · commit {'a' * 12} · weights mpnet {'f' * 12} · machine Fast CPU, 2 cores"
    )
    assert head.endswith("20 rows")
    assert [path.read_bytes() for path in render_directory(tmp_path).paths] == texts


def test_the_head_of_a_table_tells_of_every_session_and_of_uncommitted_changes(tmp_path):
    store(tmp_path, some_rows(), git_commit="a" * 40)
    store(tmp_path, [run("birrt", 10, 1.0)], git_commit="b" * 40, git_dirty=True)
    head = render_directory(tmp_path).paths[0].read_text().splitlines()[2]
    assert f"commit {'a' * 12} and {'b' * 12} WITH UNCOMMITTED CHANGES" in head


@pytest.mark.parametrize(("suite", "papers"), [("place-task-with-can", True), ("my-place", False)])
def test_only_suites_of_the_paper_get_its_numbers(tmp_path, suite, papers):
    store(tmp_path, [run("ompl-projected", 0, 1.0, suite=suite)])
    for path in render_directory(tmp_path).paths:
        assert ("22.95" in path.read_text()) is papers


def test_every_suite_has_a_title():
    assert TABLES.keys() == SUITES.keys()


def test_directories_without_runs_say_what_to_do(tmp_path):
    with pytest.raises(RunStoreError, match=r"not a directory; run an experiment with --out"):
        render_directory(tmp_path / "absent")
    with pytest.raises(RunStoreError, match=r"no runs\.csv; run an experiment"):
        render_directory(tmp_path)
    (tmp_path / PARTIAL_FILE).write_text("")
    with pytest.raises(RunStoreError, match="interrupted run; repeat its command"):
        render_directory(tmp_path)
    write_rows(tmp_path / "runs.csv", [])
    with pytest.raises(RunStoreError, match="no rows"):
        render_directory(tmp_path)
    write_rows(tmp_path / "runs.csv", some_rows())
    with pytest.raises(RunStoreError, match=r"no provenance\.json"):
        render_directory(tmp_path)
    (tmp_path / "provenance.json").write_text(json.dumps({"configuration": {}}))
    assert "cutoff not recorded · commit unknown" in render_directory(tmp_path).paths[0].read_text()
