"""Training data: scenes, labels in them, datasets in shards, and examples for eyes."""
