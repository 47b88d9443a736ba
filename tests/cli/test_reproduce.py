"""`cvqmpt reproduce`: output files, continuation of earlier runs, errors."""

import json
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
    one = Amount(profile="small", problems=1, cutoff=5.0)
    suite = replace(SUITES["place-task"], planners=("birrt",), amounts=(one,))
    monkeypatch.setattr(experiment, "SUITES", {"place-task": suite})

    def drawn(figure, folder, command, problems):  # of two problems
        return reproduce_figure(figure, folder, command, problems[:2])

    monkeypatch.setattr("cvqmpt_lab.cli.reproduce_command.reproduce_figure", drawn)
    words, said = f"reproduce all --profile small --jobs 1 --out {tmp_path}", []
    for module in ("reproduce_command", "options"):
        monkeypatch.setattr(f"cvqmpt_lab.cli.{module}.log", said.append)
    lines = cvqmpt(words).splitlines()
    assert said[0].startswith("place-task: 1 runs on 1 processes take about ")
    assert any(line.startswith("histogram: 30 problems") for line in said)
    assert "A path in 3-D: problem 0, birrt, seed 0" in (tmp_path / "report.html").read_text()
    assert "own verdict" in lines[1] and "committed verdict" in lines[1]
    told = zip(lines[2 : 2 + len(CLAIMS)], CLAIMS, strict=True)
    assert all(line.startswith(claim.title) for line, claim in told)
    assert len(lines) <= 40 and max(map(len, lines)) <= 100 + len(str(tmp_path))
    assert str(tmp_path / "report.html") in lines[-1] and str(tmp_path / "claims.md") in lines[-2]
    for name in ("report.html", "claims.md", "histogram/values.csv", "place-task/table.md"):
        assert (tmp_path / name).is_file()
    record = json.loads((tmp_path / "place-task" / "provenance.json").read_text())
    assert record["command"][:3] == ["cvqmpt", "reproduce", "place-task"] and record["wall_s"] > 0.0
    for page in ("claims.md", "report.html"):
        assert "These rows were made with --profile small" in (tmp_path / page).read_text()
    rows = (tmp_path / "place-task" / RUNS_FILE).read_bytes()
    for name in ("page_text", "verdict_lines", "write_report"):  # seen above, and slow
        monkeypatch.setattr(f"cvqmpt_lab.cli.reproduce_command.{name}", lambda *_, **named: "")
    cvqmpt(words)
    assert (tmp_path / "place-task" / RUNS_FILE).read_bytes() == rows


def test_the_profile_of_the_paper_is_said_to_take_less_than_20_minutes():
    parts = parts_of("paper")
    assert [part.folder for part in parts] == ["place-task-ompl", "multi-sequence-published"]
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
