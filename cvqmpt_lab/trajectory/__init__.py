"""From a path to a motion in time, as fast as the joints allow; imports cvxpy, no other does."""
