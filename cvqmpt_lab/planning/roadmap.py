"""A dictionary of configurations searched as a roadmap: paths of its own, or a sampling distribution for birrt."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from cvqmpt_lab.constraints.task_space_region import RegionConstraint
from cvqmpt_lab.distributions import GaussianMixture, SamplingDistribution, Uniform
from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.kernels.search import lazy_roadmap as kernels
from cvqmpt_lab.planning.allowance import Allowance
from cvqmpt_lab.planning.birrt import BiRRT
from cvqmpt_lab.planning.result import Budget, Path, PlanResult, PlanStatus
from cvqmpt_lab.planning.space import ConstrainedSpace
from cvqmpt_lab.problem import PlanningProblem

Gaussians = tuple[np.ndarray, np.ndarray]
LONGEST_PATH = 256  # nodes
QUEUE = 32  # entries a node
SEARCHES_AT_ONCE = 16  # between looks at the clock


@dataclass(frozen=True, eq=False)
class Dictionary:
    """Configurations to plan through.

    Attributes
    ----------
    nodes: (N, n) [rad]. covariances: (N, n, n) of the Gaussians that samples around them come from [rad^2].
    neighbours: (N, k) int32, the nearest nodes of each.
    """

    nodes: np.ndarray
    covariances: np.ndarray
    neighbours: np.ndarray

    @staticmethod
    def of(nodes: np.ndarray, covariances: np.ndarray, neighbours: int = 12) -> "Dictionary":
        """Link each node to its nearest ones; InvalidInputError when there are not more nodes than neighbours."""
        if len(nodes) <= neighbours:
            raise InvalidInputError(f"a dictionary of {len(nodes)} nodes; give more than {neighbours}")
        table = np.empty((len(nodes), neighbours), dtype=np.int32)
        for i, node in enumerate(nodes):
            squares = ((nodes - node) ** 2).sum(axis=1)
            squares[i] = np.inf
            near = np.argpartition(squares, neighbours)[:neighbours]
            table[i] = near[np.argsort(squares[near])]
        return Dictionary(nodes, covariances, table)


@dataclass(frozen=True)
class RoadmapSettings:
    """How the dictionary is searched; defaults were chosen on the tuning environments.

    Attributes
    ----------
    links: nodes that start and goals are linked to. direct: nearest goals that the start is linked to.
    penalty: edges at a node count 1 + penalty * |F| times their length, so that paths prefer the manifold.
    drift: nodes that lie further from the manifold are left out [rad]. searches: at most so many.
    step: longest motion between the states of an edge [rad]; a found path is mended to the space's own.
    detour: how much longer the nodes of a found path count when the next path is searched.
    """

    links: int = 20
    direct: int = 0
    penalty: float = 1.0
    drift: float = 2.5
    searches: int = 100
    step: float = 0.2
    detour: float = 1.5


class RoadmapQuery:
    """One start and its goals (k, n) on a dictionary, in a space; finds one path after another."""

    def __init__(
        self,
        space: ConstrainedSpace,
        dictionary: Dictionary,
        start: np.ndarray,
        goals: np.ndarray,
        settings: RoadmapSettings,
        blocked: np.ndarray | None = None,
    ) -> None:
        """Link start and goals to the dictionary; blocked (N,) bool: nodes to leave out."""
        count = len(dictionary.nodes)
        links = min(settings.links, count)
        total = count + 1 + len(goals)
        neighbours = np.full((count + 1, max(links, dictionary.neighbours.shape[1])), -1, dtype=np.int32)
        neighbours[:count, : dictionary.neighbours.shape[1]] = dictionary.neighbours
        verdict = np.full(total, kernels.UNKNOWN, dtype=np.int8)
        verdict[count:] = kernels.FREE
        if blocked is not None:
            verdict[:count][blocked] = kernels.BLOCKED
        factor = np.ones(total)
        if settings.penalty > 0 and space.dim > 0:
            constraint = RegionConstraint(space.robot, tuple(space.problem.constraint))
            violation = np.linalg.norm(constraint.residual(dictionary.nodes), axis=1)
            factor[:count] += settings.penalty * violation
        self._settings, self._space, self._arrays = settings, space, space.arrays._replace(step=settings.step)
        self._roadmap = kernels.Roadmap(
            nodes=np.concatenate([dictionary.nodes, start[None], goals]),
            neighbours=neighbours,
            edge=np.zeros(neighbours.shape, dtype=np.int8),
            goal_edge=np.zeros((count + 1, len(goals)), dtype=np.int8),
            node=verdict,
            factor=factor,
            to_go=np.empty(total),
            cost=np.empty(total),
            parent=np.empty(total, dtype=np.int32),
            slot=np.empty(total, dtype=np.int32),
            closed=np.empty(total, dtype=np.int8),
            heap=np.empty(QUEUE * total),
            heap_node=np.empty(QUEUE * total, dtype=np.int32),
        )
        self._count, self._left, self.searches = count, settings.searches, 0
        kernels.link_query(self._roadmap, settings.direct, np.empty(links, dtype=np.int32), np.empty(links))

    def next_path(self, allowance: Allowance, check: bool = True) -> tuple[Path | None, np.ndarray]:
        """The shortest path left, on the manifold and free, and the rows of its nodes; None when there is none.

        check: otherwise nothing is projected or checked. Each search counts as an iteration of the allowance.
        """
        path, ends = np.empty(LONGEST_PATH, dtype=np.int64), np.empty(LONGEST_PATH, dtype=np.int64)
        states = np.empty((64 * LONGEST_PATH, self._roadmap.nodes.shape[1]))
        while self._left > 0 and allowance.spent() is None:
            most = min(self._left, SEARCHES_AT_ONCE, allowance.rest().iterations or SEARCHES_AT_ONCE)
            size, length, searched = kernels.search(
                self._arrays, self._roadmap, most, self._settings.drift, check, path, ends, states
            )
            self._space.reraise()
            self._left -= searched
            allowance.count(searched)
            self.searches += searched
            if size != kernels.NO_PATH:
                found, bad = self._space.checked_path(states[:size]) if check else (Path(states[:size]), -1)
                if found is not None:
                    rows = path[1 : length - 1][::-1].copy()
                    self._roadmap.factor[rows] *= self._settings.detour
                    return Path(found.states.copy()), rows
                kernels.block_state(self._roadmap, path, ends, length, bad)
            elif searched < most:
                break
        return None, np.empty(0, dtype=np.int64)

    @property
    def free_nodes(self) -> np.ndarray:
        """Rows (r,) of nodes found free so far."""
        return np.flatnonzero(self._roadmap.node[: self._count] == kernels.FREE)

    def configurations(self, rows: np.ndarray) -> np.ndarray:
        """Where nodes are now (r, n): projected, if they were visited."""
        return self._roadmap.nodes[rows]


@dataclass(frozen=True, eq=False)
class RoadmapSearch:
    """Search the dictionary, projected node by node, for a path; else birrt around the nodes found free.

    Attributes
    ----------
    uniform_share: of the samples that birrt gets when the roadmap holds no path.
    """

    dictionary: Dictionary
    name: str = "roadmap-cvq"
    settings: RoadmapSettings = field(default_factory=RoadmapSettings)
    uniform_share: float = 0.3
    core: BiRRT = field(default_factory=BiRRT)

    def plan(
        self,
        space: ConstrainedSpace,
        start: np.ndarray,
        goals: np.ndarray,
        sampler: SamplingDistribution,
        budget: Budget,
        rng: np.random.Generator,
    ) -> PlanResult:
        """Search a path from start (n,) to any row of goals (k, n); `sampler` gives the uniform share."""
        allowance, before = Allowance(budget, space), space.counters
        query = RoadmapQuery(space, self.dictionary, start, goals, self.settings)
        path, _ = query.next_path(allowance)
        if path is not None:
            return PlanResult(
                PlanStatus.SOLVED,
                path,
                allowance.seconds,
                space.counters_since(before),
                len(query.free_nodes) + 2,
                self.name,
            )
        if (status := allowance.spent()) is not None:
            return allowance.ended(status, self.name)
        mixture = mixture_around(
            query.configurations(query.free_nodes),
            self.dictionary.covariances[query.free_nodes],
            space,
            self.uniform_share,
            f"{self.name}(no path)",
        )
        result = self.core.plan(space, start, goals, mixture, allowance.rest(), rng)
        return replace(
            result,
            seconds=allowance.seconds,
            counters=space.counters_since(before),
            vertices=result.vertices + len(query.free_nodes),
            detail=f"no roadmap path after {query.searches} searches",
        )


@dataclass(frozen=True, eq=False)
class RoadmapGuided:
    """birrt with Gaussians at the nodes of several diverse roadmap paths, searched without the constraint.

    Attributes
    ----------
    check: nodes and edges are checked exactly when a path needs them; otherwise the roadmap is blind.
    paths: number of diverse paths. uniform_share: samples drawn anywhere instead.
    blocked: tells which nodes (N,) to leave out of a problem's roadmap, without checking them.
    move: gives other Gaussians, means (r, n) and covariances (r, n, n), for nodes (r,) of a problem.
    """

    dictionary: Dictionary
    name: str = "roadmap-sampler"
    check: bool = True
    paths: int = 6
    uniform_share: float = 0.15
    blocked: Callable[[PlanningProblem], np.ndarray] | None = None
    move: Callable[[PlanningProblem, np.ndarray, np.random.Generator], Gaussians] | None = None
    settings: RoadmapSettings = field(default_factory=lambda: RoadmapSettings(penalty=0.0))
    core: BiRRT = field(default_factory=BiRRT)

    def plan(
        self,
        space: ConstrainedSpace,
        start: np.ndarray,
        goals: np.ndarray,
        sampler: SamplingDistribution,
        budget: Budget,
        rng: np.random.Generator,
    ) -> PlanResult:
        """Search a path from start (n,) to any row of goals (k, n)."""
        allowance, before = Allowance(budget, space), space.counters
        blocked = self.blocked(space.problem) if self.blocked else None
        query = RoadmapQuery(space.unconstrained(), self.dictionary, start, goals, self.settings, blocked)
        rows = [query.next_path(allowance, self.check)[1] for _ in range(self.paths)]
        if (status := allowance.spent()) is not None:
            return allowance.ended(status, self.name)
        chosen = np.unique(np.concatenate(rows))
        nodes, covariances = query.configurations(chosen), self.dictionary.covariances[chosen]
        if self.move and len(chosen):
            nodes, covariances = self.move(space.problem, chosen, rng)
        mixture = mixture_around(nodes, covariances, space, self.uniform_share, self.name)
        result = self.core.plan(space, start, goals, mixture, allowance.rest(), rng)
        return replace(
            result,
            seconds=allowance.seconds,
            counters=space.counters_since(before),
            detail=f"{len(chosen)} nodes on {sum(len(r) > 0 for r in rows)} roadmap paths",
        )


def mixture_around(
    nodes: np.ndarray, covariances: np.ndarray, space: ConstrainedSpace, uniform_share: float, name: str
) -> SamplingDistribution:
    """Equal Gaussians at nodes (r, n) and a uniform share; uniform alone when there are no nodes."""
    uniform = Uniform(space.robot.lower, space.robot.upper)
    if len(nodes) == 0:
        return replace(uniform, name=f"{name}: uniform")
    weights = np.full(len(nodes), 1.0 / len(nodes))
    return GaussianMixture(nodes, covariances, weights, uniform, uniform_share, name)
