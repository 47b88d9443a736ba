"""Random rigid moves of a body none of whose corners is off by more than a given length."""

import numpy as np
from scipy.spatial.transform import Rotation


def moves(rng, corners, most, count):
    """Return rigid moves (at most count, 4, 4) by which no corner (k, 3) is off by over `most`.

    Turns about the longest axis of the body, which move corners least, are among them.
    """
    centre = 0.5 * (corners.max(axis=0) + corners.min(axis=0))
    longest = np.linalg.svd(corners - corners.mean(axis=0), full_matrices=False)[2][0]
    found = []
    for k in range(count):
        axis = longest if k % 2 else rng.standard_normal(3)
        slide = rng.standard_normal(3) * (0.0 if k % 4 < 2 else 1e-3)
        turn = 1e-3 * axis / np.linalg.norm(axis)
        off = way(corners, move(turn, centre, slide))
        T = move(turn * most / off * 0.999, centre, slide * most / off * 0.999)
        if way(corners, T) <= most:
            found.append(T)
    return np.array(found).reshape(-1, 4, 4)


def move(turn, centre, slide):
    """A turn by a rotation vector (3,) about a point (3,), and a slide (3,), as (4, 4)."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(turn).as_matrix()
    T[:3, 3] = centre - T[:3, :3] @ centre + slide
    return T


def way(corners, T):
    """Return by how much the corner (k, 3) that moves furthest moves."""
    return np.linalg.norm(corners @ T[:3, :3].T + T[:3, 3] - corners, axis=1).max()
