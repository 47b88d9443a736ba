"""MPNet with projection, the paper's learned baseline: a network proposes the path step by step.

Two sides grow in turn, one from the start and one from the nearest goal, each towards the last
state of the other. A proposal is clipped and projected, and kept if it is free of collision. When a
straight joint line without collision joins the sides, each pair of neighbouring states is connected
by a constrained motion: a direct one, else one found by tree growth. A rollout fails if the sides
do not meet or a pair cannot be connected; then the next rollout starts.

Known differences from the published code: the number of proposals for one state is limited; the
direct motion is tried before tree growth; the tree growth is this project's and gets a share
of the budget (there 5 of 50 s); the time to encode the cloud counts. There are 50 rollouts, because
the published code makes ten for each of five goals, which are identical there.

Planner `ompl-mpnet` has two of these as published: each pair is planned by OMPL's RRTConnect with
5 s at the published prices, without a direct motion first.

In the bridged variant, tree growth also connects sides that have not met. All goals take turns in
ten rollouts, sides meet along a constrained motion, and the network gets projected states as input.
"""

import time
from collections import Counter
from dataclasses import dataclass, field, replace
from itertools import count, pairwise
from typing import NamedTuple

import numpy as np

from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.search.birrt import BiRRT
from cvqmpt_lab.search.planner_interface import Observation, Proposal, Query, Search
from cvqmpt_lab.search.result import Budget, JointPath, PlanStatus, Timings
from cvqmpt_lab.search.space import ConstrainedSpace, direct_motion
from cvqmpt_lab.vqmpt.config import BY_ROLLOUTS, ROLLOUTS_ALONE, MPNetConfig
from cvqmpt_lab.vqmpt.numpy_layers import Layers
from cvqmpt_lab.vqmpt.weights import StoredModel


class MPNetNetwork:
    """MPNet in numpy."""

    def __init__(self, model: StoredModel) -> None:
        """Copy the weights; InvalidInputError if they do not fit the configuration."""
        self.config: MPNetConfig = model.config
        config = self.config
        layers = Layers(model, "mpnet")
        encoder = (3 * config.n_points, *config.encoder_widths)
        hidden = (config.code_dim + 2 * config.joint_dim, *config.planner_widths)
        # pairs of a linear layer and the slope a of its PReLU: y if y > 0, else a y
        self._encoder = [
            (layers.linear(f"encoder.{k}", *widths), layers.array(f"encoder.{k + 1}.weight", 1))
            for k, widths in zip(count(step=2), pairwise(encoder), strict=False)
        ]
        self._code = layers.linear(
            f"encoder.{2 * len(self._encoder)}", encoder[-1], config.code_dim
        )
        self._hidden = [
            (layers.linear(f"hidden.{k}.0", *widths), layers.array(f"hidden.{k}.1.weight", 1))
            for k, widths in enumerate(pairwise(hidden))
        ]
        self._out = layers.linear("out", hidden[-1], config.joint_dim)

    def encode(self, points: np.ndarray) -> np.ndarray:
        """Encode points (n_points, 3) [m] to a code (code_dim,)."""
        x = np.ascontiguousarray(points, dtype=np.float32).ravel()
        for linear, slope in self._encoder:
            y = linear(x)
            x = np.where(y > 0.0, y, slope * y)
        return self._code(x)

    def propose(
        self,
        current: np.ndarray,
        goal: np.ndarray,
        code: np.ndarray,
        rng: np.random.Generator | None = None,
    ) -> np.ndarray:
        """Propose the next configuration.

        Args:
            current: (joint_dim,), normalised to [-1, 1].
            goal: (joint_dim,), normalised to [-1, 1].
            code: (code_dim,), encoded cloud.
            rng: random numbers for dropout; None for no dropout.

        Returns:
            (joint_dim,), normalised but not clipped.
        """
        x = np.concatenate((code, current, goal)).astype(np.float32)
        share = np.float32(self.config.dropout)
        last = len(self._hidden) - 1
        for i, (linear, slope) in enumerate(self._hidden):
            y = linear(x)
            x = np.where(y > 0.0, y, slope * y)
            if rng is not None and share > 0.0 and i < last:
                x = x * (rng.random(len(x), dtype=np.float32) >= share) / (np.float32(1.0) - share)
        return self._out(x)


class Rollout(NamedTuple):
    """States of one rollout from start to goal."""

    states: np.ndarray  # (k, n) [rad or m]
    meeting: int  # last row of the side of the start; the rows after it are the side of the goal
    met: bool  # whether the sides met; if not, tree growth must join them
    joint: JointPath | None  # direct motion between the last states of both sides, if there is one


@dataclass(frozen=True, eq=False)
class MPNetRollouts:
    """A trained MPNet that proposes whole paths; see the module."""

    network: MPNetNetwork
    bridged: bool = False  # whether tree growth joins sides that did not meet
    rollouts: int = 50  # maximum number of rollouts
    predictions: int = 10  # maximum number of predicted states in one rollout
    attempts: int = 32  # maximum number of proposals for one state; they differ by dropout
    share: float = 0.1  # share of the whole budget for tree growth between two states
    pair_limit: Budget | None = None  # limit of this growth in place of the share
    direct: bool = True  # whether a direct motion between two states is tried first
    joins: Search = field(default_factory=BiRRT)  # grows the trees between two states

    def __call__(self, query: Query, observation: Observation) -> Proposal:
        """Roll out until a path is found, the budget is spent or all rollouts have failed.

        An iteration is one tested proposal or one used sample. The detail of the result says how
        the path's states were joined, or why rollouts failed.
        """
        assert observation.cloud is not None
        began = query.deadline.seconds
        # random points; they repeat if the cloud has too few
        order = query.rng.permutation(len(observation.cloud))
        drawn = order[np.arange(self.network.config.n_points) % len(order)]
        code = self.network.encode(observation.cloud[drawn])
        encode_seconds = query.deadline.seconds - began
        run = _Run(self, query, code)
        nearest = query.nearest_goals(len(query.goals) if self.bridged else 1)
        path, failure = None, PlanStatus.ITERATION_LIMIT
        for turn in range(self.rollouts):
            path = run.attempt(query.start, nearest[turn % len(nearest)])
            spent = query.deadline.spent()
            if path is not None or spent is not None:
                failure = spent or failure
                break
        return Proposal(
            replace(query.uniform, name="mpnet, uniform"),
            Timings(encode=encode_seconds, predict=run.predict_seconds),
            run.joined if path is not None else run.failed,
            vertices=run.vertices,
            path=path,
            failure=None if path is not None else failure,
        )


@dataclass(eq=False)
class _Run:
    """State of one call of `MPNetRollouts`."""

    planner: MPNetRollouts
    query: Query
    code: np.ndarray  # (code_dim,), encoded cloud
    predict_seconds: float = 0.0
    vertices: int = 0
    joined: str = ""  # how the states of the last path were joined
    failures: Counter[str] = field(default_factory=Counter)  # number of failed rollouts by reason

    @property
    def failed(self) -> str:
        """Number of failed rollouts with the reasons, as text."""
        failed, tried = self.failures.total(), self.planner.rollouts
        reasons = ", ".join(f"{n} {reason}" for reason, n in sorted(self.failures.items()))
        return f"{'all ' if failed == tried else ''}{failed} of {tried} rollouts failed: {reasons}"

    def attempt(self, start: np.ndarray, goal: np.ndarray) -> JointPath | None:
        """Roll out once from start to goal (n,); return the path, or None."""
        rollout = self._rollout(start, goal)
        path = None if isinstance(rollout, str) else self._path(rollout)
        if path is None:
            failure = rollout if isinstance(rollout, str) else "with a pair not joined"
            if self.query.deadline.spent():
                failure = "cut short by the budget"
            self.failures[failure] += 1
        return path

    def _rollout(self, start: np.ndarray, goal: np.ndarray) -> Rollout | str:
        """Grow both sides in turn until they meet; if that fails, return the reason as text."""
        robot, space = self.query.space.robot, self.query.space
        sides: tuple[list[np.ndarray], list[np.ndarray]] = ([start], [goal])
        latest = [_normalised(robot, start), _normalised(robot, goal)]
        met, joint = False, None
        for turn in range(self.planner.predictions):
            side = turn % 2
            found = self._next_state(latest[side], latest[1 - side])
            if found is None:
                return "without a free state"
            state, proposed = found
            sides[side].append(state)
            latest[side] = _normalised(robot, state) if self.planner.bridged else proposed
            self.vertices += 1
            ends = sides[0][-1], sides[1][-1]
            if self.planner.bridged or line_free(space, *ends):
                joint = direct_motion(space, *ends)
                met = joint is not None or not self.planner.bridged
            if met:
                break
        if not (met or self.planner.bridged):
            return "whose sides did not meet"
        return Rollout(np.array(sides[0] + sides[1][::-1]), len(sides[0]) - 1, met, joint)

    def _next_state(
        self, current: np.ndarray, towards: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray] | None:
        """Return the first proposal that is free of collision after clipping and projection.

        Args:
            current: (n,), normalised to [-1, 1].
            towards: (n,), normalised to [-1, 1].

        Returns:
            The state (n,) [rad or m] and the clipped proposal (n,); None if attempts or budget are
            used up.
        """
        robot = self.query.space.robot
        for _ in range(self.planner.attempts):
            if self.query.deadline.spent():
                return None
            self.query.deadline.count()
            began = time.perf_counter()
            proposed = self.planner.network.propose(current, towards, self.code, self.query.rng)
            clipped = np.clip(proposed, -1.0, 1.0).astype(float)
            q = robot.lower + 0.5 * (clipped + 1.0) * (robot.upper - robot.lower)
            self.predict_seconds += time.perf_counter() - began
            if self.query.space.project(q) and self.query.space.valid(q):
                return q, clipped
        return None

    def _path(self, rollout: Rollout) -> JointPath | None:
        """Join all neighbouring states, directly or by tree growth; None if a pair fails."""
        motions, grown = [], 0
        for i, (a, b) in enumerate(pairwise(rollout.states)):
            if i == rollout.meeting and self.planner.direct:
                motion = rollout.joint
            elif self.planner.direct:
                motion = direct_motion(self.query.space, a, b)
            else:
                motion = None
            if motion is None:
                motion = self._grown(a, b)
                grown += 1
            if motion is None:
                return None
            motions.append(motion.states if i == 0 else motion.states[1:])
        trees = f"{grown} of {len(motions)} pairs joined by tree growth"
        bridge = "" if rollout.met else ", one a bridge between sides that did not meet"
        self.joined = f"{BY_ROLLOUTS} and trees: {trees}{bridge}" if grown else ROLLOUTS_ALONE
        return JointPath(np.concatenate(motions))

    def _grown(self, a: np.ndarray, b: np.ndarray) -> JointPath | None:
        """Find a path from a to b (n,) by tree growth within its share of the budget."""
        if self.query.deadline.spent():
            return None
        limit = self.planner.pair_limit
        if limit is None:
            part = self.query.deadline.rest(self.planner.share)
        else:
            part = self.query.deadline.rest().within(limit)
        query = self.query.limited(part, start=a, goals=b[None])
        result = self.planner.joins.search(query, query.uniform)
        self.vertices += result.vertices
        return result.path


def line_free(space: ConstrainedSpace, a: np.ndarray, b: np.ndarray, states: int = 100) -> bool:
    """Whether the straight joint line between two states is free of collision.

    The constraint is not checked.

    Args:
        space: checks collision.
        a: (n,) [rad or m].
        b: (n,) [rad or m].
        states: number of evenly spaced states that are checked (published: 100).
    """
    return all(space.valid(q) for q in np.linspace(a, b, states))


def _normalised(robot: Robot, q: np.ndarray) -> np.ndarray:
    """Normalise a configuration q (n,) [rad or m] to [-1, 1]."""
    return 2.0 * (q - robot.lower) / (robot.upper - robot.lower) - 1.0
