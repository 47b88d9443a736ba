"""Datasets of roadmap labels: a dictionary's nodes and edges checked in random scenes, and paths through them."""

from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

import numpy as np

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.methods.loaded import dictionary_roadmap
from cvqmpt_lab.methods.method import Weights
from cvqmpt_lab.robot.loading import robot_from_source
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.training.dataset import VALIDATION_EVERY
from cvqmpt_lab.training.shards import (
    ROADMAP_FILE,
    IndexRow,
    RoadmapGraph,
    RoadmapShard,
    packed_shard,
    read_roadmap_shards,
)
from experiments.labels.roadmap_labels import roadmap_arrays, roadmap_graph, roadmap_labels
from experiments.labels.training_data import SceneRecipe


@dataclass(frozen=True)
class RoadmapRecipe(SceneRecipe):
    """Labels on the roadmap of a dictionary."""

    labels: str = field(default="roadmap", init=False)
    model: str | None = None
    """Name or folder of the dictionary's weights, see `vqmpt.weights.resolve_model`; None for the shipped."""

    def prepare(self, out: Path) -> None:
        """Write the roadmap, or check that it is the one that is there."""
        graph = _graph(self.model, robot_from_source(self.robot))
        if (out / ROADMAP_FILE).exists() and RoadmapGraph.read(out).digest != graph.digest:
            raise InvalidInputError(f"{out} holds labels of another dictionary; choose another --out")
        graph.write(out)

    def shard(self, number: int) -> tuple[IndexRow, bytes]:
        """Scenes with all their nodes and edges checked."""
        robot = robot_from_source(self.robot)
        graph, scenes = _graph(self.model, robot), []
        for index, family, scene_number, scene in self.scenes_of(number):
            draw = roadmap_labels(robot, scene, graph, self.paths_per_scene, (self.seed, index))
            if draw is not None:
                scenes.append((family, scene_number, draw))
        return packed_shard(number, roadmap_arrays(scenes))

    def card(self, out: Path) -> str:
        """Counts, shares and lengths by family, of both splits."""
        shards = read_roadmap_shards(out)
        graph = shards[0].graph
        lines = [
            "# Labels on a dictionary's roadmap",
            "",
            f"{len(graph.nodes)} nodes and {len(graph.edges)} edges of the dictionary {graph.digest[:12]}; the robot "
            f"itself allows {graph.node_possible.mean():.3f} of the nodes and {graph.edge_possible.mean():.3f} of the "
            f"edges. Scenes whose number is divisible by {VALIDATION_EVERY} validate. Pairs of start and goal, half of "
            "them near an obstacle, whose straight motion is blocked. No path: through this roadmap. Others than "
            "blind: the codes differ from those of the shortest path in an empty scene. Detour: length of the shortest "
            "path over that of the straight line, mean. Scenes with a wall millimetres "
            f"from the base are left out: {self.scenes - sum(len(shard.arrays['family']) for shard in shards)}.",
            "",
            "| family | scenes | of them validate | nodes free | edges free | pairs | no path | others than blind "
            "| detour | codes a path |",
            "|---|---|---|---|---|---|---|---|---|---|",
            *(_row(shards, name, [k]) for k, name in enumerate(self.families)),
            _row(shards, "all", list(range(len(self.families)))),
        ]
        return "\n".join(lines) + "\n"


@lru_cache(maxsize=1)
def _graph(model: str | None, robot: Robot) -> RoadmapGraph:
    return roadmap_graph(robot, dictionary_roadmap(Weights("vq_mpt", model), robot))


def _row(shards: list[RoadmapShard], name: str, families: list[int]) -> str:
    """Counts and means of the scenes of some families."""
    scenes = validate = pairs = codes = 0
    node_free, edge_free, found, differs, detour = [], [], [], [], []
    for shard in shards:
        arrays = shard.arrays
        own = np.isin(arrays["family"], families)
        scenes += int(own.sum())
        validate += int((own & (arrays["scene_seed"] % VALIDATION_EVERY == 0)).sum())
        node_free += [shard.node_free(scene).mean() for scene in np.flatnonzero(own).tolist()]
        edge_free += [shard.edge_free(scene).mean() for scene in np.flatnonzero(own).tolist()]
        paths = own[arrays["path_scene"]]
        solved = paths & np.isfinite(arrays["cost"])
        pairs += int(paths.sum())
        codes += int(np.diff(arrays["code_start"])[solved].sum())
        found.append(np.isfinite(arrays["cost"])[paths])
        differs.append(arrays["differs"][solved])
        detour.append(arrays["cost"][solved] / arrays["straight"][solved])
    if pairs == 0:
        return f"| {name} | {scenes} | {validate} | - | - | 0 | - | - | - | - |"
    solved_share, count = np.concatenate(found).mean(), max(int(np.concatenate(found).sum()), 1)
    return (
        f"| {name} | {scenes} | {validate} | {np.mean(node_free):.2f} | {np.mean(edge_free):.2f} | {pairs} "
        f"| {100 * (1 - solved_share):.0f} % | {100 * np.concatenate(differs).mean():.0f} % "
        f"| {np.concatenate(detour).mean():.2f} | {codes / count:.1f} |"
    )
