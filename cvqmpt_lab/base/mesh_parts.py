"""Triangles of mesh files that have several parts, by trimesh."""

import numpy as np
import trimesh


def points_and_faces(path: str) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (n, 3) in the file's unit, and triangles (f, 3), of all parts of a file."""
    mesh = trimesh.load_mesh(path, process=False)
    points = np.asarray(mesh.vertices, dtype=float).reshape(-1, 3)
    return points, np.asarray(mesh.faces, dtype=int).reshape(-1, 3)


def hull_faces(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (n, 3) and triangles (f, 3) of the convex hull of points (m, 3)."""
    hull = trimesh.Trimesh(points, process=False).convex_hull
    return np.asarray(hull.vertices), np.asarray(hull.faces)
