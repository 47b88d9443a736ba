"""URDF files made from the slider arm, and a check of their errors."""

import pytest

from cvqmpt_lab.errors import CvqmptError


@pytest.fixture
def edited(slider_arm_urdf, tmp_path):
    """Writes the slider arm with some text replaced, and returns the path."""

    def write(*replacements, name="arm.urdf"):
        text = slider_arm_urdf.read_text()
        for old, new in replacements:
            assert old in text
            text = text.replace(old, new)
        path = tmp_path / name
        path.write_text(text)
        return path

    return write


@pytest.fixture
def refused():
    """Asserts that loading fails with one line that matches a pattern."""

    def check(pattern, load, *args, **kwargs):
        with pytest.raises(CvqmptError, match=pattern) as caught:
            load(*args, **kwargs)
        assert "\n" not in str(caught.value)

    return check
