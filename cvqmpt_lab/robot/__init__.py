"""Robots as data; the door to pinocchio."""
