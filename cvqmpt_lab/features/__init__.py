"""Features beside the core: each imports the core, and other features by their public names."""
