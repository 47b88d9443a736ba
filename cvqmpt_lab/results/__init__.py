"""Rows of runs, their store, provenance and statistics: plain data that knows no robot."""
