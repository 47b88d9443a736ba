"""Task-space constraints and inverse kinematics by projection."""
