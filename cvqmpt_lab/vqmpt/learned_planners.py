"""The learned planners, which `planners` declares.

Some need weights of the authors' architecture, which are imported or trained. `planner_of` makes a
planner of any product of choices, such as ``cvq:random+wide+projected``. Imports within functions
need safetensors, which takes time.
"""

from functools import partial

from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.scene.scene import Scene
from cvqmpt_lab.search.method import Method
from cvqmpt_lab.search.planner_interface import Stages
from cvqmpt_lab.search.portfolio import roadmap_planner
from cvqmpt_lab.search.roadmap import Roadmap
from cvqmpt_lab.vqmpt.sampler_choice import NAMED_SAMPLERS, PREFIX, SamplerChoice


def misfit(kind: str, problem: PlanningProblem, model: str) -> str:
    """Return the reason why weights do not fit a problem's robot, or "".

    Args:
        kind: kind of the weights, a key of `weights.SHIPPED`.
        problem: the problem.
        model: name or folder of the weights.
    """
    from cvqmpt_lab.vqmpt import weights

    return weights.incompatibility(model, kind, weights.robot_signature(problem.robot))


def mpnet_planner(name: str, bridged: bool = False, in_ompl: bool = False) -> Method:
    """Return MPNet; see `learned_sampler.mpnet`."""

    def build(problem: PlanningProblem, model: str) -> Stages:
        from cvqmpt_lab.vqmpt.learned_sampler import mpnet

        return mpnet(problem.robot, model, bridged, in_ompl)

    return Method(name, build, "mpnet", partial(misfit, "mpnet"), grows=False)


def product(name: str, choice: SamplerChoice, other_scene: Scene | None = None) -> Method:
    """Return a planner with a learned sampler and the paper's search.

    Args:
        name: name of the planner.
        choice: parts of the learned sampler.
        other_scene: scene whose cloud the network gets if the choice is ``other-cloud``.
    """

    def build(problem: PlanningProblem, model: str) -> Stages:
        from cvqmpt_lab.vqmpt.learned_sampler import learned

        return learned(problem.robot, model, name, choice, other_scene)

    return Method(name, build, "vq_mpt", partial(misfit, "vq_mpt"), sampler=choice)


def dictionary_roadmap(problem: PlanningProblem, model: str) -> Roadmap:
    """Return the roadmap of the dictionary's nodes that are free of self-collision."""
    from cvqmpt_lab.vqmpt.learned_sampler import free_dictionary

    return free_dictionary(model, problem.robot, problem.carried)


def planner_of(name: str) -> Method | None:
    """Return the planner of a product's name, such as ``cvq:random+wide``; None for other names."""
    if not name.startswith(PREFIX):
        return None
    choice = SamplerChoice.of(name.removeprefix(PREFIX))
    if choice.cloud == "other-cloud":  # needs another scene, which `benchmarks.ablations` has
        return None
    return product(name, choice)


on_dictionary = partial(
    roadmap_planner, roadmap=dictionary_roadmap, weights="vq_mpt", misfit=partial(misfit, "vq_mpt")
)


def named_sampler(name: str) -> Method:
    """Return the planner of a name in `NAMED_SAMPLERS`."""
    return product(name, NAMED_SAMPLERS[name])
