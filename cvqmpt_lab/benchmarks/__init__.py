"""Benchmark problems and tasks, by the name of their suite and an index."""
