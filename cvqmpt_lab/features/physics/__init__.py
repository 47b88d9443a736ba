"""Execution of motions and tasks in a physics simulation (MuJoCo, extra `physics`)."""
