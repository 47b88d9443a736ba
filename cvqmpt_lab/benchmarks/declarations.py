"""Every suite, declared once: its problems, planners, amounts and table, see `suite_parts`.

The suites of the kitchen stand here, others in `paper_suites` and `scene_suites`. A file
NAME_suite.py with a `SUITE` adds one.
"""

from collections.abc import Mapping
from functools import partial
from itertools import product

from cvqmpt_lab.base.files import Imported, Modules
from cvqmpt_lab.benchmarks.paper_suites import paper_suites
from cvqmpt_lab.benchmarks.scene_suites import scene_suites, two_arm_suites
from cvqmpt_lab.benchmarks.suite_parts import (
    Amount,
    PlannerGroups,
    Suite,
    problem_maker,
    table_maker,
)
from cvqmpt_lab.vqmpt.sampler_choice import CHOICES, PREFIX


def _place_suites() -> list[Suite]:
    """Suites of the place task: a can is carried upright from the counter to the shelf."""
    place_problem = problem_maker("place_task:place_problem")
    first_goal = problem_maker("place_task:single_goal_problem")
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
                Amount(problems=60, planners=PlannerGroups.slow, late=True),
                Amount(problems=30, planners=("ompl-bkpiece",), late=True),
            ),
            paper=paper,
        ),
        Suite(
            name="place-task-with-can",
            title="Place task, the carried can in the way",
            problems=range(150),
            make=problem_maker("place_task:place_problem", with_can=True),
            amounts=(Amount(planners=PlannerGroups.quick),),
            paper=paper,
        ),
        Suite(
            name="place-task-seconds",
            title="Place task in seconds: compiled checks, and the same planners inside OMPL",
            problems=range(6000, 6400),  # those of `place-task-ompl`
            make=place_problem,
            shown_in_hand=can,
            planners=(
                *("ompl-projected", "ompl-uniform", "ompl-cvq", "ompl-opt-cvq"),
                # Algorithm 3 as printed, with uniform samples first
                *("cvq:uniform+goals-apart", "cvq-mpt", "opt-cvq-mpt"),
                *("birrt", "birrt-printed", "roadmap", "roadmap-cvq", "cvq-tuned"),
            ),
            amounts=(Amount(late=True),),
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
            make=problem_maker("place_task:mirrored_problem"),
            shown_in_hand=can,
            planners=(*PlannerGroups.tuned, "cvq-wide", "roadmap"),
            amounts=(Amount(),),
        ),
        # the last five planners are entry points of `cvqmpt_lab.features.peers`, with an extra
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
            table=table_maker(
                "layouts:peer_table",
                notes=(
                    "Roboplan's extension length, and HPP's validation and shortcuts, were chosen "
                    "on problems that are not in this table.",
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
        table=table_maker("factorial_table:factorial_table"),
    )
    return [
        factorial(
            name="factorial",
            title="Factorial: every choice of a learned sampler, place task",
            problems=range(60),
            make=problem_maker("place_task:place_problem"),
            amounts=(Amount(problems=30, cutoff=3.0),),
        ),
        factorial(
            name="factorial-constraints",
            title="Factorial: every choice of a learned sampler, eight kinds of constraints",
            problems=range(80),
            make=problem_maker("family_task:constraint_problem"),
            amounts=(Amount(problems=24, cutoff=2.0),),
        ),
    ]


def _executed_suite() -> Suite:
    """Suite of executions; its extra measures are those of `cvqmpt_lab.experiments.executed`."""
    return Suite(
        name="executed",
        title="Executed in simulation",
        problems=range(120),
        make=problem_maker("place_task:executed_problem"),
        planners=("birrt",),
        table=table_maker(
            "layouts:group_table",
            what="kind",
            notes=(
                "50 motions of the place task with the can, and ten multi-sequence tasks. Each is "
                "planned with a margin, once a seed, for a speed that is a fraction of the joint "
                "limits. It is executed by the controller computed-torque, which knows the load, "
                "and by computed-torque-unknown-load, which does not.",
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
                *("runs", "executed", "undecided", "off_path_median", "off_path_most"),
                *("tilt_most", "with_contacts", "saturated_most", "drift_most", "placed"),
            ),
        ),
    )


def _task_suites() -> list[Suite]:
    """Suites of the multi-sequence task."""
    few = partial(Amount, cost=100.0, planners=PlannerGroups.paper_alone)
    planned_door = (
        "The paper replays a stored motion to open the door. Here this motion is planned, and so "
        "is the straight motion to the can. The first table leaves out their times, the second "
        "contains them."
    )
    same_pose = "The final pose of the can is that of the published code in all tasks."
    multi_sequence = partial(
        Suite,
        make=problem_maker("place_task:multi_sequence_task"),
        of_tasks=True,
        new_scenes=False,
        settings={"speed": 0.1},  # `robot.SLOW_SPEED`, share of the joint limits
        table=table_maker(
            "multi_sequence_table:task_table",
            notes=(
                planned_door,
                "The final pose of the can is drawn for every task; in the published code it is "
                "the same in all tasks, by a side effect.",
            ),
        ),
        paper=("multi_sequence.csv", "Multi-sequence task"),
    )
    return [
        multi_sequence(
            name="multi-sequence",
            title="Multi-sequence task: open the shelf, take the can, stand it on the counter",
            problems=range(66),
            amounts=(
                Amount(planners=PlannerGroups.quick),
                Amount(problems=8, planners=PlannerGroups.slow, late=True),
            ),
        ),
        multi_sequence(
            name="multi-sequence-published",
            title="Multi-sequence task inside OMPL as the published code has it",
            # nobody has looked at them; enough to decide a tenth less time, by tasks 2000 to 2035
            problems=range(3000, 3300),
            make=problem_maker("published:published_phases"),
            # the paper has no MPNet here
            planners=(
                *("ompl-projected", *PlannerGroups.slow),
                *("ompl-uniform", "ompl-cvq", "ompl-opt-cvq"),
            ),
            cost=100.0,
            table=table_maker(
                "multi_sequence_table:task_table",
                priced=True,
                notes=(
                    "Each phase is a problem of its own, planned whether others fail or not. Tasks "
                    "differ in the start of the first phase, in the goals of the last one, and in "
                    "random numbers; all else is the same in all tasks, as in the published code. "
                    "The door's motion and the grasp of the can are ours, because the published "
                    "ones are in no repository.",
                    "Planning contains OMPL's simplification in place of ours, and execution is "
                    "along its path, as published; the certificate is that of our path. Without a "
                    "constraint, motions have no longest length, and OMPL checks them every 0.13 "
                    "rad; a found path is checked finely.",
                    same_pose,
                ),
            ),
            amounts=(
                few(late=True),
                few(profile="paper", problems=10),
                few(profile="small", problems=5),
            ),
        ),
        multi_sequence(
            name="multi-sequence-planned-door",
            title="Multi-sequence task inside OMPL, the door opened by the planners",
            problems=range(3300, 3366),  # nobody has looked at them
            make=problem_maker("published:planned_door_task"),
            planners=("ompl-projected", *PlannerGroups.slow, *PlannerGroups.in_ompl),
            cost=100.0,
            table=table_maker(
                "multi_sequence_table:task_table", priced=True, notes=(planned_door, same_pose)
            ),
            # the others fail in the approach
            amounts=(few(late=True),),
        ),
    ]


SUITES: Mapping[str, Suite] = {
    suite.name: suite
    for suite in (
        *_place_suites(),
        *paper_suites(),
        *scene_suites(),
        *_factorial_suites(),
        *two_arm_suites(),
        *_task_suites(),
        _executed_suite(),
        *(module.SUITE for module in Modules("benchmarks", "_suite").values()),
    )
}
