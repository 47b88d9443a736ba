"""Training clouds as depth cameras with errors see a scene: by the code that evaluation's cameras are made of."""

import numpy as np

from cvqmpt_lab.sensing.camera import DepthCamera, Lens
from cvqmpt_lab.sensing.noise import DepthNoise, MaterialShares, measured
from cvqmpt_lab.sensing.render import Ball, Cuboid, Drum, Solid, view_of
from cvqmpt_lab.training.paths import Shapes

SMALL = Lens(width=80, height=72, vertical_fov=75.0, near=0.5, far=5.46)
"""The evaluation camera's range with a sixteenth of its pixels, which still are more than a cloud's points."""
SOLIDS = (
    lambda T, size: Cuboid(T, 0.5 * size),
    lambda T, size: Drum(T, size[0], 0.5 * size[2]),
    lambda T, size: Ball(T, size[0]),
)
"""By the kind of a shape."""


def measured_points(
    shapes: Shapes, eyes: np.ndarray, target: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """Points (k, 3) float32 [m] that cameras at eyes (c, 3), looking at target (3,), measure, in random order."""
    solids: list[Solid] = [
        SOLIDS[kind](T, size)
        for kind, size, T in zip(
            shapes.kind, shapes.size.astype(float), shapes.pose.astype(float), strict=True
        )
    ]
    materials = MaterialShares().drawn(len(solids), rng)
    seen = []
    for eye in eyes:
        x, y, z = map(float, eye)
        view = view_of(solids, DepthCamera((x, y, z), tuple(target)), SMALL)
        seen.append(measured(view, solids, materials, DepthNoise(), rng).points)
    points = np.concatenate(seen)
    return points[rng.permutation(len(points))].astype(np.float32)
