"""Check a proof of a robot's motion, without the program that wrote it.

    python cvqmpt_check.py proof.json --urdf robot.urdf --motion motion.json

It says yes if the proof, the URDF and the file of the motion alone show, for every moment: compared
bodies do not touch, obstacles are farther away than the clearance, positions, velocities and
accelerations are within the limits, and the regions of the constraint are kept. Else it says no,
with the first inequality that fails. It also prints what is not compared and not proven. It needs
Python 3.9 or later, numpy, and no other file. docs/proof.md describes the format.

Rounding. Numbers are at most 1000 and links at most 500, which is checked. A pose is a product of
at most 1000 matrices, each with errors of about 1e-16 times its numbers: points are off by less
than 1e-9 m. Every inequality of lengths or angles has SLACK = 2e-9 to spare, and boxes of joint
values are widened by it. Bezier points are halved by mean values, which do not enlarge errors.
Errors of derivatives, differences divided by times, are added where they are computed.
"""

import argparse
import base64
import csv
import hashlib
import json
import math
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


def pose(values):
    """Return a pose (4, 4); None: the identity."""
    T = np.eye(4) if values is None else array(values, 4, 4)
    rotation = np.abs(T[:3, :3] @ T[:3, :3].T - np.eye(3)).max() < 1e-12
    need(rotation and np.linalg.det(T) > 0.0 and (T[3] == (0, 0, 0, 1)).all(), "a pose is none")
    return T


def turn(axis, angles):
    """Return the rotations (..., 3, 3) about a unit axis by angles (...)."""
    K = np.cross(np.eye(3), axis)  # K x is the cross product of axis and x
    sine, cosine = np.sin(angles)[..., None, None], np.cos(angles)[..., None, None]
    return np.eye(3) + sine * K + (1.0 - cosine) * (K @ K)


def origin(element):
    """Return the pose (4, 4) of the <origin> of an element of a URDF."""
    found, T = element.find("origin"), np.eye(4)
    if found is not None:
        angles = array(found.get("rpy", "0 0 0").split(), 3)
        x, y, z = (turn(axis, angle) for axis, angle in zip(np.eye(3), angles))
        T[:3, :3], T[:3, 3] = z @ y @ x, array(found.get("xyz", "0 0 0").split(), 3)
    return T


class Robot:
    """The links of a URDF. Row 0 of all poses is the world, the others are the links."""

    def __init__(self, root, told):
        self.names, self.held, self.base = list(told["joints"]), told["held"], pose(told["base"])
        self.known = {joint.get("name"): joint for joint in root.findall("joint")}
        self.above = {joint.find("child").get("link"): joint for joint in self.known.values()}
        for name in (*self.names, *self.held):
            need(name in self.known, f"the proof is of another robot: no joint {name} in the URDF")
        # of each row: row above, pose in it, unit axis, kind, planned joint, factor, offset
        self.joints = [(0, self.base, np.zeros(3), "fixed", 0, 0.0, 0.0)]
        self.moves, self.rows = [frozenset()], {"": 0}  # joints (rows) that move each row
        links = [link.get("name") for link in root.findall("link")]
        need(len(links) <= 500, "it has more than 500 links")
        for link in links:
            self.row(link)

    def row(self, link):
        """Return the row of a link; add it, after those above it."""
        if link not in self.rows:
            joint, entry = self.above.get(link), self.joints[0]
            if joint is not None:
                row, kind = self.row(joint.find("parent").get("link")), joint.get("type")
                fixed, found = kind in ("fixed", "floating", "planar"), joint.find("axis")
                need(fixed or kind in ("revolute", "continuous", "prismatic"), f"a {kind} joint")
                leader = (0, 0.0, 0.0) if fixed else self.leader(joint.get("name"))
                axis = array(("1 0 0" if found is None else found.get("xyz")).split(), 3)
                axis = axis / max(np.linalg.norm(axis), 1e-6)
                entry = (row, origin(joint), axis, kind, *leader)
            self.rows[link] = len(self.joints)
            self.moves.append(self.moves[entry[0]] | ({len(self.joints)} if entry[5] else set()))
            self.joints.append(entry)
        return self.rows[link]

    def leader(self, name):
        """Return planned joint, factor and offset: value = factor * planned value + offset."""
        if name in self.held:
            return 0, 0.0, float(array(self.held[name], 1)[0])
        if name in self.names:
            return self.names.index(name), 1.0, 0.0
        mimic = self.known[name].find("mimic")
        need(mimic is not None, f"joint {name} is neither planned nor held")
        leader, factor, offset = self.leader(mimic.get("joint"))
        by, plus = array([mimic.get("multiplier", 1.0), mimic.get("offset", 0.0)], 2).tolist()
        return leader, by * factor, by * offset + plus

    def poses(self, q):
        """Return rotations (m, rows, 3, 3) and origins (m, rows, 3) at configurations q (m, n)."""
        R = np.tile(np.eye(3), (len(q), len(self.joints), 1, 1))
        p = np.zeros(R.shape[:3])
        for k, (row, T, axis, kind, leader, factor, offset) in enumerate(self.joints[1:], 1):
            value = factor * q[:, leader] + offset
            R[:, k], p[:, k] = R[:, row] @ T[:3, :3], p[:, row] + R[:, row] @ T[:3, 3]
            if kind == "prismatic":
                p[:, k] += (R[:, k] @ axis) * value[:, None]
            elif kind in ("revolute", "continuous"):
                R[:, k] = R[:, k] @ turn(axis, value)
        return R, p

    def ways(self, placed, joints, points):
        """Bound how far points (m, k, 3) move while joints change by at most their half widths.

        Let the joints of the chain change one after the other, beginning at the frame from which
        the motion is seen. When joint j changes, those after it have not changed yet, and those
        before it have moved its axis together with the points. So the points turn by the change of
        j at the distance from the axis that they have in the poses R, p; sliders move them by it.
        """
        (R, p, widths, _), total = placed, np.full(len(points), SLACK)
        for j in joints:
            _, _, axis, kind, leader, factor, _ = self.joints[j]
            lever = 1.0
            if kind != "prismatic":
                arms = points - p[:, None, j]
                squares, along = (arms**2).sum(axis=2), arms @ (R[:, j] @ axis)[:, :, None]
                # 1e-14 is more than the difference loses
                lever = np.sqrt((squares * (1.0 + 1e-14) - along[..., 0] ** 2).max(axis=1))
            total += lever * abs(factor) * widths[:, leader]
        return total


class Body:
    """The hull of points with balls of a radius around them, in the frame of a row of poses.

    disc: radius of discs around its two points, across the line between them (a cylinder).
    """

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


def bodies_of(robot, root, told):
    """Yield the bodies of a robot and of what it carries, with their links."""
    hulls = {(hull["mesh"], tuple(hull["scale"])): hull for hull in told["hulls"]}
    for link in root.findall("link"):
        name, number, shapes = link.get("name"), 0, link.findall("collision")
        if told["visual_as_collision"] and not shapes:
            shapes = link.findall("visual")
        for T, kind in ((origin(shape), shape.find("geometry/*")) for shape in shapes):
            words = [] if kind is None else map(kind.get, ("size", "radius", "length"))
            sizes = array(" ".join(filter(None, words)).split(), -1)
            placeholder = kind is None or (kind.tag != "mesh" and not sizes.any())
            if placeholder or name in told["bodies_left_out"]:
                continue
            sizes = np.where(sizes == 0.0, 1e-4, sizes)  # a flat body has this thickness
            own, number = f"{name}_{number}", number + 1
            if kind.tag == "box":
                corners = np.array(np.meshgrid(*zip(-sizes / 2, sizes / 2)))
                parts = [(corners.reshape(3, 8).T, 0.0, 0.0)]
            elif kind.tag == "sphere":
                parts = [(np.zeros((1, 3)), sizes[0], 0.0)]
            elif kind.tag == "cylinder":
                parts = [(np.outer((-0.5, 0.5), (0.0, 0.0, sizes[1])), 0.0, sizes[0])]
            else:
                scale = tuple(array(kind.get("scale", "1 1 1").split(), 3).tolist())
                hull = hulls.get((kind.get("filename"), scale))
                need(hull, f"the proof has no hull of {kind.tag} {kind.get('filename')}")
                parts = [(points_of(part), part["radius"], 0.0) for part in hull["pieces"]]
            for k, (points, *sizes) in enumerate(parts):
                part = f"{own}.{k}" if len(parts) > 1 else own
                yield Body(part, robot.rows[name], points @ T[:3, :3].T + T[:3, 3], *sizes), name
    for item in told["carried"]:
        yield body_of(item, robot.rows[item["link"]]), item["link"]


def body_of(item, row):
    """Return an obstacle or a load of the proof."""
    return Body(item["name"], row, array(item["points"], -1, 3), item["radius"], item["disc"])


def points_of(hull):
    """Return corners (k, 3) of a hull [m]: base64 of whole numbers of 16 bits, times `unit`."""
    raw = np.frombuffer(base64.b64decode(hull["corners"]), dtype="<i2")
    return array(raw * float(hull["unit"]), -1, 3)


def read_motion(data, names):
    """Return times (m,) or None, positions (m, n), velocities and accelerations or None."""
    text, order, t = data.decode("utf-8-sig"), range(len(names)), None
    kinds = ("positions", "velocities", "accelerations")
    if text.lstrip()[:1] in ("{", "["):
        found = json.loads(text)
        found = {"states": found} if isinstance(found, list) else found
        order = [found.get("joint_names", names).index(name) for name in names]
        rows = {"positions": found.get("states", found.get("path"))}
        if "points" in found:
            since = [point["time_from_start"] for point in found["points"]]
            t = np.array([x["sec"] + 1e-9 * x["nanosec"] for x in since])
            rows = {kind: [point.get(kind) for point in found["points"]] for kind in kinds}
        columns = [rows[kind] if rows.get(kind, [None])[0] else None for kind in kinds]
    else:
        head, *rows = csv.reader(text.splitlines())
        table = dict(zip(head, np.array(rows, dtype=float).T))
        t, ends = table.get("time"), ("_position", "_velocity", "_acceleration")
        ends = ends if names[0] + ends[0] in table else ("", *ends[1:])
        given = [[table.get(name + end) for name in names] for end in ends]
        columns = [None if column[0] is None else np.array(column).T for column in given]
    states = [None if x is None else array(x, -1, len(names))[:, order] for x in columns]
    need(t is None or ((np.diff(t) > 0.0).all() and t[-1] < 1e6), "times do not increase")
    return (t, *states)


def curves_of(t, q, v, a, ends):
    """Return the curves of a motion by name, Bezier points (6, pieces, n); lengths (pieces, 1)."""
    h = np.ones((len(q) - 1, 1)) if t is None else np.diff(t)[:, None]
    slopes = np.diff(q, axis=0) / h

    def cubic(v0, v1):
        c = q[:-1], q[:-1] + h * v0 / 3, q[1:] - h * v1 / 3, q[1:]
        first = c[0], 0.4 * c[0] + 0.6 * c[1], 0.1 * c[0] + 0.6 * c[1] + 0.3 * c[2]
        last = 0.3 * c[1] + 0.6 * c[2] + 0.1 * c[3], 0.6 * c[2] + 0.4 * c[3], c[3]
        return np.array([*first, *last])

    curves = {"linear": cubic(slopes, slopes)}
    if v is None and t is not None:  # the spline; an end without a velocity has no acceleration
        need(len(q) <= 3000, "more than 3000 points without velocities")
        given, d = [float(end is not None) for end in ends], h[:, 0]
        A = np.diag([2.0 - given[0], *(2.0 * (d[:-1] + d[1:])), 2.0 - given[1]])
        A += np.diag([1.0 - given[0], *d[:-1]], 1) + np.diag([*d[1:], 1.0 - given[1]], -1)
        first, last = (3.0 * s if end is None else end for end, s in zip(ends, slopes[[0, -1]]))
        inner = 3.0 * (h[1:] * slopes[:-1] + h[:-1] * slopes[1:])
        w = np.linalg.solve(A, np.vstack([first, inner, last]))
        curves["spline"] = cubic(w[:-1], w[1:])
    elif v is not None:
        curves = {"cubic": cubic(v[:-1], v[1:])}
    if a is not None:
        first = q[:-1] + h * v[:-1] / 5, q[:-1] + 2 * h * v[:-1] / 5 + h**2 * a[:-1] / 20
        last = q[1:] - 2 * h * v[1:] / 5 + h**2 * a[1:] / 20, q[1:] - h * v[1:] / 5
        curves["quintic"] = np.array([q[:-1], *first, *last, q[1:]])
        # with accelerations that differ by d at the ends, inner points differ by h^2 d / 20 and
        # the curves by at most h^2 d / 32; above a nanometre both are checked
        if np.abs(curves["quintic"] - curves["cubic"])[2:4].max() * 20 / 32 <= 1e-9:
            del curves["cubic"]
    return curves, h


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


def leaves(tree, pieces, obstacles):
    """Yield interval, first obstacle, end of the obstacles, and normal of each leaf of a tree.

    An interval is (lo, hi, halved, number): the pieces lo to hi of the motion, or, if it is halved,
    part `number` of 2^halved equal parts of one piece.
    """
    left = [((0, pieces, 0, 0), 0, obstacles)]
    for token in tree:
        key, a, b = left.pop()
        lo, hi, halved, number = key
        cut, middle = (lo + hi) // 2, (a + b) // 2
        if token == "o":
            left += [(key, middle, b), (key, a, middle)]
        elif token == "t" and hi - lo > 1:
            left += [((cut, hi, 0, 0), a, b), ((lo, cut, 0, 0), a, b)]
        elif token == "t":
            left += [((lo, hi, halved + 1, 2 * number + k), a, b) for k in (1, 0)]
        else:
            yield key, a, b, array(token, 3)
    need(not left, "a part of the motion, or an obstacle, has no plane")


class Proof:
    """A proof with the bytes of the files that it is about; `check` refuses it or returns."""

    def __init__(self, told, urdf, motion):
        need(told.get("schema") == SCHEMA, f"its schema is {told.get('schema')!r}, not {SCHEMA!r}")
        scene = json.dumps(told["obstacles"], separators=(",", ":")).encode()
        for name, data in (("robot", urdf), ("motion", motion), ("scene", scene)):
            same = hashlib.sha256(data).hexdigest() == told["sha256"][name]
            need(same, f"the proof is of another {name}: its sha256 is another one")
        self.told, self.kept, root = told, {}, ElementTree.fromstring(urdf)
        self.robot = Robot(root, told)
        found = list(bodies_of(self.robot, root, told))
        self.bodies, self.links = {x.name: x for x, _ in found}, {x.name: y for x, y in found}
        need(len(self.bodies) == len(found), "two bodies have the same name")
        t, q, v, a = read_motion(motion, self.robot.names)
        self.curves, self.h = curves_of(t, q, v, a, told["ends"])
        self.timed, self.t = t is not None, np.arange(len(q) * 1.0) if t is None else t
        self.obstacles = [body_of(item, 0) for item in told["obstacles"]]

    def points(self, curves, key):
        """Return Bezier points (6, m, n) of curves on an interval."""
        lo, hi, halved, number = key
        if not halved:
            return np.concatenate([self.curves[name][:, lo:hi] for name in curves], axis=1)
        if (curves, key) not in self.kept:
            above = self.points(curves, (lo, hi, halved - 1, number // 2))
            self.kept[curves, key] = halves(above)[number % 2]
        return self.kept[curves, key]

    def placed(self, b):
        """Return poses R, p in the middle q of boxes around b (k, m, n), half widths, and q."""
        low, high = b.min(axis=0), b.max(axis=0)
        q = 0.5 * (low + high)
        return (*self.robot.poses(q), 0.5 * (high - low) + SLACK, q)

    def placed_on(self, curves, keys):
        """Return the same for intervals."""
        found = (self.points(curves, key).reshape(-1, len(self.robot.names)) for key in keys)
        return self.placed(np.array([(b.min(axis=0), b.max(axis=0)) for b in found]).swapaxes(0, 1))

    def gaps(self, first, second, n, placed, ranges):
        """Return gaps (m,) between two bodies along n (m, 3), less their ways together [m].

        second: None stands for the obstacles in `ranges` (m, 2).
        """
        (R, p, *_), moves = placed, self.robot.moves
        n = n / np.linalg.norm(n, axis=1)[:, None]
        if second is None:
            gap, (parts, of) = np.empty(len(n)), np.unique(ranges, axis=0, return_inverse=True)
            for k, (a, b) in enumerate(parts):
                own = of.reshape(-1) == k
                gap[own] = -np.max([body.reach(-n[own]) for body in self.obstacles[a:b]], axis=0)
            sides = [(first, 0, 1.0)]
        else:
            gap, sides = 0.0, [(first, second.row, 1.0), (second, first.row, -1.0)]
        for body, other, sign in sides:
            R_body, p_body = R[:, body.row], p[:, body.row]
            local = sign * np.einsum("mij,mi->mj", R_body, n)
            gap = gap - body.reach(local) - sign * (p_body * n).sum(axis=1)
            if joints := sorted(moves[body.row] - moves[other]):
                box = body.box @ R_body.swapaxes(1, 2) + p_body[:, None]
                gap = gap - self.robot.ways(placed, joints, box)
        return gap

    def check_planes(self, curves, pairs):
        """Check trees of planes by pair: two bodies, or a body and "" for all obstacles."""
        found = [
            (pair, *zip(*leaves(tree, len(self.h), len(self.obstacles)))) for pair, tree in pairs
        ]
        number = {key: k for k, key in enumerate({key for _, keys, *_ in found for key in keys})}
        placed = self.placed_on(curves, number) if number else ()
        for (first, second), keys, a, b, n in found:
            needed = SLACK + (0.0 if second else self.told["clearance"])
            at = [x[[number[key] for key in keys]] for x in placed]
            other = self.bodies[second] if second else None
            gap = self.gaps(self.bodies[first], other, np.array(n), at, np.array([a, b]).T)
            k = int((gap > needed).argmin())
            when = f"{self.t[keys[k][0]]:.6g} to {self.t[keys[k][1]]:.6g}"
            what = f"{first} and {second or self.obstacles[a[k]].name} from {when}"
            need(gap[k] > needed, f"{what}: gap less ways {gap[k]:.6g} m, needed {needed:.6g} m")

    def check_distances(self, curves, part):
        """Check that every pair is apart on these curves, or left out with a reason."""
        pairs = {frozenset(pair): (pair, tree) for *pair, tree in part["pairs"]}
        known = {frozenset(pair): reason for *pair, reason in self.told["not_compared"]}
        moves, names = self.robot.moves, list(self.bodies)
        for k, name in enumerate(names):
            for other in [*names[k + 1 :], *([""] if self.obstacles else [])]:
                row = self.bodies[other].row if other else 0
                pair, between = frozenset((name, other)), moves[self.bodies[name].row] ^ moves[row]
                if between and pair not in pairs:
                    links = frozenset((self.links[name], self.links.get(other, "")))
                    reason = known.get(pair) or known.get(links)
                    need(reason, f"{name} and {other or 'obstacles'}: no plane and no reason why")
                    adjacent = reason != "adjacent" or len(between) == 1
                    need(adjacent, f"{name} and {other} are not adjacent")
        self.check_planes(curves, pairs.values())

    def check_limits(self):
        """Check that limits are those of the URDF, or said to be others, and are kept."""
        own = {tuple(x) for x in self.told["limits_not_in_urdf"]}
        for j, name in enumerate(self.robot.names):
            joint, told = self.robot.known[name], self.told["limits"][name]
            words = {} if joint.find("limit") is None else joint.find("limit").attrib
            signs = dict(zip(KINDS, (-1.0, 1.0, 1.0, 1.0)))
            most = {k: signs[k] * math.inf if told[k] is None else told[k] for k in KINDS}
            for kind in KINDS[:3]:
                stated, sign = float(words.get(kind, 0.0)), signs[kind]
                free = stated == 0.0 if kind == "velocity" else joint.get("type") == "continuous"
                kept = free or sign * most[kind] <= sign * stated + SLACK or (name, kind) in own
                need(
                    kept, f"{kind} limit {told[kind]} of {name} is wider than {stated} in the URDF"
                )
            for curve, b in ((curve, points[:, :, j]) for curve, points in self.curves.items()):
                low, high = most["lower"] - BEYOND_POSITION, most["upper"] + BEYOND_POSITION
                need(within(b, low, high), f"{name} exceeds its position limits ({curve})")
                # b has errors of some 1e-16 of its size; each difference doubles them, times 5, 4
                error = 1e-15 * max(1.0, np.abs(b).max())
                for order in range(self.timed * (1 if curve == "linear" else 2)):
                    b, error = (
                        (5 - order) * np.diff(b, axis=0) / self.h.T,
                        20 * error / self.h.min(),
                    )
                    limit = most[KINDS[2 + order]] * (1.0 + BEYOND_RATES[order]) - error
                    what = f"{name} exceeds its {KINDS[2 + order]} limit ({curve})"
                    need(within(b, -limit, limit), what)

    def check_region(self, region, curve):
        """Check the bounds of a region: values in the middle of intervals, and how they change.

        In the frame w, the origin of e moves by at most its way, and e turns by at most the sum of
        all turns. Tilts change by at most the turn, entries of rotation vectors by pi / 2 times it.
        Where angle pi may be passed, these jump to their negatives: both signs are checked.
        """
        robot, b, total = self.robot, self.curves[curve], 0
        (e, T_e), (w, T_w) = ((robot.rows[x["link"]], pose(x["pose"])) for x in region["frames"])
        joints = sorted(robot.moves[e] ^ robot.moves[w])
        hinges = [robot.joints[j][4:6] for j in joints if robot.joints[j][3] != "prismatic"]
        ends = [[math.inf if x is None else x for x in row] for row in zip(*region["bounds"])]
        low, high = np.array(ends).reshape(2, 9)
        low = np.where(low == math.inf, -math.inf, low)
        while b.shape[1]:
            total += b.shape[1]
            what = f"region of {region['name']} is not proven on the {curve} curve"
            need(total <= MOST_INTERVALS, what)
            R, p, widths, _ = placed = self.placed(b)
            at = R[:, e] @ T_e[:3, 3] + p[:, e]
            way, turned = robot.ways(placed, joints, at[:, None]), np.full(len(R), SLACK)
            for leader, factor in hinges:
                turned += abs(factor) * widths[:, leader]
            R_w = R[:, w] @ T_w[:3, :3]
            D, from_w = (
                R_w.swapaxes(1, 2) @ R[:, e] @ T_e[:3, :3],
                at - p[:, w] - R[:, w] @ T_w[:3, 3],
            )
            t = np.einsum("mij,mi->mj", R_w, from_w)
            v = 0.5 * np.stack([D[:, i, j] - D[:, j, i] for i, j in ((2, 1), (0, 2), (1, 0))], 1)
            sine, cosine = np.linalg.norm(v, axis=1), 0.5 * (np.einsum("mii->m", D) - 1.0)
            angle = np.arctan2(sine, cosine)[:, None]
            turns = v * angle / np.maximum(sine, 1e-12)[:, None]
            tilt = np.arctan2(np.hypot(D[:, 0, 2], D[:, 1, 2]), D[:, 2, 2])
            lengths = np.linalg.norm(t, axis=1), np.hypot(t[:, 0], t[:, 1])
            near = angle + turned[:, None] > 3.1  # sizes of entries, from 1 - cosine: to 1e-7
            shares = (np.einsum("mii->mi", D) - cosine[:, None]) / np.maximum(1.0 - cosine, 1e-9)[
                :, None
            ]
            sizes = angle * np.sqrt(np.maximum(shares, 0.0)) + 1e-7
            least, most = (
                np.column_stack([t, np.where(near, sign * sizes, turns), tilt, *lengths])
                for sign in (-1.0, 1.0)
            )
            change = np.column_stack([*[way] * 3, *[0.5 * math.pi * turned] * 3, turned, way, way])
            beyond = (np.maximum(low - least, most - high) + change).max(axis=1)
            b = np.concatenate(halves(b[:, ~(beyond < BEYOND_REGION - SLACK)]), axis=1)

    def check(self):
        """Check everything that is proven; Refused says what fails first."""
        self.check_limits()
        for part in self.told["parts"]:
            self.check_distances(tuple(part["curves"]), part)
        seen = {name for part in self.told["parts"] for name in part["curves"]}
        need(
            seen == set(self.curves),
            f"it is about curves {seen}; the motion has {set(self.curves)}",
        )
        for region in self.told["regions"]:
            for curve in self.curves:
                self.check_region(region, curve)


def check_meshes(told, urdf):
    """Compare the mesh files near the URDF with their digests; return how many are there."""
    count = 0
    for hull in told["hulls"]:
        scheme, _, name = hull["mesh"].rpartition("://")
        folders = urdf.resolve().parents if scheme == "package" else [urdf.parent]
        for file in [folder / name for folder in folders if (folder / name).is_file()][:1]:
            same = hashlib.sha256(file.read_bytes()).hexdigest() == hull["sha256"]
            need(same, f"the proof is of another mesh {file}: its sha256 is another one")
            count += 1
    return count


def main():
    """Check the proof that the command line names; return 0 (yes), 1 (no) or 2 (not readable)."""
    parser = argparse.ArgumentParser(description="Check a proof of a robot's motion.")
    parser.add_argument("proof", type=Path)
    parser.add_argument("--urdf", type=Path, required=True)
    parser.add_argument("--motion", type=Path, required=True)
    args = parser.parse_args()
    try:
        text, urdf, motion = (x.read_bytes() for x in (args.proof, args.urdf, args.motion))
        told = json.loads(text)
        proof, meshes = Proof(told, urdf, motion), check_meshes(told, args.urdf)
        proof.check()
    except OSError as error:
        print(error, file=sys.stderr)
        return 2
    except Refused as refused:
        print(f"no: {refused}")
        return 1
    except Exception as error:  # whatever else is wrong in a file is no proof
        print(f"no: the proof or a file is malformed: {type(error).__name__}: {error}")
        return 1
    print(f"yes: {told['motion']} of {told['robot']}, {len(proof.bodies)} bodies, obstacles:")
    print(f"  {', '.join(x.name for x in proof.obstacles) or 'none'}; {told['clearance']} m away")
    print(f"hulls of {len(told['hulls'])} meshes are the proof's; {meshes} files have its digests")
    for pair in told["not_compared"]:
        print("not compared: {} and {} ({})".format(*pair))
    for key in ("bodies_left_out", "held", "base", "limits_not_in_urdf", "not_proven"):
        print(f"{key.replace('_', ' ')}: {json.dumps(told[key])}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
