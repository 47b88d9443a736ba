"""External planners, each in a process of its own."""
