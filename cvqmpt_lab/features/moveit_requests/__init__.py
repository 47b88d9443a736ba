"""Constraints that MoveIt's MotionPlanRequest or Constraints message asks of a motion.

`motion_request` reads a message and judges a motion by it; `euler_bounds` are its orientations.

Command: ``cvqmpt certify MOTION --request R.yaml``. Extra: none. Page: docs/judge_a_motion.md.
"""
