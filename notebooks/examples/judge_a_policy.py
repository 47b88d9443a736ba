"""Judge the steps of a policy, each before it is sent; slow down where obstacles are near.

The policy here follows a planned motion and errs once: at 3 s it turns joint 2 downwards.
"""

from cvqmpt_lab import (
    Budget,
    JointState,
    Motion,
    TimingSettings,
    certified_motion,
    judge,
    solve,
    suite_named,
)

import numpy as np

solution = solve(suite_named("place-task").solvable(7), "birrt", Budget(seconds=10.0), seed=0)
problem = solution.problem
plan = certified_motion(problem, solution.path, TimingSettings(speed=0.2))

for begin in np.arange(0.0, plan.duration - 0.3, 1.5):
    times = begin + np.linspace(0.0, 0.3, 16)
    positions = plan.at(times).positions
    if begin == 3.0:
        positions[:, 1] += 2.0 * (times - begin) ** 2
    chunk = Motion(plan.joint_names, positions, times - begin)
    judged = judge(chunk, problem, last=JointState(*plan.at(begin)), exact_clearance=True)
    if judged.certified:  # full speed where 10 mm are free, a tenth at contact
        free = 1e3 * judged.clearance_m
        speed = min(1.0, 0.1 + 0.09 * free)
        print(f"{begin:.1f} s: {free:.1f} mm are free, go on at {speed:.2f} of the speed")
    else:
        print(f"{begin:.1f} s: stop, {judged.first_fault.text}")
