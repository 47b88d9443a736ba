"""Steps of labelled code sequences as the sequence model meets them: every way on from a code, and the right one."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple, Self

import numpy as np

from cvqmpt_lab.kernels.search.code_graph import FEATURES, cost_to_go, ways_on
from cvqmpt_lab.planning.code_graph import SeenGraph
from cvqmpt_lab.planning.code_sequences import ROOM, SequenceSearch, SequenceSettings
from cvqmpt_lab.planning.small_network import SmallNetwork
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.training.roadmap_shards import RoadmapShard
from experiments.labels.labelled_scenes import unpacked
from experiments.labels.sight_examples import training_scenes

WAYS = 48  # on from a code, that are kept
PATHS = 40  # of each scene


class LabelledPath(NamedTuple):
    """The shortest path through a dictionary's free nodes and edges."""

    start: np.ndarray
    """(n,) [rad]."""
    goal: np.ndarray
    """(n,) [rad]."""
    codes: np.ndarray
    """(k,) on the way."""


@dataclass(frozen=True, eq=False)
class Steps:
    """s steps of sequences."""

    features: np.ndarray
    """(s, WAYS, FEATURES) float32, see `kernels.search.code_graph.ways_on`; 0 behind the last way."""
    count: np.ndarray
    """(s,) int64, ways on."""
    right: np.ndarray
    """(s,) int64, the one that the label takes."""

    @classmethod
    def together(cls, parts: Iterable["Steps"]) -> Self:
        """Those of several."""
        columns = zip(*(vars(part).values() for part in parts), strict=True)
        return cls(*(np.concatenate(column) for column in columns))

    def rows(self, chosen: np.ndarray) -> Self:
        """Some of them, by number."""
        return replace(self, **{name: column[chosen] for name, column in vars(self).items()})


def steps_of(
    seen: SeenGraph,
    cloud: np.ndarray,
    paths: Iterable[LabelledPath],
    settings: SequenceSettings | None = None,
) -> Steps:
    """Steps of labelled paths as they look with a cloud (m, 3) [m], of their own scene or of another one.

    Steps that the graph does not have, or from which it sees no way on, are left out.
    """
    network, settings = SmallNetwork.untrained(FEATURES), settings or SequenceSettings()
    return steps_along(
        (SequenceSearch(seen, network, cloud, path.start, path.goal[None], settings), path.codes)
        for path in paths
    )


def steps_along(asked: Iterable[tuple[SequenceSearch, np.ndarray]]) -> Steps:
    """Steps of labelled codes (k,) to the one goal of a search, as its graph shows the ways on."""
    target, room = np.empty(ROOM, dtype=np.int32), np.empty((ROOM, FEATURES))
    kept: list[tuple[np.ndarray, int, int]] = []
    for search, labelled in asked:
        cost_to_go(search.graph, search.question)
        codes, last = labelled.tolist(), len(search.graph.nodes)
        for here, there in zip([last, *codes], [*codes, last], strict=True):
            count = ways_on(search.graph, search.question, here, target, room)
            right = np.flatnonzero(target[:count] == there)
            if 0 < count <= WAYS and len(right):
                step = np.zeros((WAYS, FEATURES), dtype=np.float32)
                step[:count] = room[:count]
                kept.append((step, count, int(right[0])))
    return Steps(
        np.array([step for step, _, _ in kept], np.float32).reshape(-1, WAYS, FEATURES),
        np.array([count for _, count, _ in kept], np.int64),
        np.array([right for _, _, right in kept], np.int64),
    )


def training_steps(
    seen: SeenGraph,
    robot: Robot,
    shards: Iterable[RoadmapShard],
    scenes: int,
    paths: int,
    rng: np.random.Generator,
    *,
    validate: bool = False,
) -> Iterator[Steps]:
    """Steps of at most `paths` paths of each of the first `scenes` scenes that train, each in a cloud of its own.

    validate: of those that validate instead.
    """
    for shard, scene, cloud in training_scenes(shards, scenes, rng, validate=validate):
        yield steps_of(seen, cloud, labelled_paths(robot, shard, scene, paths))


def labelled_paths(robot: Robot, shard: RoadmapShard, scene: int, most: int) -> list[LabelledPath]:
    """The first paths of a scene that were found."""
    arrays = shard.arrays
    rows = np.flatnonzero((arrays["path_scene"] == scene) & np.isfinite(arrays["cost"]))[:most]
    first = arrays["code_start"]
    ends = unpacked(robot, arrays["ends"][rows])
    return [
        LabelledPath(start, goal, arrays["codes"][first[row] : first[row + 1]].astype(int))
        for row, (start, goal) in zip(rows.tolist(), ends, strict=True)
    ]
