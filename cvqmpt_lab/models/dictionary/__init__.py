"""Waypoints to codes and codes to Gaussians: stage 1 of VQ-MPT."""
