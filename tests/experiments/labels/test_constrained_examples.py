"""Labels on dictionaries that were moved onto random constraints, and the control that learns from them."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from cli.main import main
from cvqmpt_lab.certificate import certify
from cvqmpt_lab.constraints.task_space_region import TOLERANCE, RegionConstraint
from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.methods.loaded import seen_dictionary
from cvqmpt_lab.methods.method import Weights
from cvqmpt_lab.methods.table import planner_named
from cvqmpt_lab.pipeline import solve
from cvqmpt_lab.planning.direct_motion import direct_motion
from cvqmpt_lab.planning.result import Budget, JointPath, PlanStatus
from cvqmpt_lab.robot.loading import panda
from cvqmpt_lab.scene.families import family_scene
from cvqmpt_lab.sensing.virtual import CameraSettings, camera_cloud
from cvqmpt_lab.vqmpt.weights import WEIGHTS, read_model
from experiments.labels.constrained_examples import (
    HELD_OUT,
    constrained_labels,
    random_region,
    searches_of,
)
from experiments.labels.roadmap_data import RoadmapRecipe
from experiments.labels.sequence_examples import steps_along
from experiments.labels.training_data import generate
from experiments.suites.constraint_kinds import KINDS, held_door
from experiments.suites.constraint_task import NAMES
from experiments.suites.place_task import place_problem


def kind_of(region):
    """How many positions and turns a region bounds."""
    rows = region.bounded_rows
    return int((rows < 3).sum()), int((rows >= 3).sum())


def leg(space, a, b):
    """States of the direct motion; edges were checked one way and are walked both ways."""
    there = direct_motion(space, a, b)
    return there.states if there else direct_motion(space, b, a).states[::-1]


def test_kinds_that_are_evaluated_are_never_drawn():
    rng, robot = np.random.default_rng(0), panda()
    q = 0.5 * (robot.lower + robot.upper)
    evaluated = [keep(robot.pose(q), rng).region for keep in KINDS.values()] + [held_door(rng)[1].region]
    assert len(evaluated) == len(NAMES) and {kind_of(region) for region in evaluated} < HELD_OUT.keys()
    drawn = [random_region(robot.pose(q), rng) for _ in range(300)]
    kinds = {kind_of(region) for region in drawn}
    assert kinds == {(p, t) for p in range(4) for t in range(4)} - HELD_OUT.keys() - {(0, 0)}
    for region in drawn:
        assert np.abs(RegionConstraint(robot, (region,)).residual(q)).max() < 1e-9


@pytest.mark.parametrize(("family", "number"), [("shelves", 4), ("cubes-spheres", 6)])
def test_labelled_ways_are_certified_and_every_step_of_theirs_is_learned_from(family, number):
    scene, seen = family_scene(family, number), seen_dictionary(Weights("vq_mpt"), panda())
    cloud = camera_cloud(scene, CameraSettings.like_training(4096), np.random.default_rng(0))
    labels = constrained_labels(seen, scene, cloud, 4, np.random.default_rng(number))
    space = labels.space
    assert kind_of(space.problem.constraint[0]) not in HELD_OUT
    assert len(labels.paths) == 4 and max(len(path.codes) for path in labels.paths) > 1
    for path in labels.paths:
        stops = [path.start, *labels.nodes[path.codes], path.goal]
        assert np.abs(space.problem.manifold.residual(np.array(stops))).max() < TOLERANCE
        assert direct_motion(space, path.start, path.goal) is None
        legs = [leg(space, a, b) for a, b in pairwise(stops)]
        way = JointPath(np.concatenate([legs[0], *(states[1:] for states in legs[1:])]))
        asked = replace(space.problem, start=path.start, goals=path.goal[None])
        assert certify(asked, way).valid
    steps = steps_along(searches_of(seen, cloud, labels))
    assert len(steps.count) == sum(len(path.codes) + 1 for path in labels.paths)


def test_a_scene_without_room_for_the_arm_has_no_labels():
    wall_at_the_base = family_scene("kitchen-like", 10_000_001)
    seen = seen_dictionary(Weights("vq_mpt"), panda())
    labels = constrained_labels(seen, wall_at_the_base, np.zeros((1, 3)), 4, np.random.default_rng(0))
    assert labels is None


def test_a_control_is_trained_from_the_command_line_and_plans(tmp_path, capsys):
    data, out = tmp_path / "labels", tmp_path / "run"
    generate(RoadmapRecipe(3, 4, ("shelves",)), data, 1, ["test"], lambda done, total: None)
    words = ["train", "sequences", "--data", str(data), "--scenes", "2", "--out", str(out)]
    assert main([*words, "--constraints", "2"]) == 0
    told = capsys.readouterr()
    assert "sequences 4/4" in told.err and "learned from " in told.out
    assert read_model(out / "model").metadata["sequences"]["constraints"] == 2
    control = planner_named("route-constraint-trained", str(out))
    assert solve(place_problem(1003), control, Budget(iterations=20_000), 0).plan.status is PlanStatus.SOLVED


def test_a_model_whose_sequences_have_seen_no_constraint_is_refused_in_one_line():
    control = planner_named("cvq-constraint-trained", str(WEIGHTS / "vq_mpt"))
    with pytest.raises(
        InvalidInputError,
        match=r"vq_mpt has no sequences that have seen constraints; train .* --constraints N$",
    ):
        control.stages(place_problem(1003))
