"""Training data:
random scenes with labels, in shards, and the examples that the edge validity model learns from.
"""
