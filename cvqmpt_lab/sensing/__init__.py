"""Cameras, depth images and scans: from what a depth camera measures to a cloud or a scene."""
