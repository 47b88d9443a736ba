"""How a search asks a sequence model for the next code: rows of prefixes that grow by one code a step."""

from typing import Protocol

import numpy as np

from cvqmpt_lab.errors import InvalidInputError


class StepDecoder(Protocol):
    """Prefixes of codes, one a row, and what may follow them.

    Classes are the codes, then the start token (never a target), then the goal token. Rows of one query
    (start and goal) lie together, queries in their order, equally many rows each. Logits are float32.
    """

    def start(self) -> np.ndarray:
        """Logits (queries, n_classes) of the first code; called once, before `advance`."""

    def advance(self, parents: np.ndarray, codes: np.ndarray) -> np.ndarray:
        """Replace the rows and return the logits (rows, n_classes) of what follows them.

        Parameters
        ----------
        parents
            (rows,) int64: the earlier row, of the same query, that each new row continues. The number of rows is
            chosen at the first step and stays.
        codes
            (rows,) int64: what each adds to it.
        """


def rows_per_scene(rows: int, scenes: int) -> int:
    """How many rows belong to each scene, rows being grouped by scene.

    Raises
    ------
    InvalidInputError
        When they do not divide evenly.
    """
    if rows % scenes:
        raise InvalidInputError(f"{rows} starts and goals for {scenes} scenes; give equally many for each")
    return rows // scenes
