"""Planners behind one Protocol, and path simplification."""
