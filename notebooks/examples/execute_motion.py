"""Execute a certified motion in simulation with a controller that does not know the load."""

from cvqmpt_lab import (
    Budget,
    Margin,
    TimingSettings,
    certified_motion,
    execute_motion,
    solve_with_margin,
    suite_named,
)

problem = suite_named("place-task-with-can").solvable(3)
shorter = Budget(0.5)  # [s] for a shorter path after the first one
solution, kept = solve_with_margin(problem, "roadmap", Budget(5.0), 0, Margin(), optimize=shorter)
motion = certified_motion(solution.problem, solution.path, TimingSettings(speed=0.5))
done = execute_motion(problem, motion, "computed-torque-unknown-load")
print(f"margin {kept}; off the path {1e3 * done.off_path_m:.1f} mm, tilt {done.tilt_rad:.3f} rad")
print("executed as planned" if not done.faults else done.faults)
