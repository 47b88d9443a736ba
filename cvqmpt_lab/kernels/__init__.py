"""Compiled inner loops on plain arrays: no robot, scene or problem types in here."""
