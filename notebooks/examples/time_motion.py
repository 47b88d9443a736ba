"""Turn a certified path into the fastest motion within the joint limits, as json for ROS."""

from pathlib import Path

from cvqmpt_lab import (
    Budget,
    TimingSettings,
    save_trajectory,
    solve_with_margin,
    suite_named,
    time_path,
)

problem = suite_named("place-task").solvable(7)
solution, margin = solve_with_margin(problem, "roadmap", Budget(seconds=10.0), seed=0)
states = solution.path.states
motion = time_path(states, problem.robot.joint_limits, TimingSettings(speed=0.2))
save_trajectory(motion, Path("motion.json"))
print(f"{motion.duration:.1f} s, at most {motion.deviation:.1e} rad off the path; margin {margin}")
