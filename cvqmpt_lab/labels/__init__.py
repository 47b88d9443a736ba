"""Training data: random scenes with near-shortest paths or labels on a roadmap, in shards."""
