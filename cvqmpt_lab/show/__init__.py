"""Pictures without a display, and recordings for rerun."""
