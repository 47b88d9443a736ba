"""Time-optimal trajectories along a path. The only folder that imports cvxpy."""
