"""Roadmaps of a robot and what it carries: configurations free of self-collision, linked along
motions that are, too.

Both hold in every scene, so they are found out once and kept in the user's cache. What is read from
there is checked
again: whatever else lies under that name is made anew.
"""

from collections.abc import Callable, Mapping
from functools import lru_cache
from pathlib import Path

import numpy as np

from cvqmpt_lab.collision.arrays import robot_arrays
from cvqmpt_lab.disk_cache import cached_arrays, sources_digest
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.scene import Attachment, Scene
from cvqmpt_lab.search.roadmap import TURN, Roadmap
from cvqmpt_lab.search.space import ConstrainedSpace

NODES = 1024
NEIGHBOURS = 20  # that each node is linked to, at most
TRIED = 30  # of its nearest nodes
BLOCKS = 32  # of NODES configurations each, at most, of which free ones become nodes
STEP = 0.2  # [rad] between states of a motion that are checked
UNIFORM, HALTON = "uniform", "halton"


@lru_cache(maxsize=8)
def spread_roadmap(
    robot: Robot, attachments: tuple[Attachment, ...] = (), sequence: str = HALTON, draw: int = 0
) -> Roadmap:
    """NODES configurations spread over the joint ranges, fewer where hardly any is free of
    self-collision.

    sequence: HALTON, scrambled, covers the ranges evenly; UNIFORM are independent draws. draw: its
        seed.
    Of joints that turn more than once one turn is covered, see `Roadmap.near`.
    """
    made_of = f"{sequence} {draw}".encode()
    return _kept(robot, attachments, made_of, lambda space: _free_draws(space, sequence, draw))


def linked_roadmap(robot: Robot, attachments: tuple[Attachment, ...], nodes: np.ndarray) -> Roadmap:
    """Those of given configurations (N, n) that are free of self-collision."""
    return _kept(robot, attachments, nodes.tobytes(), lambda space: nodes[space.valid_batch(nodes)])


def _kept(
    robot: Robot,
    attachments: tuple[Attachment, ...],
    made_of: bytes,
    nodes_of: Callable[[ConstrainedSpace], np.ndarray],
) -> Roadmap:
    """The roadmap of the nodes that a function gives, from the cache where it is there."""
    middle = 0.5 * (robot.lower + robot.upper)
    alone = PlanningProblem(
        robot.name, robot, Scene("empty", ()), middle, middle[None], attachments=attachments
    )
    space, geometry = ConstrainedSpace(alone), robot_arrays(robot, attachments)
    parts = [sources_digest(Path(__file__)).encode(), robot.kinematics_digest.encode(), made_of]
    parts += [np.ascontiguousarray(array).tobytes() for array in (*geometry.pieces, *geometry[1:])]

    def make() -> dict[str, np.ndarray]:
        nodes = nodes_of(space)
        return {"nodes": nodes, "neighbours": _linked(space, nodes)}

    found = cached_arrays(
        "roadmaps", b" ".join(parts), make, lambda arrays: _is_roadmap(space, arrays)
    )
    return Roadmap(found["nodes"], found["neighbours"])


def _is_roadmap(space: ConstrainedSpace, arrays: Mapping[str, np.ndarray]) -> bool:
    """Whether arrays are a roadmap of free configurations of a space's robot."""
    nodes, table, robot = arrays["nodes"], arrays["neighbours"], space.robot
    form = (
        nodes.ndim == table.ndim == 2
        and len(nodes) == len(table) <= NODES
        and nodes.shape[1] == robot.dof
    )
    if (
        not form
        or nodes.dtype != np.float64
        or table.dtype != np.int32
        or table.shape[1] > NEIGHBOURS
    ):
        return False
    inside = (nodes >= robot.lower) & (nodes <= robot.upper)  # False for nan
    return bool(
        inside.all()
        and ((table >= -1) & (table < len(nodes))).all()
        and space.valid_batch(nodes).all()
    )


def _free_draws(space: ConstrainedSpace, sequence: str, draw: int) -> np.ndarray:
    """Free configurations (at most NODES, n)."""
    robot, turns = space.robot, space.robot.turning
    middle = 0.5 * (robot.lower + robot.upper)
    low = np.where(turns, middle - 0.5 * TURN, robot.lower)
    width = np.where(turns, TURN, robot.upper - robot.lower)
    rng = np.random.default_rng(draw)
    if sequence == HALTON:
        from scipy.stats import qmc  # takes half a second to import

        unit = qmc.Halton(robot.dof, seed=rng).random
    else:
        unit = lambda count: rng.uniform(size=(count, robot.dof))  # noqa: E731
    found = np.empty((0, robot.dof))
    for _ in range(BLOCKS):
        if len(found) < NODES:
            states = np.ascontiguousarray(low + width * unit(NODES))
            found = np.concatenate([found, states[space.valid_batch(states)]])
    return found[:NODES].copy()


def _linked(space: ConstrainedSpace, nodes: np.ndarray) -> np.ndarray:
    """Nearest nodes (N, NEIGHBOURS) int32 of each, nearest first, that a free straight motion leads
    to; -1 for none.

    Joints that turn more than once take the shorter way round.
    """
    turns = space.robot.turning
    table = np.full((len(nodes), NEIGHBOURS), -1, dtype=np.int32)
    for i, node in enumerate(nodes):
        way = nodes - node
        way[:, turns] -= TURN * np.round(way[:, turns] / TURN)
        squares = (way**2).sum(axis=1)
        squares[i] = np.inf
        tried = min(TRIED, len(nodes) - 1)
        near = np.argpartition(squares, tried - 1)[:tried] if tried else np.empty(0, dtype=int)
        near = near[np.argsort(squares[near], kind="stable")]
        free = near[_motions_free(space, node, way[near])][:NEIGHBOURS]
        table[i, : len(free)] = free
    return table


def _motions_free(space: ConstrainedSpace, origin: np.ndarray, ways: np.ndarray) -> np.ndarray:
    """Whether the states every STEP of the motions from origin (n,) along each of ways (k, n) are
    free, (k,) bool.
    """
    pieces = np.maximum(np.ceil(np.linalg.norm(ways, axis=1) / STEP), 1.0).astype(int)
    motion = np.repeat(np.arange(len(ways)), pieces - 1)
    first = np.cumsum(pieces - 1) - (pieces - 1)
    share = (np.arange(len(motion)) - first[motion] + 1) / pieces[motion]
    free = np.ones(len(ways), dtype=bool)
    free[motion[~space.valid_batch(origin + share[:, None] * ways[motion])]] = False
    return free
