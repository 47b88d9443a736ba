"""Planes between bodies on intervals of a motion: a tree for each pair, see docs/proof.md.

An interval is halved where no plane is found that both bodies cannot reach on it; a group of
obstacles is halved where the box around it is too near. The checker's own functions decide.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.collision.directions import Directions
from cvqmpt_lab.features.proof.cvqmpt_check import SLACK, Proof, halves

DIGITS = (2, 4, 8)  # of the numbers of a normal; the first that suffices are taken
DEEPEST = 16  # times that a piece of the motion is halved
MOST_LEAVES = 20_000  # of one tree
Interval = tuple[int, int, int, int]
"""Pieces lo to hi of the motion; or, of 2^halved parts of piece lo, that with this number."""


@dataclass(eq=False)
class Node:
    """A node of a tree: an interval of the motion, and a range of obstacles."""

    key: Interval
    first: int = 0
    last: int = 1
    normal: list[float] | None = None  # of a leaf
    split: str = ""  # "t" or "o" of an inner node
    children: list["Node"] = field(default_factory=list)

    def tokens(self) -> Iterator[Any]:
        """Yield the tree in preorder."""
        yield self.normal if self.normal is not None else self.split
        for child in self.children:
            yield from child.tokens()

    def halve(self, what: str) -> list["Node"]:
        """Make this an inner node; return its children."""
        lo, hi, halved, number = self.key
        if what == "o":
            middle = (self.first + self.last) // 2
            ranges = (self.first, middle), (middle, self.last)
            self.children = [Node(self.key, *ends) for ends in ranges]
        else:
            keys = [(lo, hi, halved + 1, 2 * number + k) for k in (0, 1)]
            if hi - lo > 1:
                middle = (lo + hi) // 2
                keys = [(lo, middle, 0, 0), (middle, hi, 0, 0)]
            self.children = [Node(key, self.first, self.last) for key in keys]
        self.split = what
        return self.children


@dataclass(eq=False)
class Pair:
    """A tree of planes between a piece and another one, or all obstacles (None)."""

    first: int  # number of the piece
    second: int | None
    root: Node
    open: list[Node]  # leaves without a plane
    leaves: int = 1


class Planes:
    """Search for the planes of a proof.

    Args:
        proof: the proof, without planes.
        directions: the bodies.
        names: the proof's name of each piece of `directions`.
    """

    def __init__(self, proof: Proof, directions: Directions, names: Sequence[str]) -> None:
        self._proof, self._directions, self._names = proof, directions, names
        self._boxes: dict[tuple[int, int], tuple[np.ndarray, np.ndarray]] = {}
        self._halved: dict[Interval, np.ndarray] = {}  # Bezier points of parts of pieces

    def found(self, compared: Sequence[int]) -> list[list[Any]]:
        """Return the planes of all pairs, in the form of the proof.

        Raises InvalidInputError if two bodies come too close to find some.

        compared: numbers of the pieces that are compared with obstacles.
        """
        whole, count = (0, self._proof.b.shape[1], 0, 0), len(self._proof.obstacles)
        ends: list[tuple[int, int | None, Node]]
        ends = [(i, k, Node(whole, 0, count)) for i, k in self._directions.pairs]
        ends += [(i, None, Node(whole, 0, count)) for i in compared if count]
        pairs = [Pair(i, k, root, [root]) for i, k, root in ends]
        while left := [pair for pair in pairs if pair.open]:
            keys = sorted({node.key for pair in left for node in pair.open})
            parts = [self._points(key) for key in keys]
            low, high = (np.array([f(b, axis=(0, 1)) for b in parts]) for f in (np.min, np.max))
            placed = self._proof.placed(low, high)
            number = {key: k for k, key in enumerate(keys)}
            found = self._directions_at(left, keys, 0.5 * (low + high))
            for pair, (distances, normals) in zip(left, found, strict=True):
                rows = [number[node.key] for node in pair.open]
                self._step(pair, distances, normals, [x[rows] for x in placed])
        named = [*self._names, "obstacles"]
        return [
            [named[pair.first], named[-1 if pair.second is None else pair.second], tree]
            for pair, tree in ((pair, [*pair.root.tokens()]) for pair in pairs)
        ]

    def _points(self, key: Interval) -> np.ndarray:
        """Return the Bezier points (6, m, n) of the motion on an interval."""
        lo, hi, halved, number = key
        if not halved:
            return self._proof.b[:, lo:hi]
        if key not in self._halved:
            both = halves(self._points((lo, hi, halved - 1, number // 2)))
            self._halved[key] = both[number % 2]
        return self._halved[key]

    def _directions_at(
        self, pairs: Sequence[Pair], keys: Sequence[Interval], states: np.ndarray
    ) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return distances (m,) and directions (m, 3) at the open nodes of pairs.

        Args:
            pairs: the pairs.
            keys: all intervals of their open nodes.
            states: (k, n) in the middle of these.
        """
        found = [(np.empty(len(p.open)), np.empty((len(p.open), 3))) for p in pairs]
        at: dict[Interval, list[tuple[int, int]]] = {key: [] for key in keys}
        for p, pair in enumerate(pairs):
            for k, node in enumerate(pair.open):
                at[node.key].append((p, k))
        for key, q in zip(keys, states, strict=True):
            self._directions.place(q)
            for p, k in at[key]:
                distances, normals = found[p]
                distances[k], normals[k] = self._direction(pairs[p], pairs[p].open[k])
        return found

    def _direction(self, pair: Pair, node: Node) -> tuple[float, np.ndarray]:
        if pair.second is not None:
            return self._directions.own(pair.first, pair.second)
        if node.last - node.first == 1:
            return self._directions.obstacle(pair.first, node.first)
        return self._directions.box(pair.first, *self._box(node))

    def _box(self, node: Node) -> tuple[np.ndarray, np.ndarray]:
        """Return the ends (3,) of the box around the obstacles of a node [m]."""
        ends = node.first, node.last
        if ends not in self._boxes:
            corners = [body.box for body in self._proof.obstacles[node.first : node.last]]
            self._boxes[ends] = np.min(corners, axis=(0, 1)), np.max(corners, axis=(0, 1))
        return self._boxes[ends]

    def _step(self, pair: Pair, distances: np.ndarray, normals: np.ndarray, placed: Any) -> None:
        """Close the open nodes of a pair that have a plane; halve the others.

        Args:
            pair: the pair.
            distances: (m,) of its open nodes [m].
            normals: (m, 3).
            placed: poses and half widths at these nodes.
        """
        bodies = self._proof.bodies
        first = bodies[self._names[pair.first]]
        second = None if pair.second is None else bodies[self._names[pair.second]]
        needed = self._proof.told["clearance"] if pair.second is None else 0.0
        ranges = np.array([[node.first, node.last] for node in pair.open])
        ways = self._proof.way(first, second, placed)
        # a body at this distance has no plane; directions are unknown where bodies overlap
        left = np.flatnonzero((distances - ways > needed) & (distances > 0.0))
        for digits in DIGITS:
            if not len(left):
                break
            rounded = np.round(normals[left], digits) + 0.0
            gap = self._proof.gap(first, second, rounded, [x[left] for x in placed], ranges[left])
            free = gap - ways[left] > needed + SLACK
            for k, normal in zip(left[free].tolist(), rounded[free].tolist(), strict=True):
                pair.open[k].normal = normal
            left = left[~free]
        single = ranges[:, 1] - ranges[:, 0] == 1 if second is None else True
        touching = single & (distances < needed - ways)
        children = list[Node]()
        for node, distance in zip(pair.open, distances.tolist(), strict=True):
            if node.normal is None:
                children += node.halve(self._what(pair, node, distance))
        pair.open, pair.leaves = children, pair.leaves + len(children) // 2
        too_deep = any(node.key[2] > DEEPEST for node in children)
        if touching.any() or too_deep or pair.leaves > MOST_LEAVES:
            other = "the obstacles" if pair.second is None else self._names[pair.second]
            raise InvalidInputError(
                f"no proof that others can check is found: {self._names[pair.first]} and {other} "
                f"come too close, by {1e3 * max(distances.min(), 0.0):.3g} mm: give the motion "
                "more clearance, or leave --proof out"
            )

    def _what(self, pair: Pair, node: Node, distance: float) -> str:
        """Return what is halved: "o", a group of obstacles that is large beside its distance."""
        if pair.second is not None or node.last - node.first == 1:
            return "t"
        low, high = self._box(node)
        return "o" if distance < 0.25 * float(np.linalg.norm(high - low)) else "t"
