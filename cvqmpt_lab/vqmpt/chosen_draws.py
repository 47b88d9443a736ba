"""Choices among the draws of a sampling distribution, before a search pays for a motion to one.

`ClearestDraws` compares draws with the cloud that the network sees. `HalvedMixture` gives each of
two trees the draws of its own half of a predicted sequence.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from cvqmpt_lab.robot.kinematics import link_poses
from cvqmpt_lab.search.planner_interface import GaussianMixture, SamplingDistribution
from cvqmpt_lab.search.space import ConstrainedSpace

MARGIN_M = 0.02  # distance from the cloud that counts as clear
TRIES = 8  # draws of which the clearest one is taken


@dataclass(frozen=True, eq=False)
class HalvedMixture:
    """Mixtures of the two halves of a sequence, from the start and to the goal.

    A search with one tree draws from both in turn.
    """

    halves: tuple[GaussianMixture, GaussianMixture]

    @classmethod
    def of(cls, whole: GaussianMixture, codes: int) -> "HalvedMixture":
        """Divide a mixture of so many codes in order of the sequence, and of goals behind them.

        The middle code of an odd number is in both halves. Goals are in the second half.
        """
        first, second = slice(0, (codes + 1) // 2), slice(codes // 2, None)
        if codes == 0:
            first = slice(None)
        return cls((_part(whole, first), _part(whole, second)))

    @property
    def name(self) -> str:
        """Name in result rows."""
        return self.halves[0].name

    def of_tree(self, tree: int) -> GaussianMixture:
        """Return the distribution of the tree from the start (0) or from the goal (1)."""
        return self.halves[tree]

    def sample(self, rng: np.random.Generator, count: int) -> np.ndarray:
        """Draw configurations (count, n) [rad or m] from both halves in turn."""
        each = [half.sample(rng, (count + 1) // 2) for half in self.halves]
        return np.stack(each, axis=1).reshape(-1, each[0].shape[1])[:count]


def _part(whole: GaussianMixture, rows: slice) -> GaussianMixture:
    """Return the mixture of some of the Gaussians, of equal weight."""
    means, covariances = whole.means[rows], whole.covariances[rows]
    weights = np.full(len(means), 1.0 / len(means))
    return GaussianMixture(
        means, covariances, weights, whole.uniform, whole.uniform_share, whole.name
    )


class BodyBalls(NamedTuple):
    """Balls that cover the moving bodies of a robot and of what it carries."""

    link: np.ndarray  # (b,), pose row of each ball
    centre: np.ndarray  # (b, 3), in its link's frame [m]
    radius: np.ndarray  # (b,) [m]

    @classmethod
    def of(cls, space: ConstrainedSpace) -> "BodyBalls":
        """Return the smallest balls of the collision checker that are checked with obstacles."""
        robot = space.arrays.robot
        body = np.repeat(np.arange(len(robot.body_link)), np.diff(robot.body_start))
        taken = (robot.leaf >= 0) & np.isin(body, robot.order)
        return cls(robot.body_link[body[taken]], robot.sphere[taken, :3], robot.sphere[taken, 3])


@dataclass(frozen=True, eq=False)
class Clearness:
    """How deep the body of a robot at a configuration lies in a cloud.

    p(q) = sum_k max(0, r_k + MARGIN_M - d_k(q)), with the radius r_k of a ball and the distance d_k
    of its centre to the nearest point of the cloud.
    """

    space: ConstrainedSpace
    cloud: np.ndarray  # (m, 3) [m, robot base frame]

    @cached_property
    def _balls(self) -> BodyBalls:
        return BodyBalls.of(self.space)

    @cached_property
    def _tree(self) -> Any:
        from scipy.spatial import cKDTree  # takes 0.3 s to import

        return cKDTree(self.cloud)

    def depths(self, q: np.ndarray) -> np.ndarray:
        """Return p (k,) [m] of configurations q (k, n) [rad or m]."""
        if not len(self.cloud):
            return np.zeros(len(q))
        rotation, translation = link_poses(self.space.robot.kinematics, np.ascontiguousarray(q))
        balls = self._balls
        rotated = np.einsum("kbij,bj->kbi", rotation[:, balls.link], balls.centre)
        centres = rotated + translation[:, balls.link]
        inside = balls.radius + MARGIN_M
        distance, _ = self._tree.query(centres, distance_upper_bound=inside.max())
        return np.maximum(inside - distance, 0.0).sum(axis=1)


@dataclass(frozen=True, eq=False)
class ClearestDraws:
    """Of every TRIES draws of a distribution, moved into the limits, the clearest one."""

    drawn: SamplingDistribution
    clearness: Clearness

    @property
    def name(self) -> str:
        """Name in result rows."""
        return self.drawn.name

    def of_tree(self, tree: int) -> "SamplingDistribution":
        """Return the distribution of one tree, see `HalvedMixture`."""
        if not isinstance(self.drawn, HalvedMixture):
            return self
        return ClearestDraws(self.drawn.of_tree(tree), self.clearness)

    def sample(self, rng: np.random.Generator, count: int) -> np.ndarray:
        """Draw configurations (count, n) [rad or m]."""
        robot = self.clearness.space.robot
        draws = np.clip(self.drawn.sample(rng, count * TRIES), robot.lower, robot.upper)
        depth = self.clearness.depths(draws).reshape(count, TRIES)
        return draws.reshape(count, TRIES, -1)[np.arange(count), depth.argmin(axis=1)]
