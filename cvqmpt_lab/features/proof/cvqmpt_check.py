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
        lost = [name for name in (*self.names, *self.held) if name not in self.known]
        need(not lost, f"the proof is of another robot: the URDF has no joints {lost}")
        twice = [name for name in self.names if self.names.count(name) > 1 or name in self.held]
        need(not twice, f"joints {twice} are planned twice, or planned and held")
        # of each row: row above, pose in it, unit axis, kind, planned joint, factor, offset
        self.joints = [(0, origin(told["base"]), np.zeros(3), "fixed", 0, 0.0, 0.0)]
        self.moves: list[frozenset] = [frozenset()]  # joints (their rows) that move each row
        self.rows = {"": 0}
        above = {joint.find("child").get("link"): joint for joint in self.known.values()}
        links = [link.get("name") for link in root.findall("link")]
        need(len(links) <= 500, "the URDF has more than 500 links")
        for link in links:
            joint, entry = above.get(link), self.joints[0]
            parent = "" if joint is None else joint.find("parent").get("link")
            if parent not in self.rows:
                links.append(link)  # later
                continue
            if joint is not None:
                kind, name = joint.get("type"), joint.get("name")
                still = kind in ("fixed", "floating", "planar")
                need(still or kind in ("revolute", "continuous", "prismatic"), f"{name} is {kind}")
                axis = array(attributes(joint, "axis").get("xyz", "1 0 0").split(), 3)
                axis = axis / max(np.linalg.norm(axis), 1e-9)
                leader = (0, 0.0, 0.0) if still else self.leader(name)
                entry = self.rows[parent], origin(attributes(joint, "origin")), axis, kind, *leader
            self.moves.append(self.moves[entry[0]].union([len(self.joints)] if entry[5] else []))
            self.rows[link] = len(self.joints)
            self.joints.append(entry)

    def leader(self, name):
        """Return planned joint, factor and offset: value = factor * planned value + offset."""
        if name in self.held or name in self.names:
            held = name in self.held
            return (0, 0.0, self.held[name]) if held else (self.names.index(name), 1.0, 0.0)
        mimic = attributes(self.known[name], "mimic")
        need(mimic, f"joint {name} is neither planned nor held")
        leader, factor, offset = self.leader(mimic["joint"])
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


def bodies_of(robot, root, told):
    """Yield the bodies of a robot and of what it carries, with their links."""
    hulls = {(hull["mesh"], tuple(hull["scale"])): hull for hull in told["hulls"]}
    for link in root.findall("link"):
        name, number, shapes = link.get("name"), 0, link.findall("collision")
        if told["visual_as_collision"] and not shapes:
            shapes = link.findall("visual")
        for T, kind in (
            (origin(attributes(shape, "origin")), shape.find("geometry/*")) for shape in shapes
        ):
            words = [] if kind is None else map(kind.get, ("size", "radius", "length"))
            sizes = array(" ".join(filter(None, words)).split(), -1)
            if kind is None or not (kind.tag == "mesh" or sizes.any()):
                continue  # a placeholder
            if name in told["bodies_left_out"]:
                continue
            sizes[sizes == 0.0] = 1e-4  # a flat body has this thickness
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
                hull = hulls[kind.get("filename"), scale]
                parts = [shape_of(part) for part in hull["pieces"]]
            for k, (points, *sizes) in enumerate(parts):
                part = f"{own}.{k}" if len(parts) > 1 else own
                yield Body(part, robot.rows[name], points @ T[:3, :3].T + T[:3, 3], *sizes), name
    for item in told["carried"]:
        yield Body(item["name"], robot.rows[item["link"]], *shape_of(item)), item["link"]


def read_motion(data, names):
    """Return times (m,) or None, positions (m, n), velocities and accelerations or None."""
    found, t = json.loads(data), None
    found = {"states": found} if isinstance(found, list) else found
    columns = [found.get("states", found.get("path")), None, None]
    if "points" in found:
        since = [point["time_from_start"] for point in found["points"]]
        t = np.array([x["sec"] + 1e-9 * x["nanosec"] for x in since])
        need((np.diff(t) > 0.0).all() and t[-1] < 1e6, "times do not increase")
        kinds = ("positions", "velocities", "accelerations")
        columns = [[point.get(kind) for point in found["points"]] for kind in kinds]
        need(found["points"][0].get("velocities"), "many curves go through points with times alone")
    given = found.get("joint_names", names)
    need(sorted(given) == sorted(names), f"the motion moves joints {given}, the proof {names}")
    order = [given.index(name) for name in names]
    return t, *(array(x, -1, len(names))[:, order] if x and x[0] else None for x in columns)


def curves_of(t, q, v, a):
    """Return Bezier points (6, pieces, n) of a motion's curves, and lengths (pieces,).

    They are straight lines, or cubics through velocities, or quintics through accelerations, too:
    controllers take one of them. Then the cubic and the quintic from each point follow each other.
    """
    h = np.ones((len(q) - 1, 1)) if t is None else np.diff(t)[:, None]
    v0, v1 = (np.diff(q, axis=0), np.diff(q, axis=0)) if v is None else (h * v[:-1], h * v[1:])
    ends = np.array([q[:-1], v0, q[1:], v1])
    rows = [5, 0, 0, 0], [5, 1, 0, 0], [3.5, 1, 1.5, -0.5], [1.5, 0.5, 3.5, -1], [0, 0, 5, -1]
    curves = [np.einsum("ij,jkn->ikn", np.array([*rows, [0, 0, 5, 0]]) / 5, ends)]
    if a is not None:
        first = q[:-1] + v0 / 5, q[:-1] + 2 * v0 / 5 + h**2 * a[:-1] / 20
        last = q[1:] - 2 * v1 / 5 + h**2 * a[1:] / 20, q[1:] - v1 / 5
        quintic = np.array([q[:-1], *first, *last, q[1:]])
        # with accelerations that differ by d at the ends, inner points differ by h^2 d / 20 and
        # the curves by at most h^2 d / 32; below a nanometre the quintic stands for both
        same = np.abs(quintic - curves[0]).max() * 20 / 32 <= 1e-9
        curves = [quintic] if same else [*curves, quintic]
    b = np.stack(curves, axis=2)
    return b.reshape(6, -1, q.shape[1]), np.repeat(h, len(curves))


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

    An interval is pieces lo to hi of the motion, or part `number` of 2^halved parts of piece lo.
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
        need(told["clearance"] >= 0.0, "its clearance is negative")
        self.told, self.kept, root = told, {}, ElementTree.fromstring(urdf)
        self.robot = Robot(root, told)
        found = list(bodies_of(self.robot, root, told))
        self.bodies, self.links = {x.name: x for x, _ in found}, {x.name: y for x, y in found}
        need(len(self.bodies) == len(found), "two bodies have the same name")
        t, *states = read_motion(motion, self.robot.names)
        (self.b, h), self.timed = curves_of(t, *states), t is not None
        self.h = h  # lengths of the pieces [s]
        self.obstacles = [Body(x["name"], 0, *shape_of(x)) for x in told["obstacles"]]

    def points(self, key):
        """Return the Bezier points (6, m, n) on an interval."""
        lo, hi, halved, number = key
        if halved and key not in self.kept:
            self.kept[key] = halves(self.points((lo, hi, halved - 1, number // 2)))[number % 2]
        return self.kept[key] if halved else self.b[:, lo:hi]

    def placed(self, keys):
        """Return what `placed_in` does for intervals."""
        found = [self.points(key) for key in keys]
        low, high = (np.array([f(b, axis=(0, 1)) for b in found]) for f in (np.min, np.max))
        return self.placed_in(low, high)

    def placed_in(self, low, high):
        """Return poses R, p in the middle q of boxes [low, high] (m, n), their half widths, q."""
        q = 0.5 * (low + high)
        return (*self.robot.poses(q), 0.5 * (high - low) + SLACK, q)

    def gap(self, first, second, n, placed, ranges):
        """Return gaps (m,) of two bodies along n (m, 3) [m]; second None: obstacles in ranges."""
        (R, p, *_), gap = placed, np.zeros(len(n))
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
        (R, p, *_), moves, way = placed, self.robot.moves, 0.0
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
        self.check_planes()

    def check_planes(self):
        """Check the planes of pairs of bodies, or of a body and the obstacles."""
        counts = self.b.shape[1], len(self.obstacles)
        found = [(*pair, *zip(*leaves(tree, *counts))) for *pair, tree in self.told["planes"]]
        number = {key: k for k, key in enumerate({key for x in found for key in x[2]})}
        placed = self.placed(number) if number else ()
        for one, other, keys, a, b, n in found:
            first, second = self.bodies[one], self.bodies.get(other)
            need(second or other == "obstacles", f"there is no body {other}")
            needed = SLACK + (0.0 if second else self.told["clearance"])
            at, ranges = [x[[number[key] for key in keys]] for x in placed], np.array([a, b]).T
            gap = self.gap(first, second, np.array(n), at, ranges) - self.way(first, second, at)
            k = int((gap > needed).argmin())
            what = f"{one} and {other if second else self.obstacles[a[k]].name}, piece {keys[k][0]}"
            need(gap[k] > needed, f"{what}: gap less way {gap[k]:.6g} m, needed {needed:.6g} m")

    def check_limits(self):
        """Check that limits are those of the URDF, or said to be others, and are kept."""
        own = {tuple(x) for x in self.told["limits_not_in_urdf"]}
        for j, name in enumerate(self.robot.names):
            joint, told = self.robot.known[name], self.told["limits"][name]
            words = attributes(joint, "limit")
            most = [np.inf if told[kind] is None else told[kind] for kind in KINDS]
            most[0] = np.inf if told["lower"] is None else -most[0]
            for kind, value, sign in zip(KINDS, most[:3], (-1.0, 1.0, 1.0)):
                stated = float(words.get(kind, 0.0))
                free = stated == 0.0 if kind == "velocity" else joint.get("type") == "continuous"
                free = free or (name, kind) in own or value <= sign * stated + SLACK
                need(free, f"{kind} limit {told[kind]} of {name}, in the URDF {stated}")
            b = self.b[..., j]
            ends = -most[0] - BEYOND_POSITION, most[1] + BEYOND_POSITION
            need(within(b, *ends), f"{name} exceeds its position limits")
            # b has errors of some 1e-16 of its size; each difference doubles them, times 5 and 4
            error = 1e-15 * max(1.0, np.abs(b).max())
            for order in range(2 * self.timed):
                b, error = (5 - order) * np.diff(b, axis=0) / self.h, 20.0 * error / self.h.min()
                limit = most[2 + order] * (1.0 + BEYOND_RATES[order]) - error
                need(within(b, -limit, limit), f"{name} exceeds its {KINDS[2 + order]} limit")

    def check_region(self, region):
        """Check the bounds of a region: values in the middle of intervals, and how they change.

        Seen from frame w, the origin of e moves by at most its way, and e turns by at most the sum
        of all turns. Its tilt changes by at most that; sizes of the entries of its rotation vector
        by pi / 2 times that: the vector may jump to its negative at angle pi, its sizes do not.
        """
        robot, b = self.robot, self.b  # those of intervals that are not proven
        (e, T_e), (w, T_w) = ((robot.rows[x["link"]], origin(x)) for x in region["frames"])
        joints = robot.moves[e] ^ robot.moves[w]
        hinges = [robot.joints[j][4:6] for j in joints if robot.joints[j][3] != "prismatic"]
        low, high = np.array(region["bounds"], dtype=float).reshape(9, 2).T  # null becomes nan
        low, high = np.nan_to_num(low, nan=-np.inf), np.nan_to_num(high, nan=np.inf)
        name, total = f"region of {region['name']}", 0
        while b.shape[1]:
            total += b.shape[1]
            need(total <= MOST_INTERVALS, f"{name} is not proven")
            R, p, widths, _ = placed = self.placed_in(b.min(axis=0), b.max(axis=0))
            at = R[:, e] @ T_e[:3, 3] + p[:, e]
            way, turned = robot.ways(placed, joints, at[:, None]), np.full(len(R), SLACK)
            for leader, factor in hinges:
                turned += abs(factor) * widths[:, leader]
            R_w, from_w = R[:, w] @ T_w[:3, :3], at - p[:, w] - R[:, w] @ T_w[:3, 3]
            D, t = R_w.swapaxes(1, 2) @ R[:, e] @ T_e[:3, :3], np.einsum("mij,mi->mj", R_w, from_w)
            diagonal = np.einsum("mii->mi", D)
            cosine = np.clip(0.5 * (diagonal.sum(axis=1) - 1.0), -1.0, 1.0)[:, None]
            shares = (diagonal - cosine) / np.maximum(1.0 - cosine, 1e-15)  # of axis, squared
            # rounding errors of the two roots are below 1e-7
            sizes = np.arccos(cosine) * np.sqrt(np.clip(shares, 0.0, 1.0)) + 1e-7
            tilt = np.arctan2(np.hypot(D[:, 0, 2], D[:, 1, 2]), D[:, 2, 2])
            rest = tilt, np.linalg.norm(t, axis=1), np.hypot(t[:, 0], t[:, 1])
            least, most = (np.column_stack([t, sign * sizes, *rest]) for sign in (-1.0, 1.0))
            change = np.column_stack([*[way] * 3, *[np.pi / 2 * turned] * 3, turned, way, way])
            beyond = np.maximum(low - least, most - high)
            need(((beyond - change) < BEYOND_REGION).all(), f"{name} is left")
            beyond = (beyond + change).max(axis=1)
            b = np.concatenate(halves(b[:, ~(beyond < BEYOND_REGION - SLACK)]), axis=1)


def main():
    """Check the proof that the command line names; return 0 (yes) or 1 (no)."""
    parser = argparse.ArgumentParser(description="Check a proof of a robot's motion.")
    parser.add_argument("proof", type=Path)
    parser.add_argument("--urdf", type=Path, required=True)
    parser.add_argument("--motion", type=Path, required=True)
    args = parser.parse_args()
    try:
        told, there = json.loads(args.proof.read_bytes(), parse_constant=int), 0
        proof = Proof(told, args.urdf.read_bytes(), args.motion.read_bytes())
        for hull in told["hulls"]:
            name = hull["mesh"].rpartition("://")[2]
            files = [folder / name for folder in args.urdf.resolve().parents]
            for file in [file for file in files if file.is_file()][:1]:
                same = hashlib.sha256(file.read_bytes()).hexdigest() == hull["sha256"]
                need(same, f"the proof is of another mesh {file}: its sha256 is another one")
                there += 1
        proof.check()
    except Exception as error:  # whatever is wrong in a file, it is no proof
        print(f"no: {error}" if isinstance(error, Refused) else f"no: cannot be read: {error!r}")
        return 1
    print(f"yes: {told['motion']} of {told['robot']}, {told['clearance']} m away from obstacles")
    print(f"obstacles: {', '.join(x.name for x in proof.obstacles) or 'none'}")
    print(f"hulls of {len(told['hulls'])} meshes are the proof's; {there} files have its digests")
    for pair in told["not_compared"]:
        print("not compared: {} and {} ({})".format(*pair))
    for key in ("held", "base", "limits", "limits_not_in_urdf", "regions", "bodies_left_out"):
        print(f"{key.replace('_', ' ')}: {json.dumps(told[key])}")
    print(f"not proven: {', '.join(told['not_proven'])}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
