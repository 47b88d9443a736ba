"""Bodies of the second judge (triangles and balls), and overlap and depth of two bodies by fcl."""

from itertools import product

import fcl
import numpy as np
import trimesh
from scipy.spatial import cKDTree

# largest numbers of contacts and of corners at which the depth of an overlapping pair is measured
CONTACTS, CORNERS = 2000, 100


class Body:
    """Triangles (f, 3, 3) [m] that move together; surfaces may be open or self-crossing."""

    radius = 0.0

    def __init__(self, name, group, triangles):
        mesh = trimesh.Trimesh(
            triangles.reshape(-1, 3), np.arange(3 * len(triangles)).reshape(-1, 3)
        )
        self.name, self.group = name, group
        # merged mesh: each corner occurs once
        self.triangles, self.points = np.array(mesh.triangles), np.array(mesh.vertices)
        parts = trimesh.graph.connected_component_labels(mesh.edges, node_count=len(self.points))
        # one corner of each connected part
        self.one_of_each = self.points[np.unique(parts, return_index=True)[1]]
        self.box = corners_around(self.points)
        shape = fcl.BVHModel()
        shape.beginModel(len(mesh.vertices), len(mesh.faces))
        shape.addSubModel(mesh.vertices, mesh.faces)
        shape.endModel()
        self.object = fcl.CollisionObject(shape)

    def placed(self, T):
        self.object.setTransform(fcl.Transform(T[:3, :3], T[:3, 3]))
        return self.object

    def holds(self, points):
        """Return whether points (k, 3) are inside, by the winding number of the surface (k,)."""
        found = ((points > self.box[0]) & (points < self.box[-1])).all(axis=1)
        for k in np.flatnonzero(found):
            a, b, c = np.moveaxis(self.triangles - points[k], 1, 0)
            x, y, z = (np.linalg.norm(side, axis=1) for side in (a, b, c))
            below = x * y * z + (a * b).sum(1) * z + (b * c).sum(1) * x + (c * a).sum(1) * y
            found[k] = abs(np.arctan2((a * np.cross(b, c)).sum(1), below).sum()) > np.pi
        return found

    def distances(self, points):
        """Return the distances (k,) of points (k, 3) to the surface [m]."""
        repeated = (np.tile(point, (len(self.triangles), 1)) for point in points)
        away = (trimesh.triangles.closest_point(self.triangles, p) - p for p in repeated)
        return np.array([np.linalg.norm(each, axis=1).min() for each in away])


class Balls:
    """Balls of one radius around points (k, 3) [m] that move together with a group."""

    def __init__(self, name, group, points, radius):
        self.name, self.group, self.points, self.radius = name, group, points, radius
        self.one_of_each, self.tree = points, cKDTree(points)
        self.box = corners_around(np.concatenate([points - radius, points + radius]))
        self.objects = [
            fcl.CollisionObject(fcl.Sphere(radius), fcl.Transform(np.eye(3), p)) for p in points
        ]
        self.manager = fcl.DynamicAABBTreeCollisionManager()
        self.manager.registerObjects(self.objects)
        self.manager.setup()


def corners_around(points):
    """Return the corners (8, 3) of the axis-aligned box around points, from lowest to highest."""
    return np.array(list(product(*zip(points.min(axis=0), points.max(axis=0), strict=True))))


def furthest(body, direction):
    """Return the point (3,) of a body that is furthest along a unit direction."""
    return body.points[(body.points @ direction).argmax()] + body.radius * direction


def touching(a, b, T):
    """Return whether surfaces of a and b overlap; T (4, 4) is the pose of b in the frame of a."""
    if isinstance(a, Balls) and isinstance(b, Balls):
        return depth(a, b, T) > 0.0
    if isinstance(b, Balls):
        return touching(b, a, np.linalg.inv(T))
    if isinstance(a, Body):
        request, result = fcl.CollisionRequest(), fcl.CollisionResult()
        return fcl.collide(a.placed(np.eye(4)), b.placed(T), request, result) > 0
    data = fcl.CollisionData()
    a.manager.collide(b.placed(T), data, fcl.defaultCollisionCallback)
    return data.result.is_collision


def swallowed(a, b, T):
    """Return whether a connected part of one body is inside the other; T as in `touching`."""
    if isinstance(a, Body) and a.holds(moved(T, b.one_of_each)).any():
        return True
    return isinstance(b, Body) and bool(b.holds(moved(np.linalg.inv(T), a.one_of_each)).any())


def depth(a, b, T):
    """Return a lower bound on the penetration depth of a and b [m]; T as in `touching`."""
    if isinstance(a, Balls) and isinstance(b, Balls):
        return a.radius + b.radius - a.tree.query(moved(T, b.points))[0].min()
    if isinstance(a, Balls):
        return depth(b, a, np.linalg.inv(T))
    if isinstance(b, Balls):
        centres = moved(T, b.points)
        off = np.maximum(np.maximum(a.box[0] - centres, centres - a.box[-1]), 0.0)
        centres = centres[np.linalg.norm(off, axis=1).argsort()[:CORNERS]]
        return b.radius - (np.where(a.holds(centres), -1.0, 1.0) * a.distances(centres)).min()
    deepest = [0.0]
    for one, other, M in ((a, b, T), (b, a, np.linalg.inv(T))):
        corners = other.points[:: 1 + len(other.points) // CORNERS]
        some = moved(M, np.concatenate([corners, other.one_of_each]))
        deepest += list(one.distances(some[one.holds(some)]))
    request = fcl.CollisionRequest(num_max_contacts=CONTACTS, enable_contact=True)
    result = fcl.CollisionResult()
    if fcl.collide(a.placed(np.eye(4)), b.placed(T), request, result):
        first, second = np.array([(contact.b1, contact.b2) for contact in result.contacts]).T
        deepest.append(triangle_depths(a.triangles[first], moved(T, b.triangles[second])).max())
    return max(deepest)


def triangle_depths(first, second):
    """Return penetration depths (k,) [m] of triangles (k, 3, 3): least overlap along 11 axes."""
    e, f = np.roll(first, -1, axis=1) - first, np.roll(second, -1, axis=1) - second
    edges = np.cross(e[:, :, None], f[:, None]).reshape(len(e), 9, 3)
    axes = np.concatenate(
        [edges, np.cross(e[:, :1], e[:, 1:2]), np.cross(f[:, :1], f[:, 1:2])], axis=1
    )
    lengths = np.linalg.norm(axes, axis=2)
    x, y = np.einsum("kai,kci->kac", axes, first), np.einsum("kai,kci->kac", axes, second)
    overlap = np.minimum(x.max(2) - y.min(2), y.max(2) - x.min(2))
    usable = lengths > 1e-9 * lengths.max(axis=1, keepdims=True)
    return np.where(usable, overlap / np.where(usable, lengths, 1.0), np.inf).min(axis=1)


def moved(T, points):
    return points @ T[:3, :3].T + T[:3, 3]
