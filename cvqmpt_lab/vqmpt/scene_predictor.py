"""The scene transformer as planners use it: from a cloud, a start and goals to code sequences,
without torch.

scene = predictor.encode(cloud)
nearest = goals[predictor.rank(scene, start, goals)[:3]]
sequences = predictor.sequences(scene, start, nearest)
"""

import hashlib

import numpy as np

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.latest import Latest
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.sensing.virtual import CameraSettings, thinned
from cvqmpt_lab.vqmpt.beam_search import CodeSequence
from cvqmpt_lab.vqmpt.codebook import require_own_dictionary
from cvqmpt_lab.vqmpt.compiled_groups import compiled_groups
from cvqmpt_lab.vqmpt.config import checked_cloud
from cvqmpt_lab.vqmpt.encoded_scene import EncodedScene, Ends
from cvqmpt_lab.vqmpt.point_groups import NOWHERE
from cvqmpt_lab.vqmpt.predictor import SCENES, checked_ends
from cvqmpt_lab.vqmpt.sequence_decoder import (
    CausalTransformer,
    SequenceDecoder,
    likeliest_sequences,
)
from cvqmpt_lab.vqmpt.weights import StoredModel

POINTS = 1024  # of a cloud in training
# [m] points farther from there than any in training are left out
CENTRE, FARTHEST = (0.0, 0.0, 0.33), 1.6


class SceneTransformerPredictor:
    """A trained scene transformer for one robot; remembers the latest clouds."""

    def __init__(self, model: StoredModel, robot: Robot) -> None:
        """Take over a model's weights.

        Raises InvalidInputError when it has no transformer, belongs to another robot, or does not
        fit its sizes.
        """
        self.robot, self._network = robot, CausalTransformer(model, robot)
        self._looker = self._network.looker
        require_own_dictionary(model)
        self._scenes = Latest[EncodedScene](SCENES)

    def encode(self, cloud: np.ndarray, use_cache: bool = True) -> EncodedScene:
        """Look at a cloud (m, 3) [m, robot base frame] from every code; found among the latest ones
        where it is.

        A cloud of no points is one of an empty scene. Raises InvalidInputError for a cloud that
        `checked_cloud` refuses, or that has no point within reach.
        """
        points = _near_points(cloud)
        key = hashlib.sha256(points.tobytes()).hexdigest()
        return self._scenes.get(key, lambda: self._encoded(points), use_cache)

    def _encoded(self, points: np.ndarray) -> EncodedScene:
        sizes = self._looker.config.sizes
        return self._looker.encode(
            *compiled_groups(_as_in_training(points), sizes.groups, sizes.group_size)
        )

    def sequences(
        self, scene: EncodedScene, start: np.ndarray, goals: np.ndarray, beams: int = 3
    ) -> list[CodeSequence]:
        """The likeliest code sequence from start (n,) to each of goals (k, n) [rad or m], in the
        order of the goals.

        beams: hypotheses kept for each goal, K. Raises InvalidInputError for a start or goal
            outside the joint limits.
        """
        return [found[0] for found in self.hypotheses(scene, start, goals, beams, every=False)]

    def hypotheses(
        self,
        scene: EncodedScene,
        start: np.ndarray,
        goals: np.ndarray,
        beams: int = 3,
        every: bool = True,
    ) -> list[list[CodeSequence]]:
        """All that are in the beams once the best of each goal, or every one, is finished; see
        `sequences`.

        The likeliest comes first.
        """
        start, goals = checked_ends(self.robot, start, goals)
        decoder = SequenceDecoder(self._network, scene, start, goals)
        return likeliest_sequences(decoder, beams, every)

    def goal_costs(self, scene: EncodedScene, start: np.ndarray, goals: np.ndarray) -> np.ndarray:
        """Cost (k,) [rad] of the cheapest way from start (n,) over the roadmap to each of goals (k,
        n).

        That of a motion is its length - w log P(free). No sequence is decoded. Errors as of
        `sequences`.
        """
        start, goals = checked_ends(self.robot, start, goals)
        ends = self._looker.ends(scene, np.vstack([start[None], goals]))
        own = Ends(*(part[:1] for part in ends))
        from_start = self._looker.cost_to_go(scene, own)[0]
        return (from_start[ends.near[1:]] + ends.cost[1:]).min(axis=1)

    def rank(self, scene: EncodedScene, start: np.ndarray, goals: np.ndarray) -> np.ndarray:
        """Rows (k,) of goals (k, n), the one with the cheapest way from start (n,) first;
        see `goal_costs`.
        """
        return np.argsort(self.goal_costs(scene, start, goals), kind="stable")


def _near_points(cloud: np.ndarray) -> np.ndarray:
    """Points (p, 3) float32 [m] of a cloud (m, 3) that are not too far away."""
    if np.shape(cloud) == (0, 3):
        return np.empty((0, 3), dtype=np.float32)
    points = checked_cloud(np.repeat(cloud, 2, axis=0) if np.shape(cloud) == (1, 3) else cloud)
    offset = points - np.array(CENTRE, dtype=np.float32)
    near = np.einsum("pi,pi->p", offset, offset) <= FARTHEST**2
    if not near.any():
        raise InvalidInputError(
            f"none of the cloud's {len(points)} points is within {FARTHEST:g} m of {CENTRE}: give "
            f"it in metres, in the "
            "frame of the robot's base"
        )
    return points if near.all() else points[near]


def _as_in_training(points: np.ndarray) -> np.ndarray:
    """At most POINTS points, evenly chosen; those of an empty scene lie far below the robot."""
    if len(points) == 0:
        return np.array([NOWHERE], dtype=np.float32)
    if len(points) > POINTS:
        settings = CameraSettings.like_training(POINTS, noise=0.0)
        return thinned(points, settings, np.random.default_rng(0)).astype(np.float32)
    return points
