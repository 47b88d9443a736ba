"""Shapes, scenes and exact collision checking; the door to coal."""
