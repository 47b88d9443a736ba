"""Every suite, declared once: its problems, planners, amounts and table, see `suite_parts`."""

from collections.abc import Callable, Mapping
from functools import partial
from itertools import product
from typing import Any

from cvqmpt_lab.benchmarks.suite_parts import Amount, Imported, PlannerGroups, Suite
from cvqmpt_lab.vqmpt.sampler_choice import CHOICES, PREFIX


def _problem(name: str, **options: Any) -> Callable[[Any], Any]:
    """Return a function MODULE:FUNCTION of this folder that makes the problem of an index."""
    function = Imported(f"cvqmpt_lab.benchmarks.{name}")
    return partial(function, **options) if options else function


def _table(name: str, **options: Any) -> Callable[..., Any]:
    """Return a function MODULE:FUNCTION of the tables, with options."""
    return partial(Imported(f"cvqmpt_lab.paper_tables.{name}"), **options)


def _family(name: str, what: str, *more: Amount) -> Suite:
    """Suite of 50 problems in held-out scenes of a family."""
    planners = (
        *("birrt", "birrt-printed", "cvq-mpt", "opt-cvq-mpt", "cvq-wide", "cvq-tuned"),
        *("roadmap", "roadmap-cvq", *PlannerGroups.without_learning),
    )
    return Suite(
        name=f"family-{name}",
        title=f"Held-out {what}, hand upright",
        problems=range(50),
        make=_problem("family_task:held_out_problem", family=name),
        amounts=(Amount(cutoff=3.0, planners=planners), *more),
    )


def _place_suites() -> list[Suite]:
    """Suites of the place task: a can is carried upright from the counter to the shelf."""
    place_problem = _problem("place_task:place_problem")
    first_goal = _problem("place_task:single_goal_problem")
    can = Imported("cvqmpt_lab.benchmarks.place_task:carried_can")
    paper = ("place_task.csv", "Place Task")
    controlled = (
        *("birrt", "cvq-mpt", "opt-cvq-mpt", "roadmap-cvq", "guided-birrt"),
        PlannerGroups.without_learning[0],
        # along the best of six solved paths: a bound on what a predictor can reach
        "cvq:solved+along+free-draws+reach=1+std=0.4",
        *PlannerGroups.without_learning[1:],
        *("roadmap-wrong-scene", "roadmap-no-scene", "roadmap-true-edges"),
    )
    return [
        Suite(
            name="place-task",
            title="Place task: carry a can upright to the shelf",
            problems=range(150),
            make=place_problem,
            shown_in_hand=can,
            amounts=(
                Amount(seeds=5, planners=PlannerGroups.quick),
                Amount(problems=60, cutoff=5.0, planners=controlled, folder="controls"),
                Amount(planners=PlannerGroups.slow, late=True),
                Amount(problems=30, planners=("ompl-bkpiece",), late=True),
                Amount(profile="small", problems=10, cutoff=2.0),
                Amount(
                    profile="small",
                    problems=3,
                    cutoff=2.0,
                    planners=controlled,
                    folder="controls",
                ),
            ),
            paper=paper,
        ),
        Suite(
            name="place-task-more",
            title="Place task, 2000 more problems for claims that the first ones left open",
            problems=range(2000, 4000),  # no tuning used them
            make=place_problem,
            shown_in_hand=can,
            planners=(*PlannerGroups.claimed, "mpnet"),
            amounts=(Amount(late=True),),
            paper=paper,
        ),
        Suite(
            name="place-task-with-can",
            title="Place task, the carried can in the way",
            problems=range(150),
            make=_problem("place_task:place_problem", with_can=True),
            amounts=(
                Amount(planners=PlannerGroups.quick),
                Amount(profile="small", problems=5, cutoff=2.0, planners=PlannerGroups.few),
            ),
            paper=paper,
        ),
        Suite(
            name="place-task-single-goal",
            title="Place task, a single goal instead of twenty",
            problems=range(30),
            make=first_goal,
            shown_in_hand=can,
            amounts=(Amount(cutoff=5.0, planners=PlannerGroups.quick),),
        ),
        Suite(
            name="place-task-mirrored",
            title="Place task in a kitchen that no tuning has seen",
            problems=range(60),
            make=_problem("place_task:mirrored_problem"),
            shown_in_hand=can,
            planners=(*PlannerGroups.tuned, "cvq-wide", "roadmap"),
            amounts=(Amount(),),
        ),
        # the last five planners are entry points of `cvqmpt_lab.experiments.peers`, with an extra
        Suite(
            name="peers",
            title="Planners of others, place task with a single goal",
            problems=range(30),
            make=first_goal,
            shown_in_hand=can,
            new_scenes=False,
            planners=(
                *("birrt", "roadmap", "roadmap-cvq"),
                *("roboplan", "roboplan-star", "sscbirrt", "hpp", "drake"),
            ),
            table=_table(
                "layouts:peer_table",
                notes=(
                    "Roboplan's extension length, and HPP's validation and shortcuts, were chosen "
                    "on problems that are not in this table.",
                ),
            ),
        ),
    ]


def _ompl_suites() -> list[Suite]:
    """Suites of the paper's experiment: all planners inside OMPL, limits in the paper's seconds."""
    samplers = tuple(name for name in PlannerGroups.in_ompl if name != "ompl-mpnet")
    experiment = partial(
        Suite,
        make=_problem("place_task:place_problem"),
        shown_in_hand=Imported("cvqmpt_lab.benchmarks.place_task:carried_can"),
        planners=("ompl-projected", *PlannerGroups.slow, *PlannerGroups.in_ompl),
        cost=100.0,
        simplified_by_ompl=True,
        table=Imported("cvqmpt_lab.paper_tables.ompl_table:ompl_table"),
        paper=("place_task.csv", "Place Task"),
    )
    return [
        experiment(
            name="place-task-ompl",
            title="Place task inside OMPL: the paper's experiment, in its seconds",
            problems=range(5000, 5400),  # nobody has looked at them, see docs/judgement.md
            amounts=(Amount(cost=100.0),),
        ),
        experiment(
            name="place-task-published",
            title="The same as the published code has it: from the shelf to the counter",
            problems=range(5400, 5550),
            make=_problem("place_task:published_problem"),
            amounts=(Amount(cost=100.0, late=True),),
        ),
        experiment(
            name="place-task-ompl-tuning",
            title="The same on problems that settings were chosen on",
            problems=range(1000, 1100),
            amounts=(
                Amount(
                    profile="small",
                    problems=20,
                    cost=100.0,
                    planners=("ompl-projected", *samplers),
                ),
            ),
        ),
    ]


def _product_planners() -> tuple[str, ...]:
    """Return the learned samplers ``cvq:PREDICTOR+GAUSSIANS+...`` of all compared products."""
    gaussians = ("decoded", "wide")
    updates = ("none", "algorithm-2", "projected")
    other_clouds = CHOICES["cloud"][1:]
    uniform_share = "uniform=0.15"  # the share that wide Gaussians have, for decoded ones
    merged = (
        *product(("transformer", "random", "oracle"), gaussians, updates),
        *product(("transformer",), gaussians, updates, other_clouds),
        *product(("transformer", "random"), ("decoded",), updates, (uniform_share,)),
        ("transformer", "wide", "projected", "all-beams"),
    )
    predictors = ("transformer", "transformer-lines", "nearest-lines", "solved")
    sequences = (
        ("uniform",),
        *product(("transformer", "random"), gaussians, updates[:2]),
        *product(predictors, gaussians, updates[:2], ("every-waypoint",)),
    )
    searches = ((), ("raw-draws",), ("reach=1",), ("raw-draws", "reach=1"))
    searched = ((*words, *search) for words in sequences for search in searches)
    return tuple(dict.fromkeys(PREFIX + "+".join(words) for words in (*merged, *searched)))


def _factorial_suites() -> list[Suite]:
    """Suites that compare all products of the choices of a learned sampler."""
    factorial = partial(
        Suite,
        planners=("birrt", *_product_planners()),
        table=_table("factorial_table:factorial_table"),
    )
    return [
        factorial(
            name="factorial",
            title="Factorial: every choice of a learned sampler, place task",
            problems=range(60),
            make=_problem("place_task:place_problem"),
            amounts=(Amount(problems=30, cutoff=3.0),),
        ),
        factorial(
            name="factorial-constraints",
            title="Factorial: every choice of a learned sampler, eight kinds of constraints",
            problems=range(80),
            make=_problem("family_task:constraint_problem"),
            amounts=(Amount(problems=24, cutoff=2.0),),
        ),
    ]


def _scene_suites() -> list[Suite]:
    """Suites of other scenes, constraints and arms."""
    benched = ("birrt", "roadmap", "ompl-projected")  # the last is RRTConnect without constraint
    return [
        _family("cubes-spheres", "scenes of cubes and balls"),
        _family("table", "scenes with a table"),
        _family(
            "shelves",
            "scenes with shelves",
            Amount(profile="small", problems=3, cutoff=2.0, planners=PlannerGroups.few),
        ),
        _family("kitchen-like", "scenes like kitchens"),
        _family("cluttered-table", "tables crowded with slim things"),
        _family("narrow-shelves", "shelves that a hand just fits into"),
        _family("cage", "cages of bars"),
        Suite(
            name="constraints",
            title="Eight kinds of constraints, zero-shot, in held-out scenes",
            problems=range(160),
            make=_problem("family_task:constraint_problem"),
            planners=PlannerGroups.tuned,
            amounts=(Amount(cutoff=5.0), Amount(profile="small", problems=8, cutoff=2.0)),
            table=_table(
                "layouts:group_table",
                what="constraint",
                notes=(
                    "Weights were trained without constraints and without these scenes. All "
                    "planners get the same start and goals.",
                    "{ratios}",
                    "Upright: yaw and position of the hand are free. Fixed orientation: only the "
                    "position is free. Plane, line: the origin of the hand stays on it, its "
                    "orientation is free. Arc: the hand turns a crank. Tray: a tray in the hand is "
                    "level within 0.02 rad. Pouring: a can in the hand is tilted about one axis. "
                    "Door: the hand holds the handle of the shelf's door. Each door is a joint of "
                    "another robot, whose dictionary's roadmap (`roadmap-cvq`) is made in 0.2 s "
                    "before the clock starts.",
                    "It is not known whether each problem has a solution: only without obstacles a "
                    "short search reaches a goal.",
                ),
            ),
        ),
        Suite(
            name="open-door",
            title="Open the shelf's door, the hand on its handle",
            problems=range(10),
            make=_problem("place_task:door_problem"),
            new_scenes=False,
            # no shipped weights fit the arm with the door as its eighth joint
            planners=("birrt", "ompl-projected", *PlannerGroups.slow, "ompl-bkpiece", "roadmap"),
            amounts=(Amount(),),
        ),
        Suite(
            name="passages",
            title="Narrow passages: mazes, a cage and slots",
            problems=range(160),
            make=_problem("passages:passage_problem"),
            planners=("birrt", "cells", "roadmap"),
            amounts=(Amount(cutoff=5.0),),
            table=_table(
                "layouts:group_table",
                what="passage",
                notes=(
                    "The robot is a Panda. Maze: a pen on a plane moves through three corridors of "
                    "the given width. Cage: an upright hand moves into a cage of bars with one gap "
                    "of the given width. Slot: an upright hand reaches through a slot of the given "
                    "width in a wall. These problems were not used for tuning.",
                    "{medians}",
                    "It is not known whether problems that no planner solves have a solution.",
                ),
                columns=(
                    *("solved", "solved_within_1_s", "solved_within_2_s"),
                    *("time_median", "work_median"),
                ),
            ),
        ),
        Suite(
            name="robots",
            title="Nine arms of seven makers in held-out scenes, hand upright",
            problems=range(180),
            make=_problem("family_task:robots_problem"),
            planners=("birrt", "ompl-projected", "roadmap"),
            amounts=(Amount(cutoff=5.0), Amount(profile="small", problems=20, cutoff=2.0)),
            table=_table(
                "layouts:group_table",
                what="arm",
                notes=(
                    "Between two upright hand poses, upright all the way, in held-out scenes of "
                    "four families.",
                    "{ratios}",
                ),
            ),
        ),
        # its problems are fetched: `cvqmpt problems fetch motion-bench`
        Suite(
            name="motion-bench",
            title="MotionBenchMaker: problems of others, without a constraint",
            problems=range(2100),
            make=_problem("motion_bench:motion_bench_problem"),
            planners=benched,
            table=_table("motion_bench_table:motion_bench_table"),
            paper=("motion_bench.csv", "MotionBenchMaker"),
        ),
        Suite(
            name="motion-bench-upright",
            title="MotionBenchMaker: the same with a level hand",
            problems=range(2100),
            make=_problem("motion_bench:level_problem"),
            planners=benched,
            table=_table("motion_bench_table:motion_bench_table"),
        ),
        Suite(
            name="sensor",
            title="Scanned scenes, hand upright: planned in the map, judged in truth",
            problems=range(98),
            make=_problem("sensor_task:sensor_problem"),
            amounts=(
                Amount(seeds=3, planners=PlannerGroups.quick),
                Amount(planners=PlannerGroups.slow, late=True),
                Amount(profile="small", problems=2, cutoff=2.0),
            ),
            table=_table("layouts:place_table", sensed=True),
            paper=("place_task.csv", "Physical robot"),
        ),
        Suite(
            name="unconstrained",
            title="Kitchen and held-out families without a constraint",
            problems=range(120),
            make=_problem("family_task:unconstrained_problem"),
            planners=(
                *("birrt", "birrt-printed", "cvq-mpt"),
                # `cvq-mpt` with all goals at once
                "cvq:transformer+decoded+every-waypoint",
                "cvq-tuned",
            ),
            amounts=(
                Amount(seeds=2, cutoff=3.0),
                Amount(profile="small", problems=8, cutoff=2.0),
            ),
            table=_table(
                "layouts:group_table",
                what="group",
                notes=(
                    "Problems 0 to 59 of the place task (kitchen), and of the seven held-out "
                    "families in turn, without their constraint. opt-cvq-mpt is left out, because "
                    "Algorithm 2 needs a constraint. cvq-mpt tries one goal after the other; birrt "
                    "and birrt-printed search for all goals at once.",
                    "{ratios}",
                ),
            ),
        ),
    ]


def _executed_suite() -> Suite:
    """Suite of executions; its extra measures are those of `cvqmpt_lab.experiments.executed`."""
    return Suite(
        name="executed",
        title="Executed in simulation",
        problems=range(120),
        make=_problem("executed:executed_problem"),
        planners=("birrt",),
        table=_table(
            "layouts:group_table",
            what="kind",
            notes=(
                "50 motions of the place task with the can, and ten multi-sequence tasks. Each is "
                "planned once with a margin, for a speed that is a fraction of the joint limits. "
                "It is executed by the controller computed-torque, which knows the load, and by "
                "computed-torque-unknown-load, which does not.",
                "Executed: execution as planned with two contact times of the simulator. "
                "Undecided: the two contact times give different results. Off path: median "
                "distance of the hand from its planned path; most: largest distance. Tilt: "
                "largest absolute value of a rotation that the constraint bounds. Contacts: "
                "executions in which bodies touch, except at grasp and placing. At limits: "
                "longest time in which a motor is at its effort limit. Drift: largest motion of a "
                "task's load in the hand. Placed: the load is at its goal in the end. The worse "
                "number of the two contact times counts.",
            ),
            columns=(
                *("executed", "undecided", "off_path_median", "off_path_most", "tilt_most"),
                *("with_contacts", "saturated_most", "drift_most", "placed"),
            ),
        ),
    )


def _two_arm_suites() -> list[Suite]:
    """Suites of two arms that carry one thing: a closed chain.

    `roadmap` is birrt on closed chains; learned samplers are for one arm.
    """
    ours = ("birrt", "cells", "roadmap")
    return [
        Suite(
            name="two-arms",
            title="Two arms carry a tray or a box, closed chain, level",
            problems=range(180),
            make=_problem("two_arms:two_arms_problem"),
            planners=(*ours, "ompl-projected"),
            amounts=(
                Amount(planners=ours),
                # most of its runs take the whole cut-off
                Amount(problems=30, planners=("ompl-projected",)),
                Amount(profile="small", problems=4, cutoff=2.0),
            ),
            table=_table(
                "layouts:group_table",
                what="group",
                notes=(
                    "A group is a robot with two arms of 7 joints and a kind of problem. The grasp "
                    "is fixed: the second hand keeps its pose in the frame of the first hand, so "
                    "that the arms form a closed chain. The load is tilted by at most 0.1 rad, and "
                    "may touch only the hands. Starts and goals are found by inverse kinematics of "
                    "both hands.",
                    "{ratios}",
                    "Time: total wall time, with goal inverse kinematics; median with failures as "
                    "infinite.",
                    "For closed chains `roadmap` makes no roadmap; trees and cells search in "
                    "turns. ompl-projected ran only on trays over a table with baxter, where its "
                    "failed runs take most of the time. Learned samplers are left out, because "
                    "weights are for one arm. It is not known whether each problem has a "
                    "solution: start and goal may be in disconnected parts of the closed chain's "
                    "configurations.",
                ),
                columns=(
                    *("time_median", "solved", "work_ratio", "own_time_ratio", "length_ratio"),
                ),
            ),
        ),
        Suite(
            name="peers-two-arms",
            title="Planners of others, a tray in both hands with a single goal",
            problems=range(20),
            make=_problem("two_arms:peers_problem"),
            planners=("birrt", "ompl-projected", "hpp"),
            table=_table(
                "layouts:peer_table",
                notes=(
                    "Advantages of our planners: HPP keeps the tray exactly level, but the problem "
                    "allows 0.1 rad; the time of HPP contains its random shortcuts, which use the "
                    "whole time limit as long as they find shorter paths.",
                    "Ten trays over a table and ten through a window, both arms of a baxter, 14 "
                    "joints. HPP was set up on problems that are not in this table.",
                ),
            ),
        ),
    ]


def _task_suites() -> list[Suite]:
    """Suites of the multi-sequence task."""
    multi_sequence = partial(
        Suite,
        make=_problem("place_task:multi_sequence_task"),
        of_tasks=True,
        new_scenes=False,
        settings={"speed": 0.1},  # `robot.SLOW_SPEED`, share of the joint limits
        table=_table("multi_sequence_table:task_table"),
        paper=("multi_sequence.csv", "Multi-sequence task"),
    )
    return [
        multi_sequence(
            name="multi-sequence",
            title="Multi-sequence task: open the shelf, take the can, stand it on the counter",
            problems=range(66),
            amounts=(
                Amount(planners=PlannerGroups.quick),
                Amount(problems=16, planners=PlannerGroups.slow, late=True),
                Amount(profile="small", problems=2, cutoff=2.0, planners=PlannerGroups.few),
            ),
        ),
        multi_sequence(
            name="multi-sequence-more",
            title="Multi-sequence task, 750 more tasks for claims that the first ones left open",
            problems=range(66, 816),
            planners=PlannerGroups.claimed,
            amounts=(Amount(late=True),),
        ),
        multi_sequence(
            name="multi-sequence-published",
            title="Multi-sequence task inside OMPL, with the published code's fixed configurations",
            problems=range(1000, 1066),  # nobody has looked at them
            make=_problem("place_task:published_task"),
            planners=("ompl-projected", *PlannerGroups.slow, *PlannerGroups.in_ompl),
            cost=100.0,
            amounts=(Amount(cost=100.0, late=True),),
        ),
    ]


SUITES: Mapping[str, Suite] = {
    suite.name: suite
    for suite in (
        *_place_suites(),
        *_ompl_suites(),
        *_scene_suites(),
        *_factorial_suites(),
        *_two_arm_suites(),
        *_task_suites(),
        _executed_suite(),
    )
}
