"""Methods by name: what to observe, predict, update and search with."""
