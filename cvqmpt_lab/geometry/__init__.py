"""Geometry on plain arrays."""
