"""Clouds and meshes that scenes name by path."""
