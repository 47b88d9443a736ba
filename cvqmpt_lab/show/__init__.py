"""Pictures without a display, films, web pages, and recordings for rerun.

Inside IPython an import of this package shows robots, scenes, problems, tasks and their solutions
as pictures; elsewhere it imports nothing.
"""

import sys
from typing import Any


def load_ipython_extension(shell: Any) -> None:
    """Let a shell of IPython show all that `draw` draws; `%load_ext cvqmpt_lab.show` calls it."""
    from cvqmpt_lab.show.picture import DRAWN, html_of, png_of

    for kind in DRAWN:
        shell.display_formatter.formatters["image/png"].for_type(kind, png_of)
        shell.display_formatter.formatters["text/html"].for_type(kind, html_of)


if "IPython" in sys.modules:
    _shell = sys.modules["IPython"].get_ipython()
    if _shell is not None:
        load_ipython_extension(_shell)
