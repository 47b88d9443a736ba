"""MPNet: its network, and its inference without torch."""
