"""URDF files made from the slider arm."""

import pytest


@pytest.fixture
def edited(slider_arm_urdf, tmp_path):
    """Return a function that writes the slider arm with some text replaced and returns the path."""

    def write(*replacements, name="arm.urdf"):
        text = slider_arm_urdf.read_text()
        for old, new in replacements:
            assert old in text
            text = text.replace(old, new)
        path = tmp_path / name
        path.write_text(text)
        return path

    return write
