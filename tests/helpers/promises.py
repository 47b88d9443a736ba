"""Pytest plugin of docs/guarantees.md: numbers of trials of each promise, and their results.

A test names its promise and trials by `@pytest.mark.promise(words, unit, ci=..., long=...)`: `ci`
with every commit, `long` with `pytest --long`; without numbers hypothesis's examples. The fixture
`trials` is that number. `--record F.md` writes a line for each promise between two marks of F.md.
"""

import subprocess
from datetime import date
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

BEGIN, END = "<!-- figures: written by make trust -->", "<!-- end of figures -->"
HEAD = "| part | promise | tried | faults | form | date | commit |\n|---|---|---|---|---|---|---|"
EXAMPLES = {"ci": 25, "long": 1000}
MARKER = "promise(words, unit, ci, long): trials that a promise of docs/guarantees.md is put to"


def pytest_addoption(parser):
    parser.addoption(
        "--long", action="store_true", help="every case and trial, for hours; a few otherwise"
    )
    parser.addoption("--trials", type=int, metavar="N", help="so many trials of each promise")
    parser.addoption("--record", type=Path, metavar="F.md", help="write the figures into this page")


def pytest_configure(config):
    config.addinivalue_line("markers", MARKER)
    for name, examples in {**EXAMPLES, "part": config.getoption("--trials") or 1}.items():
        settings.register_profile(
            name,
            max_examples=examples,
            deadline=None,
            derandomize=True,
            database=None,
            suppress_health_check=list(HealthCheck),
        )
    settings.load_profile(form_of(config))
    # not in workers of xdist
    if config.getoption("--record") and not hasattr(config, "workerinput"):
        config.pluginmanager.register(Recorder(config.getoption("--record"), form_of(config)))


def form_of(config):
    if config.getoption("--trials"):
        return "part"
    return "long" if config.getoption("--long") else "ci"


def pytest_collection_modifyitems(config, items):
    """Attach its promise to each test; deselect those without trials in this mode."""
    left_out = []
    for item in items:
        if item.get_closest_marker("promise"):
            part, words, tried, unit = figure_of(item)
            item.user_properties.append(("promise", [part, words, tried, unit]))
            left_out += [] if tried else [item]
    config.hook.pytest_deselected(items=left_out)
    items[:] = [item for item in items if item not in left_out]


def figure_of(item):
    marker, form = item.get_closest_marker("promise"), form_of(item.config)
    words, unit = marker.args
    tried = item.config.getoption("--trials") or marker.kwargs.get(form, EXAMPLES.get(form))
    return item.path.stem.removeprefix("test_"), words, tried, unit


@pytest.fixture
def trials(request):
    return figure_of(request.node)[2]


class Recorder:
    """Writes the table after every test; trials of tests of the same promise are summed."""

    def __init__(self, page, form):
        self.page, self.form, self.figures = page, form, {}
        words = ("git", "describe", "--always", "--dirty")
        self.commit = subprocess.check_output(words, text=True).strip()
        rows_of(page)

    def pytest_runtest_logreport(self, report):
        promised = dict(report.user_properties).get("promise")
        if promised and (report.when == "call" or report.failed):
            part, words, tried, unit = promised
            before, failed = self.figures.get((part, words), (0, 0))
            self.figures[part, words] = before + tried, failed + report.failed
            self.write(part, words, unit)

    def write(self, part, words, unit):
        tried, failed = self.figures[part, words]
        count = f"{tried:,} {unit}".replace(",", " ")
        cells = (part, words, count, failed, self.form, date.today(), self.commit)
        rows = rows_of(self.page) | {(part, words): f"| {' | '.join(map(str, cells))} |"}
        before, rest = self.page.read_text().split(BEGIN)
        table = "\n".join((HEAD, *(rows[key] for key in sorted(rows))))
        self.page.write_text(f"{before}{BEGIN}\n{table}\n{END}{rest.split(END)[1]}")


def rows_of(page):
    """Rows of the page's table by part and promise."""
    text = page.read_text()
    if text.count(BEGIN) != 1 or text.count(END) != 1 or text.index(BEGIN) > text.index(END):
        raise pytest.UsageError(f"{page} must hold, once each: {BEGIN} ... {END}")
    lines = text.split(BEGIN)[1].split(END)[0].strip().splitlines()[2:]
    return {tuple(cell.strip() for cell in line.split("|")[1:3]): line for line in lines}
