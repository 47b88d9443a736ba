"""MPNet with projection, the learned baseline of the paper: a network proposes the path state by state.

Two sides grow in turn, from the start and from a goal, each towards the other's last state: the network proposes,
the proposal is clipped, projected and kept if free. When a direct motion joins the sides, every two
neighbouring states without a direct motion between them are joined by constrained tree growth.

What differs from the published code as it is known: proposals to one state are bounded, not repeated for ever;
connections are projected motions, not straight lines checked for collision alone; the tree growth is the
project's own; the cloud's encoding is paid for.
"""

import time
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from cvqmpt_lab.distributions import SamplingDistribution
from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.methods.observation import CloudOf, Observer
from cvqmpt_lab.models.mpnet.inference import MPNetInference
from cvqmpt_lab.models.mpnet.network import MPNetCheckpoint
from cvqmpt_lab.planning.allowance import Allowance
from cvqmpt_lab.planning.birrt import BiRRT
from cvqmpt_lab.planning.direct_motion import direct_motion
from cvqmpt_lab.planning.result import Budget, Path, PlanResult, PlanStatus, Timings
from cvqmpt_lab.planning.space import ConstrainedSpace
from cvqmpt_lab.prediction.configurations import robot_signature
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.cameras import CameraSettings


@dataclass(frozen=True, kw_only=True)
class MPNetSettings:
    """How rollouts are made.

    Attributes
    ----------
    rollouts: tried before giving up. Goals take turns, the nearest first. predictions: states of one rollout.
    attempts: proposals tested for one state before its rollout is given up.
    dropout: leave dropout on, as published; without it every attempt is the same, so there is one.
    bridge: join the sides by tree growth if they have not met after all predictions; otherwise such a rollout
        is given up.
    share: of the whole budget, that joining two neighbouring states may take.
    """

    rollouts: int = 10
    predictions: int = 10
    attempts: int = 32
    dropout: bool = True
    bridge: bool = True
    share: float = 0.1

    def __post_init__(self) -> None:
        for name in ("rollouts", "predictions", "attempts"):
            if getattr(self, name) < 1:
                raise InvalidInputError(f"{name} of MPNet is {getattr(self, name)}; give at least 1")
        if not 0.0 < self.share <= 1.0:
            raise InvalidInputError(f"share of MPNet is {self.share}; give more than 0 and at most 1")


@dataclass(frozen=True, eq=False)
class Rollout:
    """States (k, n) from start to goal; `joint` is the motion between states meeting and meeting + 1, if known."""

    states: np.ndarray
    meeting: int
    joint: Path | None


class MPNetPlanner:
    """A trained MPNet as a planner; see the module."""

    def __init__(
        self,
        checkpoint: MPNetCheckpoint,
        cloud_of: CloudOf | None = None,
        settings: MPNetSettings | None = None,
        name: str = "mpnet",
    ) -> None:
        """Take a snapshot of the weights. cloud_of: what the network sees; virtual cameras by default."""
        self.name, self.checkpoint = name, checkpoint
        self.settings = MPNetSettings() if settings is None else settings
        self.network = MPNetInference(checkpoint.network)
        self.cloud_of = cloud_of or Observer(CameraSettings.like_training(checkpoint.network.config.n_points))

    def plan(
        self,
        space: ConstrainedSpace,
        start: np.ndarray,
        goals: np.ndarray,
        sampler: SamplingDistribution,
        budget: Budget,
        rng: np.random.Generator,
    ) -> PlanResult:
        """Search a path from start (n,) to any row of goals (k, n); see `Planner`.

        `sampler` serves the tree growth. An iteration is one proposal tested or one sample used. The run also
        ends, as ITERATION_LIMIT, when all rollouts have failed.

        Raises
        ------
        InvalidInputError
            When the weights belong to another robot, or the cloud is none.
        """
        self.checkpoint.robot.require_same(robot_signature(space.robot))
        cloud = self.cloud_of(space.problem)
        before = space.counters
        allowance = Allowance(budget, space)
        code = self.network.encode(self.network.draw_points(cloud, rng))
        run = _Run(self.network, self.settings, space, sampler, allowance, rng, code, allowance.seconds)
        nearest = goals[np.argsort(np.linalg.norm(goals - start, axis=1), kind="stable")]
        path, status, detail = None, PlanStatus.ITERATION_LIMIT, ""
        for turn in range(self.settings.rollouts):
            path = run.attempt(start, nearest[turn % len(nearest)])
            spent = allowance.spent()
            if path is not None or spent is not None:
                status = PlanStatus.SOLVED if path is not None else spent or status
                break
        else:
            detail = f"all {self.settings.rollouts} rollouts failed"
        return PlanResult(
            status=status,
            path=path,
            seconds=allowance.seconds,
            counters=space.counters_since(before),
            vertices=run.vertices,
            sampler=f"{self.name}, {sampler.name}",
            detail=detail,
            timings=Timings(encode=run.encode_seconds, predict=run.predict_seconds),
        )


@dataclass(eq=False)
class _Run:
    """One call of `MPNetPlanner.plan`: rollouts, and the paths through them."""

    network: MPNetInference
    settings: MPNetSettings
    space: ConstrainedSpace
    sampler: SamplingDistribution
    allowance: Allowance
    rng: np.random.Generator
    code: np.ndarray
    encode_seconds: float
    predict_seconds: float = 0.0
    vertices: int = 0

    def attempt(self, start: np.ndarray, goal: np.ndarray) -> Path | None:
        """The path through one rollout, or None."""
        rollout = self._rollout(start, goal)
        return None if rollout is None else self._path(rollout)

    def _rollout(self, start: np.ndarray, goal: np.ndarray) -> Rollout | None:
        """Let both sides grow in turn until a direct motion joins them."""
        sides: tuple[list[np.ndarray], list[np.ndarray]] = ([start], [goal])
        joint = None
        for turn in range(self.settings.predictions):
            growing, other = sides[turn % 2], sides[1 - turn % 2]
            state = self._next_state(growing[-1], other[-1])
            if state is None:
                return None
            growing.append(state)
            self.vertices += 1
            joint = direct_motion(self.space, sides[0][-1], sides[1][-1])
            if joint is not None:
                break
        if joint is None and not self.settings.bridge:
            return None
        return Rollout(np.array(sides[0] + sides[1][::-1]), len(sides[0]) - 1, joint)

    def _next_state(self, current: np.ndarray, towards: np.ndarray) -> np.ndarray | None:
        """The first proposal that is free once clipped and projected, or None when attempts or budget are used up."""
        robot, settings = self.space.robot, self.settings
        dropout = self.rng if settings.dropout else None
        for _ in range(settings.attempts if settings.dropout else 1):
            if self.allowance.spent():
                return None
            self.allowance.count()
            began = time.perf_counter()
            proposed = self.network.propose(
                _normalised(robot, current), _normalised(robot, towards), self.code, dropout
            )
            q = _radians(robot, proposed)
            self.predict_seconds += time.perf_counter() - began
            if self.space.project(q) and self.space.valid(q):
                return q
        return None

    def _path(self, rollout: Rollout) -> Path | None:
        """Join every two neighbouring states, directly or by tree growth; None as soon as one pair fails."""
        motions = []
        for i, (a, b) in enumerate(pairwise(rollout.states)):
            motion = rollout.joint if i == rollout.meeting else direct_motion(self.space, a, b)
            motion = motion or self._grown(a, b)
            if motion is None:
                return None
            motions.append(motion.states if i == 0 else motion.states[1:])
        return Path(np.concatenate(motions))

    def _grown(self, a: np.ndarray, b: np.ndarray) -> Path | None:
        """A path from a to b (n,) by tree growth within its share of the budget."""
        if self.allowance.spent():
            return None
        part = self.allowance.part(self.settings.share)
        result = BiRRT().plan(self.space, a, b[None], self.sampler, part, self.rng)
        self.vertices += result.vertices
        return result.path


def _normalised(robot: Robot, q: np.ndarray) -> np.ndarray:
    """Configuration q (n,) [rad or m] in [-1, 1]."""
    return 2.0 * (q - robot.lower) / (robot.upper - robot.lower) - 1.0


def _radians(robot: Robot, u: np.ndarray) -> np.ndarray:
    """Configuration (n,) [rad or m] of u (n,), clipped to [-1, 1]."""
    return robot.lower + 0.5 * (np.clip(u, -1.0, 1.0).astype(float) + 1.0) * (robot.upper - robot.lower)
