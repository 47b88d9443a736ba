"""Base of robots, scenes, problems and solutions, which notebooks show as a picture below a few
lines of text.
"""

from base64 import b64encode
from html import escape
from importlib import import_module


class Pictured:
    """A value whose `repr` has a few lines, and that `show.draw` can draw."""

    def _repr_png_(self) -> bytes | None:
        """The picture, or None without anything to see;
        the module by its name, which stands on this one.
        """
        return import_module("cvqmpt_lab.show.draw").png_of(self)

    def _repr_html_(self) -> str:
        """The text above the picture."""
        png = self._repr_png_()
        picture = f'<img src="data:image/png;base64,{b64encode(png).decode()}">' if png else ""
        return f"<pre>{escape(repr(self))}</pre>{picture}"
