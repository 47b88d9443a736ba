"""Pictures without a display, films, web pages, and recordings for rerun.

Inside IPython an import of this package shows robots, scenes, problems, tasks and their solutions
as pictures; elsewhere it imports nothing.
"""

import sys
from typing import Any


def load_ipython_extension(shell: Any) -> None:
    """Register the pictures with a shell of IPython; `%load_ext cvqmpt_lab.show` calls it."""
    from cvqmpt_lab.show.picture import register_pictures

    register_pictures(shell)


if "IPython" in sys.modules:
    _shell = sys.modules["IPython"].get_ipython()
    if _shell is not None:
        load_ipython_extension(_shell)
