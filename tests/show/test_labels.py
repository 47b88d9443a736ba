"""Strips hold every label, in as many lines as they need."""

import numpy as np
import pytest

from cvqmpt_lab.show.labels import Label, Strip

WORDS = [Label(f"word {k}", (0.1 * k, 0.5, 0.5)) for k in range(8)]


@pytest.mark.parametrize("width", [120, 300, 900])
def test_every_swatch_is_on_the_strip(width):
    strip = Strip(WORDS, width)
    image = strip.image()
    assert image.shape == (strip.height, width, 3)
    for word in WORDS:
        swatch = np.array([round(255 * part) for part in word.colour])
        assert (image == swatch).all(axis=-1).sum() > 20, word


def test_narrow_strips_are_higher():
    heights = [Strip(WORDS, width, letters_across=80).height for width in (160, 320, 900)]
    assert heights[0] > heights[1] > heights[2]
