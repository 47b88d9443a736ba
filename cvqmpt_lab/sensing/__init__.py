"""Cameras, depth images and scans:
from what a depth camera saw, or would see, to a cloud or a scene.
"""
