"""The multi-sequence task: open the shelf's door, take a can out, stand it upright on the counter.

As published, task k starts free of collision (seed 100 + k), the door is opened to -0.45 pi, the
can is carried to within a decimetre of (0.25, -0.45), and two obstacles stand on the counter.
Unlike published, opening the door is planned, not replayed; the can's final pose is drawn for every
task; the can is an obstacle until it is grasped, then it collides like the robot, and is put down
LIFT above the published height, which is 1.5 mm inside the counter's top.
"""

from functools import lru_cache

import numpy as np

from cvqmpt_lab.benchmarks.door_task import GRIP, OPEN, PADS, TURN, bar_pose, handle_region
from cvqmpt_lab.benchmarks.objects import CAN, CRACKER_BOX, MUSTARD_BOTTLE
from cvqmpt_lab.benchmarks.place_task import DOOR, LIFT, SHELF_LINK, grasp_region
from cvqmpt_lab.collision.exact import CollisionChecker
from cvqmpt_lab.constraints.inverse_kinematics import SAMPLE_MARGIN
from cvqmpt_lab.constraints.task_space_region import TaskSpaceRegion, upright_box
from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.poses import pose
from cvqmpt_lab.results.row import PAPER_PHASES
from cvqmpt_lab.robot.load import FINGER_OPENING, robot_from_source
from cvqmpt_lab.scene.kitchen import kitchen
from cvqmpt_lab.scene.scene import Scene, SceneObject
from cvqmpt_lab.tasks.task import Grasp, Hold, Move, Release, Slide, Task, Turn

CAN_NAME = "can"


@lru_cache(maxsize=1)
def world() -> Scene:
    """The kitchen, door closed, with the two obstacles on the counter and the can on the shelf."""
    centre = np.add(SHELF_LINK, CAN.com) + (0.0, 0.0, CAN.shape_centre[2] - CAN.com[2])
    return kitchen().with_objects(
        CRACKER_BOX.at_com("cracker_box", (0.600, -0.623, 0.287), -np.pi / 4),
        MUSTARD_BOTTLE.at_com("mustard_bottle", (0.550, -0.303, 0.262)),
        # its axis through its centre of mass
        SceneObject(CAN_NAME, CAN.shape, pose(centre), mass=CAN.mass),
    )


def multi_sequence_task(number: int) -> Task:
    """Task `number`; 0 to 9 are the paper's, others follow the same distribution."""
    if number < 0:
        raise InvalidInputError(
            f"multi-sequence task {number}: give 0 or more, the paper's are 0 to 9"
        )
    robot = robot_from_source({"name": "panda"})
    rng = np.random.default_rng(100 + number)
    checker = CollisionChecker(robot, world(), margin=SAMPLE_MARGIN)
    start = robot.random_configurations(rng, 1)[0]
    while checker.in_collision(start):
        start = robot.random_configurations(rng, 1)[0]
    # where the can's centre of mass goes: within a square of a decimetre
    target = np.array((0.25, -0.45, 0.271 + LIFT))
    target[:2] += 0.1 * rng.uniform(size=2)
    grasp = grasp_region(np.add(SHELF_LINK, CAN.com))
    approach = 0.08  # [m] straight to the can: depth of the fingers, and 3 mm of play
    pregrasp = TaskSpaceRegion(grasp.T0_w, grasp.Tw_e @ pose((0.0, 0.0, -approach)), grasp.Bw)
    reach_handle, reach_can, carry = PAPER_PHASES
    can_grip = CAN.shape.radius  # type: ignore[union-attr]
    open_fingers, grip = {"finger_opening": FINGER_OPENING}, {"finger_opening": GRIP}
    return Task(
        name=str(number),
        robot=robot.source,
        scene=world(),
        start=start,
        phases=(
            Move(reach_handle, handle_region(turn=0.0).at(bar_pose(0.0))),
            Hold("hold-handle", DOOR, grip, tuple((pad, handle_region().base) for pad in PADS)),
            Turn("open-door", OPEN, handle_region(), handle_region(turn=TURN)),
            Release("let-go", open_fingers),
            Move(reach_can, pregrasp),
            Slide("approach", approach),
            Grasp("grasp-can", CAN_NAME, {"finger_opening": can_grip}),
            Move(carry, grasp_region(target), (upright_box(),)),
            Release("put-down", open_fingers),
        ),
    )
