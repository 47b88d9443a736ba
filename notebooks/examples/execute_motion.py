"""Execute a certified motion in simulation with a controller that does not know the load."""

from cvqmpt_lab import (
    Budget,
    Request,
    TimingSettings,
    execute_motion,
    plan,
    suite_named,
)

problem = suite_named("place-task-with-can").solvable(3)
shorter = Budget(0.5)  # [s] for a shorter path after the first one
timing = TimingSettings(speed=0.5)
planned = plan(problem, Request("roadmap", Budget(5.0), optimize=shorter, timing=timing))
done = execute_motion(problem, planned.motion, "computed-torque-unknown-load")
print(
    f"margin {planned.margin}; off the path {1e3 * done.off_path_m:.1f} mm, tilt {done.tilt_rad:.3f} rad"
)
print("executed as planned" if not done.faults else done.faults)
