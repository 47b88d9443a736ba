"""Kinematics, task-space regions and projection onto them."""
