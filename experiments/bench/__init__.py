"""What kernels and planners cost on this machine."""
