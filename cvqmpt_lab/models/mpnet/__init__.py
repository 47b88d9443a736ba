"""MPNet's network."""
