"""Collision checks of states and motions: compiled and conservative, and exact by coal."""
