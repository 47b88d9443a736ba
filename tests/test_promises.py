"""What was tried of a promise is written where it is read."""

import pytest
from promises import BEGIN, Recorder


def test_a_page_without_its_marks_is_refused(tmp_path):
    (tmp_path / "page.md").write_text(BEGIN)
    with pytest.raises(pytest.UsageError, match="once each"):
        Recorder(tmp_path / "page.md", "long")
