"""Check a proof of a robot's motion: python cvqmpt_check.py P.json --urdf R.urdf --motion M.json.

It says yes if the proof, the URDF and the motion's file alone show, for every moment: compared
bodies do not touch, obstacles are farther away than the clearance, positions, velocities and
accelerations are within the limits, the regions of the constraint are kept. Else it says no, with
what fails first. It needs Python 3.9 and numpy, no other file; docs/proof.md describes the format.

Rounding. Numbers are at most 1000 and links at most 500 (checked). A pose is a product of at most
1000 matrices with errors of about 1e-16 of their numbers: points are off by less than 1e-9 m.
Inequalities of lengths and angles have SLACK to spare, and boxes of joint values are widened by it.
Bezier points are halved by means, which do not enlarge errors. Errors of derivatives, which are
differences divided by times, are added where they are computed.
"""

import argparse
import base64
import hashlib
import io
import itertools
import json
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np

SCHEMA, SLACK, MOST_INTERVALS = "cvqmpt-proof/1", 2e-9, 300_000
# allowed beyond limits of position [rad or m], beyond others [shares], and beyond regions [rad, m]
BEYOND_POSITION, BEYOND_RATES, BEYOND_REGION = 2e-6, (1e-3, 1e-2), 5e-4
KINDS = ("lower", "upper", "velocity", "acceleration")


class Refused(Exception):
    """A proof that does not hold; the text says what fails."""


def need(holds, text):
    """Refuse unless `holds`; comparisons with nan do not hold."""
    if not holds:
        raise Refused(text)


def array(values, *shape):
    """Return finite numbers in a shape; -1 stands for any length."""
    found = np.array(values, dtype=float).reshape(shape)
    need((np.abs(found) <= 1e3).all(), "a number is above 1000 or not finite")
    return found


def turn(axis, angles):
    """Return the rotations (..., 3, 3) about a unit axis by angles (...)."""
    K = np.cross(np.eye(3), axis)  # K x is the cross product of axis and x
    sine, cosine = np.sin(angles)[..., None, None], np.cos(angles)[..., None, None]
    return np.eye(3) + sine * K + (1.0 - cosine) * (K @ K)


def attributes(element, tag):
    """Return the attributes of a part of a URDF's element; none without it."""
    return {} if element.find(tag) is None else element.find(tag).attrib


def origin(found):
    """Return the pose (4, 4) of "xyz" and "rpy": in an <origin> of a URDF, or in the proof."""
    T, words = np.eye(4), found or {}
    xyz, rpy = (words.get(key, "0 0 0").split() for key in ("xyz", "rpy"))
    x, y, z = (turn(axis, angle) for axis, angle in zip(np.eye(3), array(rpy, 3)))
    T[:3, :3], T[:3, 3] = z @ y @ x, array(xyz, 3)
    return T


class Robot:
    """The links of a URDF. Row 0 of all poses is the world, the others are the links."""

    def __init__(self, root, told):
        self.names, self.held = list(told["joints"]), told["held"]
        self.known = {joint.get("name"): joint for joint in root.findall("joint")}
        self.above = {joint.find("child").get("link"): joint for joint in self.known.values()}
        lost = [name for name in (*self.names, *self.held) if name not in self.known]
        need(not lost, f"the proof is of another robot: the URDF has no joints {lost}")
        twice = [name for name in self.names if self.names.count(name) > 1 or name in self.held]
        need(not twice, f"joints {twice} are planned twice, or planned and held")
        # of each row: row above, pose in it, unit axis, if it slides, planned joint, factor, offset
        self.joints = [(0, origin(told["base"]), np.zeros(3), False, 0, 0.0, 0.0)]
        self.moves: list[frozenset] = [frozenset()]  # joints (their rows) that move each row
        self.rows = {"": 0}
        links = root.findall("link")
        need(len(links) <= 500, "the URDF has more than 500 links")
        for link in links:
            self.add(link.get("name"))

    def add(self, link):
        """Add a link, after the links above it; return its row."""
        if link in self.rows:
            return self.rows[link]
        joint, entry = self.above.get(link), self.joints[0]
        if joint is not None:
            parent, name, kind = (
                joint.find("parent").get("link"),
                joint.get("name"),
                joint.get("type"),
            )
            still, slides = kind in ("fixed", "floating", "planar"), kind == "prismatic"
            need(still or slides or kind in ("revolute", "continuous"), f"{name} is {kind}")
            axis = array(attributes(joint, "axis").get("xyz", "1 0 0").split(), 3)
            axis = axis / max(np.linalg.norm(axis), 1e-9)
            leader = (0, 0.0, 0.0) if still else self.leader(name)
            entry = self.add(parent), origin(attributes(joint, "origin")), axis, slides, *leader
        row = self.rows[link] = len(self.joints)
        self.joints.append(entry)
        self.moves.append(self.moves[entry[0]].union([row] if entry[5] else []))
        return row

    def leader(self, name):
        """Return planned joint, factor and offset: value = factor * planned value + offset."""
        if name in self.held:
            return 0, 0.0, self.held[name]
        if name in self.names:
            return self.names.index(name), 1.0, 0.0
        mimic = attributes(self.known[name], "mimic")
        need(mimic, f"joint {name} is neither planned nor held")
        leader, factor, offset = self.leader(mimic["joint"])
        by, plus = array([mimic.get("multiplier", 1.0), mimic.get("offset", 0.0)], 2).tolist()
        return leader, by * factor, by * offset + plus

    def poses(self, q):
        """Return rotations (m, rows, 3, 3) and origins (m, rows, 3) at configurations q (m, n)."""
        R = np.tile(np.eye(3), (len(q), len(self.joints), 1, 1))
        p = np.zeros(R.shape[:3])
        for k, (row, T, axis, slides, leader, factor, offset) in enumerate(self.joints[1:], 1):
            value = factor * q[:, leader] + offset
            R[:, k], p[:, k] = R[:, row] @ T[:3, :3], p[:, row] + R[:, row] @ T[:3, 3]
            if slides:
                p[:, k] += (R[:, k] @ axis) * value[:, None]
            elif factor or offset:
                R[:, k] = R[:, k] @ turn(axis, value)
        return R, p

    def ways(self, placed, joints, points):
        """Bound how far points (m, k, 3) move while joints change by at most their half widths.

        Let the joints of the chain change one after the other, beginning at the frame from which
        the motion is seen. When joint j changes, those after it have not changed yet, and those
        before it have moved its axis together with the points. So the points turn by the change of
        j at the distance from the axis that they have in the poses R, p; sliders move them by it.
        """
        (R, p, widths), total = placed, np.full(len(points), SLACK)
        for j in joints:
            _, _, axis, slides, leader, factor, _ = self.joints[j]
            lever = 1.0
            if not slides:
                arms = points - p[:, None, j]
                squares, along = (arms**2).sum(axis=2), arms @ (R[:, j] @ axis)[:, :, None]
                # 1e-14 is more than the difference loses
                lever = np.sqrt((squares * (1.0 + 1e-14) - along[..., 0] ** 2).max(axis=1))
            total += lever * abs(factor) * widths[:, leader]
        return total


class Body:
    """The hull of points with balls of a radius around them, or of two discs across their line."""

    def __init__(self, name, row, points, radius, disc):
        need(len(points) and radius >= 0.0 and disc >= 0.0, f"{name} is no body")
        self.name, self.row, self.points, self.radius, self.disc = name, row, points, radius, disc
        self.axis = (points[-1] - points[0]) / max(np.linalg.norm(points[-1] - points[0]), 1e-9)
        ends = points.min(axis=0) - radius - disc, points.max(axis=0) + radius + disc
        self.box = np.array(np.meshgrid(*zip(*ends))).reshape(3, 8).T  # corners around it

    def reach(self, n):
        """Return the largest n . x (m,) of its points x, for unit vectors n (m, 3)."""
        # 1e-7 is more than the root loses
        across = np.sqrt(np.maximum(1.0 - (n @ self.axis) ** 2, 0.0)) + 1e-7
        return (self.points @ n.T).max(axis=0) + self.radius + self.disc * across


def shape_of(told):
    """Return points (k, 3), radius and disc of a body in the proof."""
    points = told["points"]
    if isinstance(points, str):
        points = np.frombuffer(base64.b64decode(points), dtype="<i2") * float(told["unit"])
    return array(points, -1, 3), float(told["radius"]), float(told["disc"])


def parts_of(kind, hulls):
    """Return points, radius and disc of each convex part of a <geometry>; none: a placeholder."""
    if kind.tag == "mesh":
        return hulls[kind.get("filename"), kind.get("scale", "1 1 1")]
    words = filter(None, map(kind.get, ("size", "radius", "length")))
    sizes = array(" ".join(words).split(), -1)
    if not sizes.any():
        return []
    sizes[sizes == 0.0] = 1e-4  # a flat body has this thickness
    if kind.tag == "sphere":
        return [(np.zeros((1, 3)), sizes[0], 0.0)]
    if kind.tag == "cylinder":
        return [(np.outer((-0.5, 0.5), (0.0, 0.0, sizes[1])), 0.0, sizes[0])]
    need(kind.tag == "box", f"a body is a {kind.tag}")
    return [(np.array(np.meshgrid(*zip(-sizes / 2, sizes / 2))).reshape(3, 8).T, 0.0, 0.0)]


def bodies_of(robot, root, told):
    """Yield the bodies of a robot and of what it carries, with their links."""
    hulls = {(hull["mesh"], hull["scale"]): hull["pieces"] for hull in told["hulls"]}
    need(all(hulls.values()), "a mesh has no hull")
    hulls = {mesh: [shape_of(piece) for piece in pieces] for mesh, pieces in hulls.items()}
    for link in root.findall("link"):
        name, number, shapes = link.get("name"), 0, link.findall("collision")
        if told["visual_as_collision"] and not shapes:
            shapes = link.findall("visual")
        for shape in () if name in told["bodies_left_out"] else shapes:
            T, kind = origin(attributes(shape, "origin")), shape.find("geometry/*")
            parts = [] if kind is None else parts_of(kind, hulls)
            for k, (points, *sizes) in enumerate(parts):
                own = f"{name}_{number}.{k}" if len(parts) > 1 else f"{name}_{number}"
                yield Body(own, robot.rows[name], points @ T[:3, :3].T + T[:3, 3], *sizes), name
            number += bool(parts)
    for item in told["carried"]:
        yield Body(item["name"], robot.rows[item["link"]], *shape_of(item)), item["link"]


def read_motion(data, names):
    """Return times (m,) or None, positions (m, n), velocities and accelerations or None.

    The file is NumPy's with arrays t, q, v, a and joint_names; or JSON: a JointTrajectory, or
    states; or a table with columns time, JOINT_position, JOINT_velocity, JOINT_acceleration.
    """
    first, found = data.lstrip()[:1], {}
    if data[:2] == b"PK":
        with np.load(io.BytesIO(data)) as arrays:
            found.update(arrays)
    elif first in (b"[", b"{"):
        told = json.loads(data) if first == b"{" else {"states": json.loads(data)}
        found = {"joint_names": told.get("joint_names", names)}
        if "points" in told:
            points = told["points"]
            since = [point["time_from_start"] for point in points]
            found["t"] = [time["sec"] + 1e-9 * time["nanosec"] for time in since]
            for key, kind in zip("qva", ("positions", "velocities", "accelerations")):
                if points[0].get(kind):
                    found[key] = [point[kind] for point in points]
        else:
            found["q"] = told.get("states", told.get("path"))
    else:
        ends = ("_position", "_velocity", "_acceleration")
        head, *rows = (line.split(",") for line in data.decode().splitlines() if line.strip())
        head = [x if x == "time" or x.endswith(ends) else f"{x}_position" for x in head]
        table = dict(zip(head, np.array(rows, dtype=float).T))
        found.update({"t": table.pop("time")} if "time" in table else {})
        for key, end in zip("qva", ends):
            if names[0] + end in table:
                found[key] = np.transpose([table.pop(name + end) for name in names])
        need(not table, f"columns {list(table)} are of no joint of the proof")
    given = [str(name) for name in found.get("joint_names", names)]
    need(sorted(given) == sorted(names), f"the motion moves joints {given}, the proof {names}")
    order, count = [given.index(name) for name in names], len(found["q"])
    kept = itertools.takewhile(found.__contains__, "qva" if "t" in found else "q")
    states = [array(found[key], count, len(names))[:, order] for key in kept]
    t = np.array(found.get("t", np.arange(count)), dtype=float).reshape(count)
    need(count > 1 and (np.diff(t) > 0.0).all() and abs(t).max() < 1e6, "times do not increase")
    return t if "t" in found else None, *states, *[None] * (3 - len(states))


def spline(h, q, ends):
    """Return the velocities (m, n) at the points q of a cubic spline, with pieces of lengths h.

    ends: velocities (n,) at both ends; None: the second derivative is 0 there.
    """
    need(len(q) <= 4000, "a spline has more than 4000 points")
    before, after, slopes = h[:-1], h[1:], np.diff(q, axis=0) / h[:, None]
    A = np.diag([2.0, *2.0 * (before + after), 2.0])
    A += np.diag([1.0, *before], 1) + np.diag([*after, 1.0], -1)
    inner = after[:, None] * slopes[:-1] + before[:, None] * slopes[1:]
    right = 3.0 * np.vstack([slopes[:1], inner, slopes[-1:]])
    for k, end in zip((0, -1), ends):
        if end is not None:
            A[k], right[k] = np.eye(len(q))[k], array(end, q.shape[1])
    return np.linalg.solve(A, right)


def bezier(q, v0, v1, a0=None, a1=None):
    """Return Bezier points (6, pieces, n) of the quintics through derivatives by the pieces' share.

    Args:
        q: points (pieces + 1, n) [rad or m].
        v0: first derivatives (pieces, n) at the beginning of each piece [rad or m].
        v1: at its end.
        a0: second derivatives (pieces, n) at the beginning; None: those of the cubics.
        a1: at its end.
    """
    ways = np.diff(q, axis=0)
    a0 = 6.0 * ways - 4.0 * v0 - 2.0 * v1 if a0 is None else a0
    a1 = -6.0 * ways + 2.0 * v0 + 4.0 * v1 if a1 is None else a1
    first = q[:-1], q[:-1] + v0 / 5, q[:-1] + 2 * v0 / 5 + a0 / 20
    return np.array([*first, q[1:] - 2 * v1 / 5 + a1 / 20, q[1:] - v1 / 5, q[1:]])


def curves_of(t, q, v, a, ends):
    """Return Bezier points (6, pieces, n) of a motion's curves, and lengths (pieces, 1).

    They are straight lines and, with times, the spline; or the cubics through velocities and the
    quintics through accelerations, too: controllers take one of both. Then pieces of both, from
    each point, follow each other.

    Args:
        t: times (m,) [s]; None: the motion has none.
        q: positions (m, n) [rad or m].
        v: velocities (m, n) [rad/s or m/s]; None: those of the spline.
        a: accelerations (m, n) [rad/s^2 or m/s^2]; None: no quintics.
        ends: see `spline`.
    """
    ways, h = np.diff(q, axis=0), np.ones((len(q) - 1, 1)) if t is None else np.diff(t)[:, None]
    curves = [bezier(q, ways, ways)] if v is None else []
    if t is not None:
        v = spline(h[:, 0], q, ends) if v is None else v
        curves.append(bezier(q, h * v[:-1], h * v[1:]))
    if a is not None:
        quintic = bezier(q, h * v[:-1], h * v[1:], h**2 * a[:-1], h**2 * a[1:])
        # with accelerations that differ by d at the ends, inner points differ by h^2 d / 20 and
        # the curves by at most h^2 d / 32; below a nanometre the quintic stands for both
        same = np.abs(quintic - curves[0]).max() * 20 / 32 <= 1e-9
        curves = [quintic] if same else [*curves, quintic]
    return np.stack(curves, axis=2).reshape(6, -1, q.shape[1]), np.repeat(h, len(curves), axis=0)


def halves(b):
    """Return the Bezier points of both halves of curves (k, ...)."""
    left, right = [b[0]], [b[-1]]
    while len(b) > 1:
        b = 0.5 * (b[:-1] + b[1:])
        left, right = [*left, b[0]], [b[-1], *right]
    return np.array(left), np.array(right)


def within(b, low, high):
    """Return whether curves with Bezier points b (k, m) are proven to be within [low, high]."""
    for _ in range(40):
        out = (b < low) | (b > high)
        if (out[0] | out[-1]).any() or b.shape[1] > MOST_INTERVALS:  # the ends are on the curve
            return False
        b = np.concatenate(halves(b[:, out.any(axis=0)]), axis=1)
    return not b.shape[1]


def leaves(tree, b, first, last):
    """Yield box of joint values, first obstacle, end of the obstacles, and normal of each leaf.

    Args:
        tree: an iterator of the tree in preorder.
        b: Bezier points (6, m, n) of the pieces that the tree is about [rad or m].
        first: number of the first obstacle.
        last: number after the last obstacle.
    """
    token = next(tree, None)
    need(token is not None, "a part of the motion, or an obstacle, has no plane")
    if token == "o":
        middle = (first + last) // 2
        yield from leaves(tree, b, first, middle)
        yield from leaves(tree, b, middle, last)
    elif token == "t":
        middle = b.shape[1] // 2
        for half in (b[:, :middle], b[:, middle:]) if middle else halves(b):
            yield from leaves(tree, half, first, last)
    else:
        yield (b.min(axis=(0, 1)), b.max(axis=(0, 1))), first, last, array(token, 3)


class Proof:
    """A proof with the bytes of the files that it is about; `check` refuses it or returns."""

    def __init__(self, told, urdf, motion):
        need(told.get("schema") == SCHEMA, f"its schema is {told.get('schema')!r}, not {SCHEMA!r}")
        scene = json.dumps(told["obstacles"], separators=(",", ":")).encode()
        for name, data in (("robot", urdf), ("motion", motion), ("scene", scene)):
            same = hashlib.sha256(data).hexdigest() == told["sha256"][name]
            need(same, f"the proof is of another {name}: its sha256 is another one")
        need(told["clearance"] >= 0.0, "its clearance is negative")
        self.told, root = told, ElementTree.fromstring(urdf)
        self.robot = Robot(root, told)
        found = list(bodies_of(self.robot, root, told))
        self.bodies, self.links = {x.name: x for x, _ in found}, {x.name: y for x, y in found}
        need(len(self.bodies) == len(found), "two bodies have the same name")
        t, q, v, a = read_motion(motion, self.robot.names)
        self.timed, (self.b, self.h) = t is not None, curves_of(t, q, v, a, told["ends"])
        self.obstacles = [Body(x["name"], 0, *shape_of(x)) for x in told["obstacles"]]

    def placed(self, low, high):
        """Return poses R, p in the middle of boxes of joint values (m, n), and half widths."""
        return (*self.robot.poses(0.5 * (low + high)), 0.5 * (high - low) + SLACK)

    def gap(self, first, second, n, placed, ranges):
        """Return gaps (m,) of two bodies along normals [m].

        Args:
            first: body.
            second: body; None: obstacles.
            n: normals (m, 3) from the first body to the second, of any length.
            placed: see `placed`; m boxes.
            ranges: (m, 2) first obstacle, and end of the obstacles.
        """
        (R, p, _), gap = placed, np.zeros(len(n))
        n = n / np.linalg.norm(n, axis=1)[:, None]
        if second is None:
            parts, of = np.unique(ranges, axis=0, return_inverse=True)
            for k, (a, b) in enumerate(parts):
                own = of.reshape(-1) == k
                gap[own] = -np.max([body.reach(-n[own]) for body in self.obstacles[a:b]], axis=0)
        for body, sign in ((first, 1.0), (second, -1.0))[: 1 if second is None else 2]:
            local = sign * np.einsum("mij,mi->mj", R[:, body.row], n)
            gap -= body.reach(local) + sign * (p[:, body.row] * n).sum(axis=1)
        return gap

    def way(self, first, second, placed):
        """Return how far two bodies come closer at most on intervals (m,) [m]."""
        (R, p, _), moves, way = placed, self.robot.moves, 0.0
        rows = [body.row if body else 0 for body in (first, second)]
        for body, other in ((first, rows[1]), (second, rows[0])):
            if body and (joints := moves[body.row] - moves[other]):
                box = body.box @ R[:, body.row].swapaxes(1, 2) + p[:, None, body.row]
                way = way + self.robot.ways(placed, joints, box)
        return way

    def check(self):
        """Check everything; Refused says what fails first."""
        self.check_limits()
        for region in self.told["regions"]:
            self.check_region(region)
        # every pair of bodies that move against each other has planes, or a reason for none
        pairs = [{*pair} for *pair, _ in self.told["planes"]]
        known = {frozenset(pair): reason for *pair, reason in self.told["not_compared"]}
        moves = self.robot.moves
        every = {**dict.fromkeys(["obstacles"][: len(self.obstacles)]), **self.bodies}
        for one, other in itertools.combinations(every, 2):
            first, second = (moves[x.row if x else 0] for x in (every[one], every[other]))
            if first != second and {one, other} not in pairs:
                links = frozenset(self.links.get(name, name) for name in (one, other))
                reason = known.get(frozenset((one, other))) or known.get(links)
                need(reason, f"{one} and {other} have neither planes nor a reason for none")
                adjacent = reason != "adjacent" or len(first ^ second) == 1
                need(adjacent, f"{one} and {other} are not adjacent")
        for one, other, tree in self.told["planes"]:
            self.check_planes(one, other, iter(tree))

    def check_planes(self, one, other, tree):
        """Check the planes of two bodies, or of a body and the obstacles; tree: an iterator."""
        boxes, a, b, n = map(np.array, zip(*leaves(tree, self.b, 0, len(self.obstacles))))
        need(next(tree, None) is None, f"{one} and {other} have too many planes")
        first, second, placed = (
            self.bodies[one],
            self.bodies.get(other),
            self.placed(*boxes.swapaxes(0, 1)),
        )
        need(second or other == "obstacles", f"there is no body {other}")
        needed = SLACK + (0.0 if second else self.told["clearance"])
        gap = self.gap(first, second, n, placed, np.array([a, b]).T)
        gap = gap - self.way(first, second, placed)
        k = int((gap > needed).argmin())
        what = f"{one} and {other if second else self.obstacles[a[k]].name}, plane {k}"
        need(gap[k] > needed, f"{what}: gap less way {gap[k]:.6g} m, needed {needed:.6g} m")

    def check_limits(self):
        """Check that the limits are kept; `wider` are those that are wider than the URDF's."""
        self.wider = []
        for j, name in enumerate(self.robot.names):
            joint, told, b = self.robot.known[name], self.told["limits"][name], self.b[..., j]
            words, most = attributes(joint, "limit"), {}
            for kind, sign in zip(KINDS, (-1.0, 1.0, 1.0, 1.0)):
                most[kind] = np.inf if told[kind] is None else sign * told[kind]
                stated = sign * float(words.get(kind, 0.0))
                free = joint.get("type") == "continuous" if kind in KINDS[:2] else stated == 0.0
                if not free and most[kind] > stated + SLACK:
                    self.wider.append(f"{kind} of {name}")
            ends = -most["lower"] - BEYOND_POSITION, most["upper"] + BEYOND_POSITION
            need(within(b, *ends), f"{name} exceeds its position limits")
            # b has errors of some 1e-16 of its size; each difference doubles them, times 5 and 4
            error = 4e-15 * max(1.0, np.abs(b).max())
            for order, kind in enumerate(KINDS[2:] if self.timed else ()):
                b = (5 - order) * np.diff(b, axis=0) / self.h[:, 0]
                error = 20.0 * error / self.h.min()
                limit = most[kind] * (1.0 + BEYOND_RATES[order]) - error
                need(within(b, -limit, limit), f"{name} exceeds its {kind} limit")

    def check_region(self, region):
        """Check the bounds of a region: values amid intervals, and how much they change.

        Seen from frame w, the origin of e moves by at most its way, and e turns by at most the sum
        of all turns. Its tilt changes by at most that; the entries of its rotation vector by pi / 2
        times that, where its angle stays below pi. Elsewhere their sizes do: at pi, the vector may
        jump to its negative.
        """
        robot, b = self.robot, self.b  # those of intervals that are not proven
        (e, T_e), (w, T_w) = ((robot.rows[x["link"]], origin(x)) for x in region["frames"])
        joints = robot.moves[e] ^ robot.moves[w]
        hinges = [robot.joints[j][4:6] for j in joints if not robot.joints[j][3]]
        low, high = np.array(region["bounds"], dtype=float).reshape(10, 2).T  # null becomes nan
        low, high = np.nan_to_num(low, nan=-np.inf), np.nan_to_num(high, nan=np.inf)
        name, total = f"region of {region['name']}", 0
        while b.shape[1]:
            total += b.shape[1]
            need(total <= MOST_INTERVALS, f"{name} is not proven")
            R, p, widths = placed = self.placed(b.min(axis=0), b.max(axis=0))
            at = R[:, e] @ T_e[:3, 3] + p[:, e]
            way, turned = robot.ways(placed, joints, at[:, None]), np.full(len(R), SLACK)
            turned += sum(abs(factor) * widths[:, leader] for leader, factor in hinges)
            R_w, from_w = R[:, w] @ T_w[:3, :3], at - p[:, w] - R[:, w] @ T_w[:3, 3]
            D, t = R_w.swapaxes(1, 2) @ R[:, e] @ T_e[:3, :3], np.einsum("mij,mi->mj", R_w, from_w)
            z, diagonal = D[:, :, 2], np.einsum("mii->mi", D)
            cosine = np.clip(0.5 * (diagonal.sum(axis=1) - 1.0), -1.0, 1.0)[:, None]
            shares = (diagonal - cosine) / np.maximum(1.0 - cosine, 1e-15)  # of axis, squared
            sizes = np.arccos(cosine) * np.sqrt(np.clip(shares, 0.0, 1.0))
            vector = np.sign((D - D.swapaxes(1, 2))[:, (2, 0, 1), (1, 2, 0)]) * sizes
            sure = np.arccos(cosine) + turned[:, None] < 3.1
            distance, radius = np.linalg.norm(t, axis=1), np.hypot(t[:, 0], t[:, 1])
            bearing = np.arctan2(np.linalg.norm(np.cross(t, z), axis=1), -(t * z).sum(axis=1))
            rest = np.arctan2(np.hypot(z[:, 0], z[:, 1]), z[:, 2]), distance, radius, bearing
            # rounding errors of the two roots are below 1e-7
            least, most = (
                np.column_stack([t, np.where(sure, vector, sign * sizes) + sign * 1e-7, *rest])
                for sign in (-1.0, 1.0)
            )
            seen = turned + np.pi * way / np.maximum(distance, 1e-9)  # from e, where w is
            change = np.column_stack(
                [way, way, way, *[np.pi / 2 * turned] * 3, turned, way, way, seen]
            )
            beyond = np.maximum(low - least, most - high)
            need(((beyond - change) < BEYOND_REGION).all(), f"{name} is left")
            beyond = (beyond + change).max(axis=1)
            b = np.concatenate(halves(b[:, ~(beyond < BEYOND_REGION - SLACK)]), axis=1)


def check_meshes(hulls, urdf):
    """Return how many files of meshes, relative to folders above the URDF, have their digests."""
    there = 0
    for hull in hulls:
        name = hull["mesh"].rpartition("://")[2]
        files = [folder / name for folder in urdf.resolve().parents if (folder / name).is_file()]
        for file in files[:1]:
            same = hashlib.sha256(file.read_bytes()).hexdigest() == hull["sha256"]
            need(same, f"the proof is of another mesh {file}: its sha256 is another one")
            there += 1
    return there


def main():
    """Check the proof that the command line names; return 0 (yes) or 1 (no)."""
    parser = argparse.ArgumentParser(description="Check a proof of a robot's motion.")
    parser.add_argument("proof", type=Path)
    parser.add_argument("--urdf", type=Path, required=True)
    parser.add_argument("--motion", type=Path, required=True)
    args = parser.parse_args()
    try:
        told = json.loads(args.proof.read_bytes(), parse_constant=int)
        proof = Proof(told, args.urdf.read_bytes(), args.motion.read_bytes())
        there = check_meshes(told["hulls"], args.urdf)
        proof.check()
    except Exception as error:  # whatever is wrong in a file, it is no proof
        print(f"no: {error}" if isinstance(error, Refused) else f"no: cannot be read: {error!r}")
        return 1
    print(f"yes: {told['motion']} of {told['robot']}, {told['clearance']} m away from obstacles")
    print(f"obstacles: {', '.join(x.name for x in proof.obstacles) or 'none'}")
    print(f"hulls of {len(told['hulls'])} meshes are the proof's; {there} files have its digests")
    print(f"limits wider than the URDF's: {', '.join(proof.wider) or 'none'}")
    for pair in told["not_compared"]:
        print("not compared: {} and {} ({})".format(*pair))
    for key in ("held", "base", "limits", "regions", "bodies_left_out"):
        print(f"{key.replace('_', ' ')}: {json.dumps(told[key])}")
    print(f"not proven: {', '.join(told['not_proven'])}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
