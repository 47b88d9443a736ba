"""Conservative collision checking: convex pieces, distance grid, separation."""
