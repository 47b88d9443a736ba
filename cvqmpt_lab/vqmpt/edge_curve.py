"""P(a straight motion is free) from the smallest clearance along it: a logistic curve, the same for
all robots.

    log odds of P(free) = slope * clearance + bias

Distances from a point cloud and from a scene that is known lie differently: there is a curve for
each.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from cvqmpt_lab.files import read_json_object
from cvqmpt_lab.vqmpt.weights import WEIGHTS

CURVES_FILE = "edge_curves.json"
SCENE, CLOUD = SOURCES = "scene", "cloud"
"""Where clearances are read:
in the collision checker's distance grid, or in the distance field of a cloud.
"""


class EdgeCurve(NamedTuple):
    """A fitted curve."""

    slope: float  # [1/m]
    bias: float  # log odds at clearance 0

    def log_odds(self, clearance: np.ndarray) -> np.ndarray:
        """Log odds of P(free) at smallest clearances [m]."""
        return self.slope * clearance + self.bias


@lru_cache(maxsize=2)
def shipped_curve(source: str) -> EdgeCurve:
    """The shipped curve for clearances of a source, one of `SOURCES`."""
    fitted = read_json_object(WEIGHTS / "edges" / CURVES_FILE)["curves"][source]
    return EdgeCurve(float(fitted["slope"]), float(fitted["bias"]))
