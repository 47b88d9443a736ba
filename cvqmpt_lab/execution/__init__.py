"""Motions and tasks executed in a physics simulation (MuJoCo, extra `physics`)."""
