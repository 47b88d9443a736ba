"""Planners by name and the run of one problem."""
