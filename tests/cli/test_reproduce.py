"""`cvqmpt reproduce`: output files, continuation of earlier runs, errors."""

import json
import re
from dataclasses import replace

import pytest

from cvqmpt_lab.base.errors import UnknownChoiceError
from cvqmpt_lab.benchmarks.declarations import SUITES
from cvqmpt_lab.benchmarks.results.row import RUNS_FILE
from cvqmpt_lab.benchmarks.suite_parts import Amount, PlannerGroups
from cvqmpt_lab.cli.reproduce_command import OverallProgress, duration_line
from cvqmpt_lab.experiments import experiment
from cvqmpt_lab.experiments.experiment import Experiment, parts_of
from cvqmpt_lab.experiments.figures.paper import reproduce_figure
from cvqmpt_lab.paper_tables.statements import CLAIMS
from cvqmpt_lab.planning.by_name import declared
from cvqmpt_lab.planning.planners import PLANNERS
from cvqmpt_lab.search.result import Budget


def test_every_suite_and_the_controls_are_part_of_everything():
    full = {part.folder: part.experiment for part in parts_of("full")}
    # these need optional planners, problems or a simulation
    others = {"peers", "peers-two-arms", "motion-bench", "motion-bench-upright", "executed"}
    others |= {"place-task-ompl-tuning"}  # settings were chosen on its problems
    assert full.keys() == {*SUITES, "controls"} - others
    assert set(full["controls"].planners) > set(declared("control"))
    others = [name for name in PLANNERS if name not in PlannerGroups.in_ompl]
    assert tuple(others) == PlannerGroups.every and {*PlannerGroups.in_ompl} < {*PLANNERS}
    with pytest.raises(UnknownChoiceError, match="tiny"):
        parts_of("tiny")


def test_it_writes_rows_tables_verdicts_and_the_report_and_goes_on_where_it_was(
    cvqmpt, monkeypatch, tmp_path
):
    planners = ("ompl-projected", "ompl-cvq")
    two = Amount(profile="small", problems=2, cost=100.0, planners=planners)
    suite = replace(SUITES["place-task-ompl"], amounts=(two,))
    monkeypatch.setattr(experiment, "SUITES", {"place-task-ompl": suite})

    def drawn(figure, folder, command, problems):  # of two problems
        return reproduce_figure(figure, folder, command, problems[:2])

    monkeypatch.setattr("cvqmpt_lab.cli.reproduce_command.reproduce_figure", drawn)
    words, said = f"reproduce all --profile small --jobs 1 --out {tmp_path}", []
    for module in ("reproduce_command", "options"):
        monkeypatch.setattr(f"cvqmpt_lab.cli.{module}.log", said.append)
    lines = cvqmpt(words).splitlines()
    assert said[0].startswith("place-task-ompl: 4 runs on 1 processes take about ")
    assert any(line.startswith("histogram: 30 problems") for line in said)
    report = (tmp_path / "report.html").read_text()
    assert "A path in 3-D: problem 6000, ompl-cvq, seed 0" in report
    heads = ["sentence", "paper", "here, with interval", "committed"]
    assert re.split(" {2,}", lines[0]) == heads
    told = zip(lines[1 : 1 + len(CLAIMS)], CLAIMS, strict=True)
    assert all(line.startswith(claim.title) for line, claim in told)
    by_title = {line[:35].strip(): line for line in lines}
    number = r"0\.49 +\d\.\d+ \[[\d.]+, [\d.]+\], 2 cannot decide +0\.\d\d, replicated"
    assert re.search(number, by_title["almost twice as fast"])
    assert re.search(r"1\.18 +not run +\d\.\d\d,", by_title["sensed scenes: outperforms"])
    assert any("same 4 runs, 4 have the same result" in line for line in lines)
    assert len(lines) <= 40 and max(map(len, lines)) <= 113 + len(str(tmp_path))
    assert str(tmp_path / "report.html") in lines[-1] and str(tmp_path / "claims.md") in lines[-2]
    for name in ("report.html", "claims.md", "histogram/values.csv", "place-task-ompl/table.md"):
        assert (tmp_path / name).is_file()
    folder = tmp_path / "place-task-ompl"
    record = json.loads((folder / "provenance.json").read_text())
    assert record["command"][:3] == ["cvqmpt", "reproduce", folder.name] and record["wall_s"] > 0.0
    for page, picture in (("claims.md", "(claims.png)"), ("report.html", 'src="data:image/png')):
        text = (tmp_path / page).read_text()
        assert "These rows were made with --profile small" in text
        # the page opens on the table and the picture
        marks = ("2 cannot decide", picture, "Table I" if page == "claims.md" else "<h2>Tables")
        places = [text.index(mark) for mark in marks]
        assert places == sorted(places)
    assert (tmp_path / "claims.png").read_bytes().startswith(b"\x89PNG")
    rows = (folder / RUNS_FILE).read_bytes()
    for name in ("write_claims", "write_report"):  # seen above, and slow
        monkeypatch.setattr(f"cvqmpt_lab.cli.reproduce_command.{name}", lambda *_, **named: "")
    cvqmpt(words)
    assert (folder / RUNS_FILE).read_bytes() == rows


def test_the_small_profile_runs_five_problems_of_every_suite_that_judges_the_paper():
    parts = {part.folder: part for part in parts_of("small")}
    assert parts.keys() == {name for claim in CLAIMS for name in claim.suites}
    compared = {name: set(part.experiment.planners) for name, part in parts.items()}
    for name, part in parts.items():
        setup = part.experiment
        assert setup.problems == tuple(SUITES[name].problems[:5]) and setup.seeds == (0,)
        assert setup.budget.cost == 100.0, "the limit of the committed rows"
        assert part.command[:3] == ["cvqmpt", "reproduce", name]
    for claim in CLAIMS:
        first = {claim.planners[0], *claim.baselines[:1]}
        assert all(first <= compared[name] for name in claim.suites)


def test_the_profile_of_the_paper_is_said_to_take_less_than_20_minutes():
    parts = parts_of("paper")
    names = ["place-task-ompl", "place-task-ompl-more", "multi-sequence-published"]
    assert [part.folder for part in parts] == names
    told = [duration_line(part.experiment, 2) for part in parts]
    assert told[0].startswith("place-task-ompl: 600 runs on 2 processes take about ")
    times = [line.partition(" about ")[2].split() for line in told]
    assert sum(int(number) * {"s": 1, "min": 60}[unit] for number, unit, *_ in times) < 20 * 60


def test_the_time_left_of_all_suites_counts_what_is_still_to_be_made(capsys, monkeypatch):
    now = [0.0]
    monkeypatch.setattr("time.perf_counter", lambda: now[0])
    budget = Budget(iterations=1)
    one = Experiment("place-task", tuple(range(12)), ("birrt",), (0,), budget)
    two = Experiment("multi-sequence", (0, 1, 2), ("birrt",), (0,), budget)
    whole = OverallProgress((one, two))
    first = whole.bar("one", one)
    first(10, 12, "")  # ten were kept
    for made in (11, 12):
        now[0] += 10.0
        first(made, 12, "solved")
    second = whole.bar("two", two)
    second(1, 3, "")
    now[0] += 200.0
    second(2, 3, "")
    told = [line.partition("(")[2] for line in capsys.readouterr().err.splitlines()]
    lefts = [line.removeprefix("all: ").partition(")")[0] for line in told]
    assert lefts == ["estimating", "610 s left", "600 s left", "400 s left", "200 s left"]
