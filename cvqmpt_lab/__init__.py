"""Constrained motion planning with learned sampling dictionaries: a reproducibility toolkit for CVQ-MPT."""
