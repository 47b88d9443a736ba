"""Shapes, scenes and their files, the kitchen and random families of scenes."""
