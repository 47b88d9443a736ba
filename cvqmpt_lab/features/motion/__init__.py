"""Timed motions: make them, judge those of others, and record what was proven.

`timing` finds the fastest motion along a path within the limits (a linear program, HiGHS);
`trajectory` is a motion and its files; `motion_check` certifies any motion, with the curves between
its points (`motion_curves`) and the share of every limit that it uses (`limit_use`); `judge` is the
same for chunks of a policy.

Command: ``cvqmpt certify MOTION``, ``cvqmpt plan --trajectory``. Extra: none; `ros` reads bags.
Page: docs/judge_a_motion.md, docs/ros2.md.
"""
