"""The learned planners: they register themselves by the names below, see `planning.planners`.

`PLANNERS` have shipped weights. `UNSHIPPED` need weights of the authors' architecture, which are
imported or trained. `planner_of` makes a planner of any product of choices, such as
``cvq:random+wide+projected``.
"""

from functools import partial

from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.scene.scene import Scene
from cvqmpt_lab.search.method import Method
from cvqmpt_lab.search.planner_interface import Stages
from cvqmpt_lab.search.portfolio import roadmap_planner
from cvqmpt_lab.search.roadmap import Roadmap
from cvqmpt_lab.vqmpt.sampler_choice import NAMED, PREFIX, SamplerChoice

MPNET = "mpnet"  # kind of weights
VQ_MPT = "vq_mpt"  # kind of weights


def misfit(kind: str, problem: PlanningProblem, model: str) -> str:
    """Why weights of a kind, by name or folder, cannot serve a problem's robot; "" if they can."""
    from cvqmpt_lab.vqmpt import weights  # imports safetensors

    return weights.incompatibility(model, kind, weights.robot_signature(problem.robot))


def mpnet_planner(name: str, bridged: bool) -> Method:
    """MPNet; bridged: tree growth connects rollouts that the network does not connect."""

    def build(problem: PlanningProblem, model: str) -> Stages:
        from cvqmpt_lab.vqmpt.learned_sampler import mpnet  # imports safetensors

        return mpnet(problem.robot, model, bridged)

    return Method(name, build, MPNET, partial(misfit, MPNET), grows=False)


def product(name: str, choice: SamplerChoice, other_scene: Scene | None = None) -> Method:
    """A planner with a learned sampler, as `choice` composes it, and the paper's search.

    other_scene: whose cloud the network gets where the choice is ``other-cloud``.
    """

    def build(problem: PlanningProblem, model: str) -> Stages:
        from cvqmpt_lab.vqmpt.learned_sampler import learned  # imports safetensors

        return learned(problem.robot, model, name, choice, other_scene)

    return Method(name, build, VQ_MPT, partial(misfit, VQ_MPT), sampler=choice)


def dictionary_roadmap(problem: PlanningProblem, model: str) -> Roadmap:
    """The roadmap of the dictionary's nodes that are free of self-collision."""
    from cvqmpt_lab.vqmpt.learned_sampler import free_dictionary  # imports safetensors

    return free_dictionary(model, problem.robot, problem.attachments)


def planner_of(name: str) -> Method | None:
    """The planner of a product's name, such as ``cvq:random+wide``; None for other names."""
    if not name.startswith(PREFIX):
        return None
    choice = SamplerChoice.of(name.removeprefix(PREFIX))
    # another scene is not known here: `benchmarks.ablations` has one
    return None if choice.cloud == "other-cloud" else product(name, choice)


on_dictionary = partial(
    roadmap_planner, roadmap=dictionary_roadmap, weights=VQ_MPT, misfit=partial(misfit, VQ_MPT)
)

PLANNERS = (
    mpnet_planner("mpnet", bridged=False),  # the paper's MPNet (w/ proj)
    mpnet_planner("mpnet-bridged", bridged=True),
    *(product(name, choice) for name, choice in NAMED.items() if choice.predictor != "published"),
    on_dictionary("roadmap-cvq"),
)
UNSHIPPED = (product("cvq-published", NAMED["cvq-published"]),)
