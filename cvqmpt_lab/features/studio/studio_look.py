"""How the studio draws: outlines, ghosts beside solid bodies, views, plots of a timed path."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from cvqmpt_lab.features.pictures.bodies import Body, Drawing, drawing_of_problem
from cvqmpt_lab.features.pictures.curves import Plot, plots_along
from cvqmpt_lab.features.pictures.meshes import Mesh
from cvqmpt_lab.features.studio.studio_planning import Response, timed_states
from cvqmpt_lab.search.result import JointPath

# azimuth and elevation of the eye [rad], as on the page of a plan
VIEWS: Mapping[str, tuple[float, float]] = {
    "top": (-0.5 * math.pi, 1.55),
    "front": (0.0, 0.0),
    "side": (-0.5 * math.pi, 0.0),
}
GHOST_LAYERS = {"start": 0.0015, "goals": 0.003}  # how much thinner ghosts are [m]


@dataclass(frozen=True, eq=False)
class Timed:
    """The states of a certified path that are shown, with plots."""

    drawing: Drawing
    plots: list[Plot]
    times: np.ndarray | None  # (m,) [s]; None: the path cannot be timed

    @property
    def across(self) -> np.ndarray:
        """The horizontal axis (m,) of the plots: seconds, or numbers of states."""
        return np.arange(len(self.drawing.labels)) if self.times is None else self.times

    def label(self, k: int) -> str:
        """Text at state k."""
        if self.times is None:
            return self.drawing.labels[k]
        return f"{self.times[k]:.1f} of {self.times[-1]:.1f} s"


def timed(response: Response) -> Timed | None:
    """Time the path of a response at the speed of its request; None without a path of its own."""
    if response.path is None or response.message:
        return None
    problem = response.problem
    times, states = timed_states(problem, response.path, response.request.speed)
    drawing = drawing_of_problem(problem, JointPath(states), ghosts=0)
    return Timed(drawing, plots_along(problem, states), times)


def outline(mesh: Mesh, sharp: float = 0.8) -> np.ndarray:
    """Edges (k, 2, 3) [m] of a mesh at which facets meet at more than `sharp` [rad], or end."""
    corners = mesh.corners
    facing = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    facing /= np.maximum(np.linalg.norm(facing, axis=1, keepdims=True), 1e-30)
    _, number = np.unique(corners.reshape(-1, 3).round(6), axis=0, return_inverse=True)
    number = number.reshape(-1, 3)
    ends = np.stack([number, np.roll(number, -1, axis=1)], axis=2).reshape(-1, 2)
    places = np.stack([corners, np.roll(corners, -1, axis=1)], axis=2).reshape(-1, 2, 3)
    normals = np.repeat(facing, 3, axis=0)
    _, first, edge = np.unique(
        np.sort(ends, axis=1), axis=0, return_index=True, return_inverse=True
    )
    edge = edge.reshape(-1)
    # a facet that meets the first one of its edge at a large angle
    bent = (normals * normals[first[edge]]).sum(axis=1) < math.cos(sharp)
    counts = np.bincount(edge, minlength=len(first))
    drawn = (np.bincount(edge, weights=bent, minlength=len(first)) > 0) | (counts == 1)
    return places[first[drawn]]


def thinner(body: Body) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 3) [m] and faces (f, 3) of a body; of a ghost, a little inside of its surface.

    Start and goal would else flicker where they coincide with the robot or with each other.
    """
    points, normals, faces = body.mesh.shared
    return points - GHOST_LAYERS.get(body.layer.split("/")[0], 0.0) * normals, faces
