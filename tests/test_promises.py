"""What was tried of a promise is written where it is read."""

from types import SimpleNamespace

import pytest
from promises import BEGIN, END, HEAD, Recorder


def report(tried, failed=False):
    promised = ("promise", ["files", "hostile x", tried, "files"])
    return SimpleNamespace(user_properties=[promised], when="call", failed=failed)


def test_trials_of_a_promise_are_summed_and_other_rows_stay(tmp_path):
    page = tmp_path / "page.md"
    page.write_text(
        f"Before\n{BEGIN}\n{HEAD}\n| files | a | 5 inputs | 0 |\n| files | hostile x | 1 |\n{END}\nafter\n"
    )
    recorder = Recorder(page, "long")
    for one in (report(1000), report(200, failed=True)):
        recorder.pytest_runtest_logreport(one)
    kept, row = page.read_text().removeprefix(f"Before\n{BEGIN}\n{HEAD}\n").split("\n")[:2]
    assert kept == "| files | a | 5 inputs | 0 |" and row.startswith(
        "| files | hostile x | 1 200 files | 1 | long |"
    )
    assert page.read_text().endswith(f"{END}\nafter\n")


def test_a_page_without_its_marks_is_refused(tmp_path):
    (tmp_path / "page.md").write_text(BEGIN)
    with pytest.raises(pytest.UsageError, match="once each"):
        Recorder(tmp_path / "page.md", "long")
