"""Roadmap labels on disk: a dictionary's nodes and edges, which are free in many scenes, and shortest paths.

As ``cvqmpt data generate --labels roadmap`` writes it, beside dataset.json and shards.csv (see `shards`)::

    roadmap.npz      nodes (N,n) float64 [rad], edges (E,2) int32, node_possible (N,) and edge_possible (E,) bool: free
                     in an empty scene
    shards/NNNNNN.npz
        family, scene_seed, shape_start, shape_kind, shape_size, shape_pose: as in `shards`
        node_free (s,N/8) and edge_free (s,E/8) uint8: packed bits
        path_scene (p,) int32, ends (p,2,n) uint16: start and goal, u * 65535
        code_start (p+1,) int32: ranges into codes (c,) uint16
        cost (p,) float32: length through the codes [rad], inf where there is no path; straight (p,) float32 [rad]
        differs (p,) bool: the codes are others than those of the shortest path in an empty scene
"""

import hashlib
import io
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.files import read_bytes, require_regular_file, write_bytes
from cvqmpt_lab.training.shards import SHARDS_FOLDER, Arrays, IndexRow, read_index

ROADMAP_FILE = "roadmap.npz"


@dataclass(frozen=True, eq=False)
class RoadmapGraph:
    """The nodes and edges that are labelled."""

    nodes: np.ndarray
    """(N, n) [rad]."""
    edges: np.ndarray
    """(E, 2) int32, each pair once."""
    node_possible: np.ndarray
    """(N,) bool: free in an empty scene."""
    edge_possible: np.ndarray
    """(E,) bool: likewise."""

    @property
    def digest(self) -> str:
        """Which nodes these are: sha256 of them."""
        return hashlib.sha256(self.nodes.tobytes()).hexdigest()

    def write(self, folder: Path) -> None:
        """Put it into a dataset's folder."""
        file = io.BytesIO()
        np.savez_compressed(file, **vars(self))
        write_bytes(folder / ROADMAP_FILE, file.getvalue())

    @classmethod
    def read(cls, folder: Path) -> Self:
        """What `write` wrote; InvalidInputError where it is missing or damaged."""
        arrays = _arrays(folder / ROADMAP_FILE)
        try:
            return cls(**{name: arrays[name] for name in cls.__annotations__})
        except KeyError as error:
            raise InvalidInputError(
                f"{folder / ROADMAP_FILE}: array {error} is missing; generate it again"
            ) from error


@dataclass(frozen=True, eq=False)
class RoadmapShard:
    """Labels of the scenes of one shard."""

    arrays: Arrays
    """As on disk."""
    graph: RoadmapGraph

    @classmethod
    def read(cls, folder: Path, row: IndexRow, graph: RoadmapGraph) -> Self:
        """One shard; InvalidInputError where it is missing, damaged or of another roadmap."""
        path = folder / SHARDS_FOLDER / row.file
        arrays, scenes = _arrays(path), row.scenes
        nodes, edges = (-(-len(part) // 8) for part in (graph.nodes, graph.edges))
        try:
            fits = arrays["node_free"].shape == (scenes, nodes) and arrays["edge_free"].shape == (
                scenes,
                edges,
            )
            fits = fits and len(arrays["code_start"]) == len(arrays["ends"]) + 1 == row.paths + 1
        except KeyError as error:
            raise InvalidInputError(f"{path}: array {error} is missing; generate it again") from error
        if not fits:
            raise InvalidInputError(f"{path} does not fit {ROADMAP_FILE} or the index; generate it again")
        return cls(arrays, graph)

    def node_free(self, scene: int) -> np.ndarray:
        """(N,) bool."""
        return np.unpackbits(self.arrays["node_free"][scene], count=len(self.graph.nodes)).astype(bool)

    @property
    def straight(self) -> np.ndarray:
        """(p,) length of the straight line from start to goal [rad]."""
        return self.arrays["straight"]

    def edge_free(self, scene: int) -> np.ndarray:
        """(E,) bool."""
        return np.unpackbits(self.arrays["edge_free"][scene], count=len(self.graph.edges)).astype(bool)


def read_roadmap_shards(folder: Path) -> list[RoadmapShard]:
    """All shards of a folder; errors as in `RoadmapShard.read` and `shards.read_index`."""
    graph = RoadmapGraph.read(folder)
    return [RoadmapShard.read(folder, row, graph) for row in read_index(folder)]


def _arrays(path: Path) -> Arrays:
    data = read_bytes(require_regular_file(path))
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as file:
            return {name: file[name] for name in file.files}
    except Exception as error:  # what a damaged archive raises depends on the byte
        raise InvalidInputError(f"{path} is not a readable archive of arrays: {error}") from error
