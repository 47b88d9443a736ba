"""Near-shortest paths in random scenes, the labels that VQ-MPT and MPNet learn from."""

from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from cvqmpt_lab.labels.generation import (
    SceneRecipe,
    free_configurations,
    near_obstacles,
    unconstrained_space,
)
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.scene import Scene
from cvqmpt_lab.search.anytime import NearShortestSettings, near_shortest
from cvqmpt_lab.search.motion import motion_free
from cvqmpt_lab.search.result import JointPath
from cvqmpt_lab.search.space import ConstrainedSpace
from cvqmpt_lab.training.shards import PATH_ARRAYS, SPACING, packed


@dataclass(frozen=True)
class PathRecipe(SceneRecipe):
    """Near-shortest paths in random scenes."""

    title: ClassVar = "Near-shortest paths in random scenes"
    columns: ClassVar = PATH_ARRAYS

    labels: NearShortestSettings = field(default_factory=NearShortestSettings)

    def labelled(self, robot: Robot, scene: Scene, index: int) -> dict[str, Any]:
        """Labelled paths."""
        rng = np.random.default_rng((self.seed, index))
        space = unconstrained_space(robot, scene)
        labels = _labels(space, rng, self.paths_per_scene, self.labels)
        paths = [path for path, _ in labels]
        waypoints = [packed(path.spaced(SPACING), robot.lower, robot.upper) for path in paths]
        return {
            "path_scene": np.zeros(len(paths), int),
            "path_start": np.cumsum([0, *map(len, waypoints)]),
            "waypoints": np.concatenate([np.empty((0, robot.dof), np.uint16), *waypoints]),
            "length": [path.length for path in paths],
            "straight": [np.linalg.norm(path.states[-1] - path.states[0]) for path in paths],
            "trivial": np.array([trivial for _, trivial in labels], bool),
        }


def _labels(
    space: ConstrainedSpace,
    rng: np.random.Generator,
    pairs: int,
    settings: NearShortestSettings,
    most_trivial: float = 0.15,
    most_straight: float = 0.5,
    detour: float = 1.03,
) -> list[tuple[JointPath, bool]]:
    """Labelled paths of one scene.

    Half of the starts and goals are anywhere, half with the hand near an obstacle. Most motions are
    nearly straight and say little about the scene, so their share is bounded.

    Args:
        space: unconstrained space of the scene.
        rng: draws starts, goals and searches.
        pairs: of start and goal, at most.
        settings: of the search.
        most_trivial: share of pairs whose straight line may be free.
        most_straight: share of paths that may be straight or nearly so.
        detour: a path is nearly straight unless it is so many times as long as the straight line.

    Returns:
        Paths, and whether the straight line of each is free.
    """
    candidates = free_configurations(space, rng)
    if len(candidates) < 2:
        return []
    tasklike = candidates[near_obstacles(space, candidates)]
    labels: list[tuple[JointPath, bool]] = []
    straight = 0
    for pair in range(pairs):
        pool = tasklike if pair % 2 and len(tasklike) >= 2 else candidates
        enough = sum(is_trivial for _, is_trivial in labels) >= most_trivial * pairs
        for _ in range(10):
            start, goal = pool[rng.choice(len(pool), 2, replace=False)]
            trivial = bool(motion_free(space.arrays, start, goal))
            if not (trivial and enough):
                break
        else:
            continue
        line = JointPath(np.array([start, goal]))
        path = line if trivial else near_shortest(space, start, goal, rng, settings)
        if path is None:
            continue
        nearly = path.length < detour * np.linalg.norm(goal - start)
        if nearly and straight >= most_straight * pairs:
            continue
        straight += int(nearly)
        labels.append((path, trivial))
    return labels
