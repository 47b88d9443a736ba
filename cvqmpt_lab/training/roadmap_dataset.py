"""Labels on a dictionary's roadmap in memory:
scenes, which nodes and edges are free, shortest code sequences.
"""

import hashlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.files import read_bytes
from cvqmpt_lab.training.dataset import (
    VALIDATION_EVERY,
    Scenes,
    SplitName,
    read_dataset_description,
    together,
    together_ranges,
    together_rows,
    together_scenes,
)
from cvqmpt_lab.training.shards import (
    DESCRIPTION_FILE,
    FULL_SCALE,
    INDEX_FILE,
    ROADMAP_FILE,
    RoadmapGraph,
    read_roadmap_shards,
)
from cvqmpt_lab.vqmpt.config import SerialChain
from cvqmpt_lab.vqmpt.weights import RobotSignature


@dataclass(frozen=True, eq=False)
class RoadmapDataset:
    """s scenes of a roadmap with N nodes and E edges, p shortest paths;
    pairs without a path are left out.
    """

    folder: Path
    robot: RobotSignature
    families: tuple[str, ...]
    chain: SerialChain | None  # kinematics; the roadmap's body points are fixed to its links
    sha256: str  # of the description and the index, which holds those of the shards
    graph: RoadmapGraph
    scenes: Scenes
    node_bits: np.ndarray  # (s, N/8) uint8: packed bits, 1 where the node is free
    edge_bits: np.ndarray  # (s, E/8) uint8, likewise
    path_scene: np.ndarray  # (p,) int64: row of the scene, ascending
    ends: np.ndarray  # (p, 2, n) uint16: start and goal, u times FULL_SCALE
    code_start: np.ndarray  # (p + 1,) int64: ranges into the codes
    codes: np.ndarray  # (c,) uint16
    link_start: np.ndarray  # (s + 1,) int64: ranges into the ends of links
    link_end: np.ndarray  # (e, n) uint16: configurations, u times FULL_SCALE
    link_code: np.ndarray  # (e, k) uint16: the nodes near each
    link_free: np.ndarray  # (e, k) bool: the straight motion between both is free

    def split(self, name: SplitName) -> np.ndarray:
        """Rows of the paths that train or validate."""
        validates = self.scenes.seed[self.path_scene] % VALIDATION_EVERY == 0
        return np.flatnonzero(validates == (name == "validation"))

    def configurations(self, rows: np.ndarray) -> np.ndarray:
        """Start and goal (r, 2, n) float32 [rad] of paths."""
        return self.unpacked(self.ends[rows])

    def unpacked(self, joints: np.ndarray) -> np.ndarray:
        """Configurations (..., n) float32 [rad] of 16-bit shares of the joints' ranges."""
        lower, upper = np.array(self.robot.lower), np.array(self.robot.upper)
        return (lower + joints / FULL_SCALE * (upper - lower)).astype(np.float32)

    def free(self, scenes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Which nodes (k, N) and edges (k, E) are free in scenes, bool."""
        nodes, edges = self.graph.nodes, self.graph.edges
        parts = (self.node_bits[scenes], len(nodes)), (self.edge_bits[scenes], len(edges))
        node, edge = (
            np.unpackbits(bits, axis=1, count=count).astype(bool) for bits, count in parts
        )
        return node, edge


def open_roadmap_dataset(folder: Path) -> RoadmapDataset:
    """Read all labels into memory;
    InvalidInputError names the file that is missing, damaged or of another kind.
    """
    folder = Path(folder)
    robot, families, chain = read_dataset_description(folder)
    if not (folder / ROADMAP_FILE).exists():
        raise InvalidInputError(
            f"{folder} holds paths, not labels on a roadmap; make those: cvqmpt data generate "
            f"--labels roadmap"
        )
    shards = read_roadmap_shards(folder)
    arrays = [shard.arrays for shard in shards]
    found = np.isfinite(together(arrays, "cost")) & (
        np.diff(together_ranges(arrays, "code_start", "codes")) > 0
    )
    start = together_ranges(arrays, "code_start", "codes")
    count, codes = np.diff(start), together(arrays, "codes")
    digest = hashlib.sha256(
        read_bytes(folder / DESCRIPTION_FILE) + read_bytes(folder / INDEX_FILE)
    ).hexdigest()
    return RoadmapDataset(
        folder=folder,
        robot=robot,
        families=families,
        chain=chain,
        sha256=digest,
        graph=shards[0].graph,
        scenes=together_scenes(arrays),
        node_bits=together(arrays, "node_free"),
        edge_bits=together(arrays, "edge_free"),
        path_scene=together_rows(arrays, "path_scene", "scene_seed")[found],
        ends=together(arrays, "ends")[found],
        code_start=np.concatenate([[0], np.cumsum(count[found])]),
        codes=codes[np.repeat(found, count)],
        link_start=together_ranges(arrays, "link_start", "link_end"),
        link_end=together(arrays, "link_end"),
        link_code=together(arrays, "link_code"),
        link_free=together(arrays, "link_free"),
    )
