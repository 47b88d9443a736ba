"""Turn a certified path into the fastest motion within the joint limits, as json for ROS."""

from pathlib import Path

from cvqmpt_lab import (
    Budget,
    Request,
    TimingSettings,
    plan,
    save_trajectory,
    suite_named,
)

problem = suite_named("place-task").solvable(7)
timing = TimingSettings(speed=0.2)
planned = plan(problem, Request("roadmap", Budget(seconds=10.0), timing=timing))
motion = planned.motion
save_trajectory(motion, Path("motion.json"))
apart = f"at most {motion.deviation:.1e} rad off the path"
print(f"{motion.duration:.1f} s, {apart}; margin {planned.margin}")
