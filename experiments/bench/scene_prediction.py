"""What the scene transformer costs: a new cloud, and sequences to goals in a known one."""

from collections.abc import Iterator

import numpy as np

from cvqmpt_lab.robot.loading import panda
from cvqmpt_lab.scene.families import FAMILIES, family_scene
from cvqmpt_lab.vqmpt.scene_predictor import POINTS, SceneTransformerPredictor
from cvqmpt_lab.vqmpt.stages import observer
from cvqmpt_lab.vqmpt.weights import load_vq_mpt
from experiments.bench.measurement import CpuTimes, Measurement

FIRST_SCENE = 710_000  # seeds of scenes that nothing else uses
GOALS = (3, 20)  # to which sequences are predicted at once
BEAMS, REPEATS = 3, 5


def bench_transformer(scenes: int, model: str | None) -> Iterator[Measurement]:
    """Processor time of one thread, in scenes of all families in turn; model:
    name or folder of weights.
    """
    robot = panda()
    predictor, clock = SceneTransformerPredictor(load_vq_mpt(robot, model), robot), CpuTimes()
    for number in range(scenes):
        rng = np.random.default_rng(number)
        cloud = observer()(
            family_scene(list(FAMILIES)[number % len(FAMILIES)], FIRST_SCENE + number)
        )
        start, *goals = robot.random_configurations(rng, 1 + max(GOALS))
        for _ in range(REPEATS):
            scene = clock(f"a new cloud of {POINTS} points", predictor.encode, cloud, False)
            for count in GOALS:
                some, name = np.array(goals[:count]), f"to {count} goals"
                clock(
                    f"sequences {name}, {BEAMS} beams",
                    predictor.sequences,
                    scene,
                    start,
                    some,
                    BEAMS,
                )
                clock(f"ranking {name}", predictor.rank, scene, start, some)
    yield from clock.measurements()
