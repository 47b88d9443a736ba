"""Pictures without a display, films, web pages, and recordings for rerun.

`bodies` is the one drawing of robot, scene and path; `raster` and `picture` make images and films
of it, `web_page` a page, `recording` a file for rerun. `draw` takes any of our objects.

Command: ``cvqmpt plan --picture plan.png --save plan.html``. Extra: none. Page: docs/gallery.md.

If this package is imported in IPython, notebooks show robots, scenes, problems, tasks and their
solutions as pictures. Outside of IPython it imports nothing.
"""

import sys
from typing import Any


def load_ipython_extension(shell: Any) -> None:
    """Show values of all types of `draw`; `%load_ext cvqmpt_lab.features.pictures` calls this."""
    from cvqmpt_lab.features.pictures.picture import DRAWN_TYPES, html_of, png_of

    for kind in DRAWN_TYPES:
        shell.display_formatter.formatters["image/png"].for_type(kind, png_of)
        shell.display_formatter.formatters["text/html"].for_type(kind, html_of)


if "IPython" in sys.modules:
    _shell = sys.modules["IPython"].get_ipython()
    if _shell is not None:
        load_ipython_extension(_shell)
