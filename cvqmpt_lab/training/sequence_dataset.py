"""Sequences of codes in memory, the data that sequence models are trained on.

Both kinds of data give the same type: labels on a roadmap store the codes of shortest paths, and
near-shortest paths are encoded by the dictionary when they are read.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.training.dataset import (
    PathDataset,
    TrainingData,
    holds_labels,
    open_dataset,
    read_dataset_description,
)
from cvqmpt_lab.training.shards import (
    FULL_SCALE,
    LABEL_ARRAYS,
    SCENE_ARRAYS,
    RoadmapGraph,
    joined,
    read_shards,
)
from cvqmpt_lab.vqmpt.checkpoint import Checkpoint
from cvqmpt_lab.vqmpt.dictionary import LinkPositions


@dataclass(frozen=True, eq=False)
class SequenceDataset(TrainingData):
    """A dataset of code sequences h_1 ... h_l from starts to goals.

    Arrays are named as in `shards.LABEL_ARRAYS`: ``ends``, ``codes``, ``code_start`` and the arrays
    of scenes. With a roadmap there are also labels: which nodes, edges and links are free.
    """

    graph: RoadmapGraph | None  # None if the sequences are encoded paths

    def configurations(self, joints: np.ndarray) -> np.ndarray:
        """Return configurations lower + u (upper - lower) (..., n) float32 of stored joints."""
        lower, upper = np.array(self.robot.lower), np.array(self.robot.upper)
        return (lower + joints / FULL_SCALE * (upper - lower)).astype(np.float32)

    def free(self, name: str, scenes: np.ndarray) -> np.ndarray:
        """Return which nodes (k, N) or edges (k, E) of the roadmap are free in scenes (k,), bool.

        name: "node" or "edge".
        """
        count = len(getattr(self.graph, f"{name}s"))
        bits = self.arrays[f"{name}_free"][scenes]
        return np.unpackbits(bits, axis=1, count=count).astype(bool)


def open_labels(folder: Path) -> SequenceDataset:
    """Read a dataset's labels on a roadmap into memory; pairs without a path are left out.

    Raises:
        InvalidInputError: a file is missing, damaged or of another kind; the message names it.
    """
    description = read_dataset_description(folder)
    if not holds_labels(folder):
        raise InvalidInputError(
            f"{folder} holds paths, not labels on a roadmap; make those: cvqmpt data generate "
            "--labels roadmap"
        )
    graph = RoadmapGraph.read(folder)
    shards = read_shards(folder, LABEL_ARRAYS, len(description["robot"].lower))
    arrays = joined(shards, LABEL_ARRAYS)
    count = np.diff(arrays["code_start"])
    found = np.isfinite(arrays["cost"]) & (count > 0)
    for name, column in LABEL_ARRAYS.items():
        if column.rows == "path" and not column.ranges:
            arrays[name] = arrays[name][found]
    arrays["code_start"] = np.concatenate([[0], np.cumsum(count[found])])
    arrays["codes"] = arrays["codes"][np.repeat(found, count)]
    return SequenceDataset(**description, arrays=arrays, graph=graph)


def open_sequences(folder: Path, dictionary: Checkpoint) -> SequenceDataset:
    """Read code sequences: labels on a roadmap, or paths, which the dictionary encodes.

    Raises:
        InvalidInputError: as of `open_labels` and `open_dataset`, or the paths are of another
            robot than the dictionary.
    """
    if holds_labels(folder):
        return open_labels(folder)
    paths = open_dataset(folder)
    dictionary.robot.require_same(paths.robot)
    every = np.arange(len(paths.arrays["path_scene"]))
    rows = paths.with_few_trivial(every, 0.15, np.random.default_rng(0))
    codes = _codes_of_paths(paths, rows, dictionary)
    start = paths.arrays["path_start"]
    ends = np.stack([start[rows], start[rows + 1] - 1], axis=1)
    arrays = {name: paths.arrays[name] for name in SCENE_ARRAYS} | {
        "path_scene": paths.arrays["path_scene"][rows],
        "ends": paths.arrays["waypoints"][ends],
        "code_start": np.cumsum([0, *map(len, codes)]),
        "codes": np.concatenate(codes),
    }
    return SequenceDataset(**vars(paths) | {"arrays": arrays}, graph=None)


def _codes_of_paths(
    paths: PathDataset, rows: np.ndarray, dictionary: Checkpoint
) -> list[np.ndarray]:
    """Encode the waypoints of paths (k,): the codes of each path, repeated codes left out."""
    chain = paths.chain if dictionary.config.feature_dim else None
    links = LinkPositions(paths.robot.lower, paths.robot.upper, chain)
    encoder = dictionary.modules["dictionary"]
    counts = np.diff(paths.arrays["path_start"])[rows]
    codes: list[np.ndarray] = [np.empty(0)] * len(rows)
    # the encoder attends to padding, and a batch of paths of equal length has none
    for count in np.unique(counts).tolist():
        equal = np.flatnonzero(counts == count)
        for batch in np.array_split(equal, -(-len(equal) // 64)):
            with torch.no_grad():
                u = torch.from_numpy(paths.padded(rows[batch])[0])
                encoded = encoder.encode(links.configurations(u)).numpy()
            for row, own in zip(batch.tolist(), encoded, strict=True):
                codes[row] = own[np.append(True, own[1:] != own[:-1])]
    return codes
