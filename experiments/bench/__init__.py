"""Scripts that measure times and prices; their numbers are in docs/performance.md."""
