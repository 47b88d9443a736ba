"""Tables; the paper's claims, their pages and the html report."""

import json
import re
import shutil
import sqlite3
import subprocess
import zlib
from base64 import b64decode
from itertools import accumulate, product

import pytest
from command_line import refused as command_refused
from made_rows import a_failure, a_results_folder, a_row
from ompl._benchmark_statistics import readBenchmarkLog
from refusals import refused

from cvqmpt_lab.base.errors import RunStoreError
from cvqmpt_lab.benchmarks.results.row import RUNS_FILE, read_rows, write_rows
from cvqmpt_lab.benchmarks.results.store import PARTIAL_FILE, RunStore
from cvqmpt_lab.paper_tables import committed, pages
from cvqmpt_lab.paper_tables.committed import RESULTS
from cvqmpt_lab.paper_tables.layouts import place_table
from cvqmpt_lab.paper_tables.motion_bench_table import class_lines
from cvqmpt_lab.paper_tables.plots import OURS, line_style, profile
from cvqmpt_lab.paper_tables.quoted import Quoted, clear
from cvqmpt_lab.paper_tables.rendering import render_directory, table_of
from cvqmpt_lab.paper_tables.statements import read_published
from cvqmpt_lab.paper_tables.table_engine import SuiteTable, by_planner, failure
from cvqmpt_lab.paper_tables.writers import Ratio, latex_table
from cvqmpt_lab.planning.planners import PLANNERS


def rows(suite="place-task", count=10):
    runs = product(("birrt", "ompl-projected"), range(count))
    return [a_row(f"p{k}", planner, suite=suite, t_total_s=1.0) for planner, k in runs]


def store(directory, some_rows, **session):
    with RunStore.open(directory, {"suite": "place-task", "cutoff_s": 10.0}, session) as opened:
        opened.append(some_rows)


def test_rows_of_an_earlier_sampler_of_a_name_say_so(tmp_path):
    tables = []
    for reading in ("merged", "every-waypoint"):
        own = [a_row(f"{k}", "cvq-mpt", suite="place-task", reading=reading) for k in range(3)]
        store(tmp_path / reading, [*rows(count=3), *own], streams=2)
        tables.append(render_directory(tmp_path / reading).texts["table.md"])
    note = "Earlier samplers with the same names: `cvq-mpt` (every-waypoint)."
    assert [note in table for table in tables] == [False, True]


def test_the_head_line_names_every_commit_and_changes_that_were_not_committed(tmp_path):
    store(tmp_path, rows(), git_commit="a" * 40, cpu_model="Fast CPU", cpu_count=2)
    store(tmp_path, rows(count=11)[10:11], git_commit="b" * 40, git_dirty=True)
    head = render_directory(tmp_path).texts["table.md"].splitlines()[2]
    assert head.startswith(f"cutoff 10 s · commit {'a' * 12} and {'b' * 12} WITH UNCOMMITTED")


def test_directories_without_runs_say_what_to_do(tmp_path):
    def directory_refused(message, directory=tmp_path):
        refused(message, render_directory, directory, error=RunStoreError)

    directory_refused(r"not a directory; run an experiment with --out", tmp_path / "absent")
    directory_refused(r"no runs\.csv; run an experiment")
    (tmp_path / PARTIAL_FILE).write_text("")
    directory_refused("interrupted run; repeat its command")
    write_rows(tmp_path / "runs.csv", [])
    directory_refused("no rows")
    write_rows(tmp_path / "runs.csv", rows())
    directory_refused(r"no provenance\.json")
    (tmp_path / "provenance.json").write_text(json.dumps({"configuration": {}}))
    assert "cutoff not recorded · commit unknown" in render_directory(tmp_path).texts["table.md"]


def test_names_of_rows_become_neither_html_nor_images_in_markdown(tmp_path):
    name = "<img src=x>![y](http://evil.example/z.png)"
    runs = [a_row(f"p{k}", name, suite=f"mine {name}", t_total_s=1.0) for k in range(3)]
    store(tmp_path, runs, git_commit="<b>")
    text = render_directory(tmp_path).texts["table.md"]
    assert "evil.example" in text and "&lt;img" in text
    assert "<img" not in text and "<b>" not in text and "![" not in text


TABLES = sorted(RESULTS.glob("*/table.tex"))
COMPILER = shutil.which("pdflatex")
DOCUMENT = (
    r"\documentclass[twocolumn]{article}\usepackage[a4paper,margin=15mm]{geometry}\usepackage{booktabs}"
    "\n\\begin{document}\n%s\n\\end{document}\n"
)


@pytest.mark.skipif(COMPILER is None, reason="no pdflatex (apt: texlive-latex-recommended)")
def test_committed_tables_compile_and_fit_on_pages(tmp_path):
    tables = "\n\\clearpage\n".join(path.read_text(encoding="utf-8") for path in TABLES)
    (tmp_path / "tables.tex").write_text(DOCUMENT % tables, encoding="utf-8")
    words = [COMPILER, "-halt-on-error", "-interaction=nonstopmode", "tables.tex"]
    how = {"capture_output": True, "text": True, "timeout": 120, "errors": "replace"}
    done = subprocess.run(words, cwd=tmp_path, **how)
    assert done.returncode == 0, done.stdout[-2000:]
    assert "Overfull" not in done.stdout and "too large" not in done.stdout


PAPER = read_published("place_task.csv", "Place Task")


def run(planner, problem, time=None, **values):
    """Return a row; a failure if `time` is None."""
    make, time = (a_failure, 10.0) if time is None else (a_row, time)
    return make(f"p{problem}", planner, **{"suite": "place-task", "t_total_s": time, **values})


def test_a_table_is_of_one_suite_and_names_are_escaped():
    for rows in ([], [run("birrt", 0, 1.0), run("birrt", 0, 1.0, suite="random")]):
        refused("one suite", place_table, rows, PAPER)
    table = [["", "", "my_50%_#1"], ["time", "ours", "–∞ −1"], ["[x]", "{a} & b\\\\", "<|>"]]
    escaped = latex_table("", "x", [[table]])
    assert r"my\_50\%\_\#1" in escaped and escaped.isascii()
    assert "{}[x] &" in escaped, "read as an argument of the line before"
    lines_have_equal_cells(escaped)


def lines_have_equal_cells(text):
    """Assert that LaTeX is balanced, and that lines have as many cells as their table."""
    plain = re.sub(r"\\[&%{}$#_]", "", text)
    assert plain.isascii() and not set("<>|%#_") & set(plain)
    depths = list(accumulate({"{": 1, "}": -1}.get(character, 0) for character in plain))
    assert min(depths) == depths[-1] == 0
    tables = re.findall(r"{tabular}{([lc]+)}\s+\\toprule(.*?)\\bottomrule", plain, re.DOTALL)
    assert len(tables) == plain.count(r"\begin{tabular}") > 0
    for columns, body in tables:
        lines = body.replace(r"\midrule", "").split("\n")
        cells = [line.count("&") + 1 for line in lines if line.strip()]
        assert set(cells) == {len(columns)}
        assert all(line.endswith(r" \\") for line in lines if line.strip())


def test_tables_of_own_planners_have_no_paper_unique_labels_and_the_best_bold(tmp_path):
    times = {f"mine{k}": 1.0 + k for k in range(6)}
    made = [run(name, p, time + 0.1 * p) for name, time in times.items() for p in range(9)]
    store(tmp_path / "runs_a", made)
    texts = render_directory(tmp_path / "runs_a").texts
    latex = texts["table.tex"].partition("\\begin")[2]
    assert "paper" not in latex and re.findall(r"tab:[\w-]*", latex) == [
        "tab:runs-a",
        "tab:runs-a-2",
    ]
    assert latex.count(r"\textbf{1.40}") == 2, "median and mean of the fastest planner"
    assert len(re.search(r"\\caption{(.*?)}\\label", latex)[1]) < 120
    assert re.search(r"\| mine0 +\| 100 +\| \*\*1.40\*\*", texts["table.md"])
    assert "**" not in "".join(render_directory(tmp_path / "runs_a").brief)


def test_the_committed_page_and_the_readme_are_what_the_command_writes_from_the_rows(
    committed_evidence, committed_claims
):
    assert (
        committed.stale_pages(committed.committed_pages(committed_evidence, committed_claims)) == []
    )


def test_the_results_begin_with_advice_and_mark_clear_ratios(committed_evidence):
    shown = Quoted(committed_evidence).ratio("robots", "roadmap")
    assert clear(shown) == f"**{shown}**" and clear("1.2 [0.9, 1.3]") == "1.2 [0.9, 1.3]"
    text = (committed.DOCS / "results.md").read_text(encoding="utf-8")
    assert text.index("(use.png)") < text.index("## Is the paper replicated?")
    assert text.count("<details>") == text.count("</details>") >= 4


def test_a_readme_without_marks_is_refused():
    refused("add both where", committed.with_part, "a README without marks", "answer", "")


def test_a_roadmap_is_compared_by_the_work_of_birrt_and_where_it_held_no_path():
    rows = []
    for name, checks in (("a", 400), ("b", 1000), ("c", 1500)):
        own = {
            "suite": "motion-bench",
            "n_projections": 0,
            "path_length_rad": 6.0,
            "t_total_s": 0.1,
        }
        rows.append(a_row(name, planner="birrt", n_state_checks=checks, **own))
        own["fallback"] = "birrt around 3 free nodes" if name == "c" else None
        rows.append(a_row(name, planner="roadmap", n_state_checks=checks // 2, **own))
    lines = class_lines(rows)[1:]
    counts = {"0 to 500": "1", "500 to 2000": "2", "any, and no path through the roadmap": "1"}
    assert {line[0]: line[1] for line in lines} == counts
    assert all(line[3].startswith("0.5") for line in lines)


def test_a_table_in_the_terminal_says_what_infinity_means():
    made = SuiteTable("place-task", "", (), {"": [["planner", "time [s]"], ["a", "∞"]]}, "")
    assert made.brief[-1].startswith("∞: a failed run counts as infinite")


def test_pictures_of_the_committed_rows_are_drawn_without_a_display(
    committed_evidence, committed_claims
):
    for path, picture in committed.committed_pictures(committed_evidence, committed_claims).items():
        assert path.is_file() and picture.startswith(b"\x89PNG") and len(picture) > 20_000


def own_folder(folder, planner="my_module:plan"):
    """Rows of a folder of eight problems, two of which have no goal; a planner of the user."""
    rows = []
    for name, time in (("birrt", 1.0), (planner, 2.0)):
        for k in range(8):
            if k > 5:
                rows.append(a_failure(f"p{k}", name, suite="shelves", fail_reason="no_goal"))
                continue
            values = {"t_total_s": time + 0.1 * k, "path_length_rad": 5.0, "vertices": 9}
            counts = {"n_projections": 10, "n_state_checks": 100 + k}
            rows.append(a_row(f"p{k}", name, suite="shelves", **values, **counts))
    store(folder, rows)
    return folder


def test_a_table_of_own_problems_says_nothing_of_the_paper_and_counts_those_without_a_goal(
    tmp_path,
):
    made = render_directory(own_folder(tmp_path))
    assert made.brief[0].startswith("Folder shelves: 8 problems, 2 of 8 problems have no goal, cut")
    text = made.texts["table.md"]
    heads = [line for line in text.splitlines() if line.startswith(("#", "| planner"))]
    assert not any("paper" in line for line in heads) and "paper's cost" not in text
    assert "## Accuracy\n\n| planner        | solved [%]" in text
    assert "2 of 8 problems have no goal, such as p6, p7: every planner fails on them" in text


def test_a_report_of_own_problems_has_a_scatter_plot_and_their_planner_thick(tmp_path):
    text = pages.report_html(pages.evidence_of(own_folder(tmp_path)), verdicts=False)
    assert "too little to judge the paper" not in text and "the paper's sentences" not in text
    assert "<strong>2 of 8 problems have no goal</strong>" in text
    assert re.findall(r"<option selected>([^<]*)", text) == ["my_module:plan", "birrt"]
    widths = dict(
        reversed(found)
        for found in re.findall(r'stroke-width="([\d.]+)"[^>]*><title>([^<]*)', text)
    )
    assert float(widths["my_module:plan"]) > 2 * float(widths["birrt"])
    alone = [row for row in read_rows(tmp_path / RUNS_FILE) if row.planner == "birrt"]
    write_rows(tmp_path / RUNS_FILE, alone)
    text = pages.report_html(pages.evidence_of(tmp_path), verdicts=False)
    assert 'class="scatter"' not in text, "there is one planner"


EVIL = "<script>alert(1)</script>$x$"
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    times = {"cvq_mpt": 1.0, "opt_cvq_mpt": 0.8, "ompl_projected": 4.0, "birrt": 2.0}
    folder = a_results_folder(tmp_path_factory.mktemp("results"), **times)
    path = folder / "place-task" / RUNS_FILE
    shared = {"suite": "place-task", "t_total_s": 1.0, "path_length_rad": 5.0}
    rows = [a_row(f"p{k}", EVIL, **shared) for k in range(9)]
    rows.append(a_failure("p9", EVIL, suite="place-task", detail="</table>&"))
    write_rows(path, [*read_rows(path), *rows])
    return folder


@pytest.fixture(scope="module")
def page(results):
    turned = {"place-task": {"title": "problem 3", "html": "</script>turned"}}
    return pages.report_html(pages.evidence_of(results), paths=turned)


def test_a_report_holds_all_its_parts_needs_no_network_and_names_are_text(page):
    texts = "Solved against time", "Time by stage", "Provenance"
    assert all(text in page for text in texts) and "Is the paper replicated?" not in page
    assert page.count("<svg") == 5 and "cvqmpt plan place-task --problem PROBLEM" in page
    marks = ('<details class="suite"', "solved [%]", "<svg", "Lines:")
    places = [page.index(mark) for mark in marks]
    assert places == sorted(places), "suites are folded, tables come before charts"
    assert f'background: {line_style("opt-cvq-mpt")["color"]}"></i> opt-cvq-mpt' in page
    assert 'href="#rows/0/opt-cvq-mpt"' in page, "a number leads to its rows"
    fetched = re.findall(r'(?:src|href)="([^"]*)"', page) + re.findall(r"url\(([^)]*)\)", page)
    assert all(target.startswith(("#", "data:")) for target in fetched) and "@import" not in page
    assert "<script>alert" not in page and "</table>&" not in page and "</script>turned" not in page
    assert "&lt;script&gt;alert(1)&lt;/script&gt;$x$" in page


def test_a_report_shows_notes_without_marks_of_markdown():
    text = pages.report_html(pages.evidence_of(RESULTS / "place-task-ompl"))
    shown = re.sub(r"<script.*?</script>", "", text, flags=re.DOTALL)
    assert "differ in samples alone" in shown and "`" not in shown and "](" not in shown


def test_a_report_packs_its_rows_marks_the_best_and_colours_ratios(page):
    packed = re.search(r'id="data">([\w+/=]+)</script>', page)[1]
    data = json.loads(zlib.decompress(b64decode(packed)))
    (section,) = data["sections"]
    assert section["path"]["html"] == "</script>turned" and len(section["rows"][EVIL]) == 10
    assert len(packed) < 0.3 * len(json.dumps(data)), "rows are most of a report"
    worse = "<td class=more>2.00<small>[2.00, 2.10]</small></td>"
    assert pages.html_cell("2.00 [2.00, 2.10]", Ratio("time / birrt")) == worse
    best = pages.html_cell("**0.5** [0.4, 0.9]", Ratio("work"))
    assert best.startswith("<td class=less><b>0.5</b>")
    plain = pages.html_cell("0.5 [0.4, 0.9]", "shoulder / elbow")
    assert plain == "<td>0.5<small>[0.4, 0.9]</small></td>", "coloured by its title"
    assert pages.html_cell("0.5 [0.4, 0.9]", "time [s]") == "<td>0.5<small>[0.4, 0.9]</small></td>"


def test_a_report_of_executions_or_of_failures_alone_leaves_plots_without_values_out(tmp_path):
    executed = pages.report_html(pages.evidence_of(RESULTS / "executed"))
    assert "Executed in simulation" in executed and executed.count("<svg") == 0
    folder = a_results_folder(tmp_path, birrt=None)
    failed = pages.report_html(pages.evidence_of(folder))
    assert failed.count("<svg") == 3 and "Path length, solved runs" not in failed


def test_the_command_writes_it_beside_the_rows_and_refuses_other_folders(
    cvqmpt, capsys, results, tmp_path
):
    cvqmpt("report", results / "place-task", "--out", tmp_path / "r.html")
    assert (tmp_path / "r.html").read_text().startswith("<!doctype html>")
    assert "contains none; make one with" in command_refused(capsys, "report", tmp_path)


def test_a_report_of_one_directory_points_to_the_verdicts_and_has_its_name(
    cvqmpt, results, tmp_path
):
    cvqmpt("report", results / "place-task", "--out", tmp_path / "r.html")
    text = (tmp_path / "r.html").read_text()
    assert "<title>place-task</title>" in text and "too little to judge the paper" in text
    assert "Is the paper replicated?" not in text and "A verdict is" not in text


@pytest.mark.parametrize(
    "suite", ["place-task", "factorial", "motion-bench", "peers", "multi-sequence", "open-door"]
)
def test_titles_say_whether_a_column_is_a_ratio_and_lines_of_latex_have_equal_cells(
    suite, tmp_path
):
    head, *lines = (RESULTS / suite / RUNS_FILE).read_text().splitlines(keepends=True)
    (tmp_path / RUNS_FILE).write_text("".join([head, *lines[:: 1 + len(lines) // 20]]))
    made = table_of(read_rows(tmp_path / RUNS_FILE))
    heads = [part[0] for part in made.sections.values() if part and not isinstance(part[0], str)]
    titled = {title for head in heads for title in head if " / " in title}
    ratios = {title for head in heads for title in head if isinstance(title, Ratio)}
    assert titled - ratios <= {"the first / the second"}
    assert suite != "factorial" or ratios == {"work", "projections", "length", "G"}
    lines_have_equal_cells(made.latex("95 % of {a}_b & c", "d"))


def test_failures_of_refused_paths_are_not_certified_and_why():
    row = a_failure(planner="mpnet", fail_reason="uncertified_collision", detail="a and b")
    assert failure(row) == ("not certified: collision", "a and b")
    assert "| mpnet   | not certified: collision | a and b" in table_of([a_row(), row]).markdown


def test_the_log_for_ompl_is_read_by_its_own_script(cvqmpt, capsys, tmp_path):
    rows = (
        a_row(t_total_s=2.5, t_simplify_s=0.5, path_length_raw_rad=9.0, path_length_rad=8.0),
        a_row("a; b", t_total_s=1.0, n_projections=7, min_clearance_m=-0.001),
        a_failure(planner="mpnet", t_total_s=10.0),
        a_failure("p2", "mpnet", fail_reason="uncertified_collision"),
    )
    run, log, made = (tmp_path / f"run{ending}" for ending in ("", ".log", ".db"))
    store(run, rows, platform="Linux-6 of a lab", date_utc="2026-01-02T03:04:05+00:00")
    cvqmpt("report", run, "--ompl-log", log)
    readBenchmarkLog(str(made), [str(log)], moveitformat=False)
    capsys.readouterr()
    with sqlite3.connect(made) as connection:
        found = connection.execute(
            """SELECT plannerConfigs.name, problem, solved, status, fail_reason, time,
            simplification_time, simplified_solution_length, projections, clearance
            FROM runs JOIN plannerConfigs ON plannerid = plannerConfigs.id ORDER BY runs.id"""
        ).fetchall()
    assert found == [
        ("birrt", "a, b", 1, 6, None, 1.0, None, None, 7, -0.001),
        ("birrt", "place_0", 1, 6, None, 2.0, 0.5, 8.0, None, None),
        ("mpnet", "p2", 0, 0, "uncertified_collision", *[None] * 5),
        ("mpnet", "place_0", 0, 4, "timeout", 10.0, *[None] * 4),
    ]
    store(tmp_path / "unknown", rows, platform=" ")
    cvqmpt("report", tmp_path / "unknown", "--ompl-log", log)
    assert "Running on unknown\n" in log.read_text()
    store(tmp_path / "untimed", [a_row()])
    told = command_refused(capsys, "report", tmp_path / "untimed", "--ompl-log", log)
    assert "1 solved runs have no time, first problem place_0 of birrt" in told


def test_profiles_are_files_of_the_format_named_with_own_planners_thick(
    cvqmpt, capsys, results, tmp_path
):
    folder = results / "place-task"
    for name, begins in (("f.png", b"\x89PNG"), ("f.svg", b"<?xml"), ("f.pdf", b"%PDF")):
        cvqmpt("figure", "length", folder, "--out", tmp_path / name)
        assert (tmp_path / name).read_bytes().startswith(begins)
    told = cvqmpt("figure", "work", folder, "--out", tmp_path / "f.png")
    assert f"have these values: {EVIL}" in told
    widths = {
        line.get_label(): line.get_linewidth()
        for line in profile(by_planner(read_rows(folder / RUNS_FILE), ()), "solved").axes[0].lines
    }
    assert widths[EVIL] > max(width for name, width in widths.items() if name != EVIL)
    for words, says in (
        (("length", folder, "--out", tmp_path / "f.bmp"), "pdf, svg, png"),
        (("work",), "needs a results directory"),
        (("histogram", folder), "takes no FOLDER"),
        (("work", folder, "--problem", 5), "--problem 5 does not go with work; leave it out"),
        (("work", folder, "--problems", 5), "--problems 5 does not go with work"),
        (("work", folder, "--model", "mine"), "--model mine does not go with work"),
        (("work", folder, "--seed", 3), "--seed 3 does not go with work"),
        (("concept", "--problems", 5), "--problems 5 does not go with concept"),
        (("histogram", "--problem", 5), "--problem 5 does not go with histogram"),
    ):
        assert says in command_refused(capsys, "figure", *words)


@pytest.mark.skipif(CHROMIUM is None, reason="no chromium here (Debian: apt install chromium)")
def test_a_browser_reads_it_without_a_message_on_its_console(page, tmp_path):
    opened = "<script>document.querySelector('.path').open = true;</script></body>"
    (tmp_path / "r.html").write_text(page.replace("</body>", opened))
    arguments = ["--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"]
    arguments += [
        "--virtual-time-budget=20000",
        "--dump-dom",
        "--enable-logging=stderr",
        f"--user-data-dir={tmp_path}",
    ]
    words = [CHROMIUM, *arguments, (tmp_path / "r.html").as_uri() + "#rows/0/opt-cvq-mpt"]
    done = subprocess.run(words, capture_output=True, text=True, timeout=500, check=True)
    assert "CONSOLE" not in done.stderr
    told = "<dialog", "opt-cvq-mpt: rows of place-task", "9 of 10 runs solved by both", "<circle"
    assert all(text in done.stdout for text in told), "the script ran"
    assert re.search(r'srcdoc="[^"]*turned"', done.stdout), "what is opened shows its page"


def test_every_planner_has_a_colour_of_its_own_and_ours_a_thick_line():
    assert len({line_style(name)["color"] for name in PLANNERS}) == len(PLANNERS)
    styles = [line_style(name) for name in ("birrt", "birrt improved", OURS, "peer")]
    assert styles[0]["color"] == styles[1]["color"] != styles[2]["color"]
    assert styles[2]["linewidth"] > styles[0]["linewidth"] and styles[3] == line_style("peer")
    assert styles[3]["linewidth"] > styles[2]["linewidth"], "a user's own planner"
    product = line_style("cvq:uniform+free-draws")
    assert product["linestyle"] == ":" and product["linewidth"] == styles[0]["linewidth"]


def test_passages_are_grouped_by_kind_and_width_with_what_is_solved_in_a_time():
    made = [
        make(f"{8 * k + g}/{g + 1}-{group}", planner, suite="passages", t_total_s=time)
        for g, group in enumerate(("maze 5 cm", "maze 6 cm"))
        for k in range(4)
        for planner, time, make in (
            ("birrt", 5.0, a_failure),
            ("cells", (0.5, 1.5, 1.6, 3.0)[k], a_row),
        )
    ]
    found = table_of(made)
    assert found.size == "8 problems, 2 passages"
    head, *lines = found.sections["By passage"]
    assert head[:5] == ["passage", "planner", "problems", "solved [%]", "in 1 s [%]"]
    cells = {tuple(line[:2]): [cell.split()[0].strip("*") for cell in line[2:]] for line in lines}
    assert cells["maze 5 cm", "cells"][:5] == ["4", "100", "25.0", "75.0", "1.55"]
    assert cells["maze 6 cm", "birrt"][:5] == ["4", "0", "0", "0", "∞"]
