"""The html report: its content, names escaped as text, and no complaint from a browser."""

import re
import shutil
import subprocess

import pytest
from made_rows import a_failure, a_results_folder, a_row

from cli.main import main
from cvqmpt_lab.planners import PLANNERS
from cvqmpt_lab.results.row import RUNS_FILE, read_rows, write_rows
from paper_tables.pages import evidence_of, report_html
from paper_tables.plots import COLOURS, OURS, line_style

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
    return report_html(evidence_of(results), paths=turned)


def test_a_report_holds_verdicts_plots_rows_and_where_they_come_from(page):
    texts = "Does the paper hold?", "not comparable", "Solved against time", "Where time goes"
    assert all(text in page for text in (*texts, "Provenance"))
    assert page.count("<svg") == 6 and "cvqmpt plan place-task --problem PROBLEM" in page
    assert 'href="#rows/0/opt-cvq-mpt"' in page, "a number leads to its rows"


def test_it_needs_no_network(page):
    fetched = re.findall(r'(?:src|href)="([^"]*)"', page) + re.findall(r"url\(([^)]*)\)", page)
    assert all(target.startswith(("#", "data:")) for target in fetched)
    assert "@import" not in page


def test_names_from_rows_are_text(page):
    assert "<script>alert" not in page and "</table>&" not in page and "</script>turned" not in page
    assert "&lt;script&gt;alert(1)&lt;/script&gt;$x$" in page


def test_the_command_writes_it_beside_the_rows_and_refuses_other_folders(capsys, results, tmp_path):
    assert main(["report", str(results / "place-task"), "--out", str(tmp_path / "r.html")]) == 0
    assert (tmp_path / "r.html").read_text().startswith("<!doctype html>")
    assert main(["report", str(tmp_path)]) == 2
    assert "holds none; make one with" in capsys.readouterr().err


@pytest.mark.skipif(CHROMIUM is None, reason="no chromium here (Debian: apt install chromium)")
def test_a_browser_reads_it_without_a_message_on_its_console(page, tmp_path):
    opened = "<script>document.querySelector('.path').open = true;</script></body>"
    (tmp_path / "r.html").write_text(page.replace("</body>", opened))
    arguments = ["--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"]
    arguments += ["--dump-dom", "--enable-logging=stderr", f"--user-data-dir={tmp_path}"]
    words = [CHROMIUM, *arguments, (tmp_path / "r.html").as_uri() + "#rows/0/opt-cvq-mpt"]
    done = subprocess.run(words, capture_output=True, text=True, timeout=500, check=True)
    assert "CONSOLE" not in done.stderr
    told = "<dialog", "opt-cvq-mpt: rows of place-task"
    assert all(text in done.stdout for text in told), "the script ran"
    assert re.search(r'srcdoc="[^"]*turned"', done.stdout), "what is opened shows its page"


def test_every_planner_has_a_colour_of_its_own_and_ours_a_thick_line():
    assert len(set(COLOURS.values())) == len(COLOURS) and set(PLANNERS) <= set(COLOURS)
    styles = [line_style(name) for name in ("birrt", "birrt improved", OURS, "peer")]
    assert styles[0]["color"] == styles[1]["color"] != styles[2]["color"]
    assert styles[2]["linewidth"] > styles[0]["linewidth"] and styles[3] == line_style("peer")
