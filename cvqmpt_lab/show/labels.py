"""Words under pictures: legends and captions on strips of their own, so that they cover nothing."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from cvqmpt_lab.show.meshes import Colour

INK = (40, 40, 44)
PAPER = (255, 255, 255)
SMALLEST_FONT = 11  # [pixels]; the font is larger under wide pictures
LETTERS_ACROSS = 62


@dataclass(frozen=True)
class Label:
    """A word of a legend."""

    text: str
    colour: Colour | None = None  # Of the swatch before it; None for words alone


@dataclass(frozen=True)
class Placed:
    """A label in its place on a strip."""

    label: Label
    x: float  # Left end [pixels]
    line: int  # From 0


class Strip:
    """Labels in lines as wide as a picture; as high as they need."""

    def __init__(self, labels: Sequence[Label], width: int, letters_across: int = LETTERS_ACROSS) -> None:
        """width: [pixels]; letters_across: capital letters that would fit side by side."""
        self._width, self._size = width, max(SMALLEST_FONT, width // letters_across)
        self._font = ImageFont.load_default(self._size)
        self._placed = self._in_lines(labels)
        self.height = round((1 + max((item.line for item in self._placed), default=0)) * self._line_height)
        """[pixels]"""

    @property
    def _line_height(self) -> float:
        return 1.9 * self._size

    def _in_lines(self, labels: Sequence[Label]) -> list[Placed]:
        """Labels from left to right, in a new line where the width ends."""
        placed, gap = [], 1.3 * self._size
        x, line = gap / 2, 0
        for label in labels:
            needed = self._font.getlength(label.text) + (0 if label.colour is None else 1.3 * self._size)
            if x + needed > self._width and x > gap:
                x, line = gap / 2, line + 1
            placed.append(Placed(label, x, line))
            x += needed + gap
        return placed

    def image(self) -> np.ndarray:
        """Colours (height, width, 3), 8 bit."""
        image = Image.new("RGB", (self._width, self.height), PAPER)
        draw = ImageDraw.Draw(image)
        for item in self._placed:
            x, middle = item.x, (item.line + 0.5) * self._line_height
            if item.label.colour is not None:
                fill = tuple(round(255 * part) for part in item.label.colour)
                half = 0.42 * self._size
                box = (x, middle - half, x + 2 * half, middle + half)
                draw.rounded_rectangle(box, radius=0.2 * self._size, fill=fill, outline=INK)
                x += 1.3 * self._size
            draw.text((x, middle), item.label.text, fill=INK, font=self._font, anchor="lm")
        return np.array(image)
