"""Search on the constraint manifold: trees, roadmaps, shortcuts, goals."""
