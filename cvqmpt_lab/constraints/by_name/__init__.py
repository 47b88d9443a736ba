"""Constraints by name: the file of NAME has the function NAME, and an EXAMPLE of its fields."""
