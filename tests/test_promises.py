"""The trials of a promise are written beside it."""

import pytest
from promises import BEGIN, Recorder
from refusals import refused


def test_a_page_without_its_marks_is_refused(tmp_path):
    (tmp_path / "page.md").write_text(BEGIN)
    refused("once each", Recorder, tmp_path / "page.md", "long", error=pytest.UsageError)
