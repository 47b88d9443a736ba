"""Every promise that has a short form, put to it; what is counted is written where it is read."""

from datetime import date

import pytest

from cli.main import main
from cvqmpt_lab.errors import InvalidInputError
from experiments.trust.check import Check, Finding, Trial
from experiments.trust.figures import BEGIN, END, HEAD, record
from experiments.trust.table import PARTS, checks_of

SHORT = [(part, check) for part in PARTS for check in checks_of(part) if check.short]


@pytest.mark.parametrize(("part", "check"), SHORT, ids=[f"{part}: {check.promise}" for part, check in SHORT])
def test_the_short_form_finds_no_fault(part, check):
    trial = check.attack(check.short)
    assert trial.tried >= check.short and not trial.faults, list(trial.faults)


def finding(promise, tried, faults=()):
    return Finding(
        "files",
        Check(promise, "inputs", 1, 2, lambda count: Trial(count, ())),
        Trial(tried, faults),
        1.0,
        1.0,
    )


def test_figures_replace_those_of_the_same_promise_and_keep_the_others(tmp_path):
    page = tmp_path / "page.md"
    page.write_text(f"Before\n{BEGIN}\n{HEAD}\n{END}\nafter\n")
    record(page, [finding("b", 1200), finding("a", 5)], "long", date(2026, 1, 2))
    record(page, [finding("b", 7, ("it broke",))], "short", date(2026, 1, 3))
    rows = (
        "| files | a | 5 inputs | 0 | long | 2026-01-02 |\n| files | b | 7 inputs | 1 | short | 2026-01-03 |"
    )
    assert page.read_text() == f"Before\n{BEGIN}\n{HEAD}\n{rows}\n{END}\nafter\n"


def test_a_page_without_its_marks_is_refused(tmp_path):
    (tmp_path / "page.md").write_text(BEGIN)
    with pytest.raises(InvalidInputError, match="once each"):
        record(tmp_path / "page.md", [], "long", date(2026, 1, 2))


def test_the_command_counts_prints_and_fails_on_a_fault(monkeypatch, capsys, tmp_path):
    checks = (
        finding("holds", 3).check,
        Check("breaks", "inputs", 2, 4, lambda count: Trial(count, ["seed 1: no"])),
        Check("ends", "inputs", 2, 4, lambda count: Trial(count // 0, ())),
    )
    monkeypatch.setattr("cli.trust_command.checks_of", lambda part: checks)
    assert main(["trust", "files", "--only", "holds"]) == 0
    assert main(["trust", "files", "--long"]) == 1
    assert main(["trust", "files", "--only", "holds", "--trials", "9"]) == 0
    out = capsys.readouterr().out
    assert "holds: 9 inputs, no fault" in out and "ended by ZeroDivisionError" in out
    assert (
        "breaks: 4 inputs, 1 faults" in out and "  seed 1: no" in out and "holds: 2 inputs, no fault" in out
    )
