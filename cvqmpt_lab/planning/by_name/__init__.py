"""Every planner, declared once: what runs, suites, tables, pages, figures and helps know of it.

A declaration imports no planner: its `make` does when the planner is used. A file in this folder
with a `PLANNER` adds one.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from typing import Any, Literal

from cvqmpt_lab.base.errors import unique
from cvqmpt_lab.base.files import Imported, Modules


@dataclass(frozen=True)
class Planner:
    """Declaration of a planner."""

    name: str
    description: str  # in the table of docs/method.md
    make: Callable[[str], Any]  # returns the `search.method.Method` of the name
    # problems of the suite place-task whose runs `cvqmpt check-tables` compares
    cases: tuple[int, ...] = ()
    # quick: in suites by default; slow: most of its time goes into runs that time out, so suites
    # name it apart; seldom: in few suites; in-ompl: in the suites of the paper's experiment;
    # unshipped: its weights are not in this package; control: differs from a planner in one part,
    # to measure what that part contributes
    group: Literal["quick", "slow", "seldom", "in-ompl", "unshipped", "control"] = "quick"
    colour: str = ""  # in figures; empty: one that follows from the name


def _learned(function: str, **options: Any) -> Callable[[str], Any]:
    return partial(Imported(f"cvqmpt_lab.vqmpt.learned_planners:{function}"), **options)


def _control(name: str, description: str) -> Planner:
    make = Imported("cvqmpt_lab.benchmarks.ablations:control")
    return Planner(name, description, make, group="control")


def _ours(function: str, **options: Any) -> Callable[[str], Any]:
    return partial(Imported(f"cvqmpt_lab.planning.planners:{function}"), **options)


SHIPPED = (
    Planner(
        "birrt",
        "Algorithm 3 with uniform samples and extensions of at most 1 rad",
        _ours("trees"),
        (2, 5, 8),
        colour="#70757d",
    ),
    Planner(
        "birrt-printed",
        "Algorithm 3 with uniform samples and extensions without a limit, as in the paper",
        _ours("trees", reach=float("inf")),
        (2,),
        colour="#b3a58f",
    ),
    Planner(
        "cells",
        "two trees that grow by short steps from rarely chosen cells of the rows that the "
        "constraint leaves free, for narrow passages",
        _ours("cells"),
        (2, 5),
        colour="#2f6f73",
    ),
    Planner(
        "ompl-projected",
        "OMPL's RRTConnect on a projected space: the paper's CBiRRT",
        _ours("ompl", manifold="projected"),
        (2, 5),
        colour="#8c6d1f",
    ),
    Planner(
        "ompl-uniform",
        "the search of `ompl-cvq` with uniform samples",
        _ours("ompl_uniform"),
        (2,),
        "in-ompl",
        "#5c4a2a",
    ),
    Planner(
        "atlas-rrt",
        "OMPL's RRTConnect on an atlas space",
        _ours("ompl", manifold="atlas"),
        (8, 11),
        "slow",
        "#3aa6a6",
    ),
    Planner(
        "tb-rrt",
        "OMPL's RRTConnect on a tangent-bundle space",
        _ours("ompl", manifold="tangent-bundle"),
        (8, 11),
        "slow",
        "#7cae3c",
    ),
    Planner(
        "ompl-bkpiece",
        "OMPL's BKPIECE1 on the projected space, over the rows that the constraint leaves free",
        _ours("ompl", manifold="projected", kpiece=True),
        (10,),
        "seldom",
        "#c9b458",
    ),
    Planner(
        "roadmap",
        "for any robot, without training: Algorithm 3 and a roadmap of 1 024 configurations in "
        "turns, then cells",
        _ours("spread_roadmap"),
        (2, 5, 8),
        colour="#1b3fa0",
    ),
    Planner(
        "mpnet",
        "the paper's MPNet (w/ proj): projected rollouts from start and nearest goal, which must "
        "meet; tree growth connects their states",
        _learned("mpnet_planner"),
        (2, 5),
        colour="#8a4fa3",
    ),
    Planner(
        "ompl-mpnet",
        "the paper's MPNet as published: OMPL's RRTConnect joins each pair of neighbouring states",
        _learned("mpnet_planner", in_ompl=True),
        (5,),
        "in-ompl",
        "#5b3f8c",
    ),
    Planner(
        "mpnet-bridged",
        "`mpnet` with all goals in turn; rollouts that do not meet are connected, too",
        _learned("mpnet_planner", bridged=True),
        (2, 5),
        colour="#d987c0",
    ),
    Planner(
        "cvq-mpt",
        "the paper's method with this project's transformer: Algorithm 3 without a limit of "
        "extensions, goals one after the other with equal shares of the budget",
        _learned("named_sampler"),
        (2, 5),
        colour="#e58a2f",
    ),
    Planner(
        "opt-cvq-mpt",
        "`cvq-mpt` with codes moved towards the constraint by Algorithm 2 first",
        _learned("named_sampler"),
        (2, 5),
        colour="#c8452d",
    ),
    Planner(
        "cvq-published",
        "`cvq-mpt` with the authors' architecture; for own or imported weights (`--model DIR`)",
        _learned("named_sampler"),
        group="unshipped",
    ),
    Planner(
        "ompl-cvq",
        "the paper's experiment: the sampler of `cvq-mpt` in OMPL's RRTConnect on a projected "
        "space, one goal after the other",
        _learned("named_sampler"),
        (2,),
        "in-ompl",
        "#f0b95b",
    ),
    Planner(
        "ompl-opt-cvq",
        "the paper's experiment: the sampler of `opt-cvq-mpt` in the search of `ompl-cvq`",
        _learned("named_sampler"),
        (2,),
        "in-ompl",
        "#a8201a",
    ),
    Planner(
        "ompl-cvq-dense",
        "`ompl-cvq` with a code for every waypoint, 0.13 rad apart, of the predicted sequence",
        _learned("named_sampler"),
        (2,),
        "in-ompl",
        "#d8c27a",
    ),
    Planner(
        "ompl-opt-cvq-dense",
        "`ompl-opt-cvq` with the codes of `ompl-cvq-dense`",
        _learned("named_sampler"),
        (2,),
        "in-ompl",
        "#7a4a4a",
    ),
    Planner(
        "ompl-cvq-tuned",
        "`ompl-opt-cvq-dense` with goals in order of predicted cost, tried again with longer "
        "limits; each tree samples its half of the sequence, the clearest of eight samples, drawn "
        "again if it collides",
        _learned("named_sampler"),
        (5,),
        "in-ompl",
        "#3b0f22",
    ),
    Planner(
        "ompl-cvq-published",
        "`ompl-cvq` with the authors' architecture, for own or imported weights",
        _learned("named_sampler"),
        group="unshipped",
    ),
    Planner(
        "cvq-wide",
        "Algorithm 3 with wide Gaussians around projected codes that the transformer predicts, "
        "extensions of at most 1 rad",
        _learned("named_sampler"),
        (5,),
        colour="#2e8b57",
    ),
    Planner(
        "cvq-tuned",
        "Gaussians of 0.9 rad along all predicted sequences, 15 % uniform samples, extensions of "
        "at most 1 rad, colliding samples replaced",
        _learned("named_sampler"),
        (2, 5),
        colour="#6b1d3c",
    ),
    Planner(
        "roadmap-cvq",
        "`roadmap` with the dictionary's configurations as nodes",
        _learned("on_dictionary"),
        (2, 5, 8),
        colour="#4f9fd9",
    ),
    _control("guided-birrt", "`birrt` with Gaussians around a path that ignores the constraint"),
    # three sets of random nodes show how much results vary between roadmaps
    *(
        _control(f"roadmap-uniform-{draw}", "`roadmap` with random configurations as nodes")
        for draw in range(3)
    ),
    _control("roadmap-wrong-scene", "`roadmap-cvq` with edge costs in another scene"),
    _control("roadmap-no-scene", "`roadmap-cvq` whose edges cost their length"),
    _control("roadmap-true-edges", "`roadmap-cvq` with blocked edges known at no cost"),
)


@cache
def declared(*groups: str) -> dict[str, Planner]:
    """Return the planners of groups by name; without any, those of suites, slow ones included."""
    every = (*SHIPPED, *(module.PLANNER for module in Modules("planning/by_name").values()))
    unique((planner.name for planner in every), "planners")
    groups = groups or ("quick", "slow", "seldom", "in-ompl")
    return {planner.name: planner for planner in every if planner.group in groups}
