"""Rows of runs, their store, provenance and statistics; independent of robots and planners."""
