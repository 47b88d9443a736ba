"""Published numbers, committed results, and their rendering."""
