"""From a path to a motion in time, as fast as the joints allow; the door to cvxpy."""
