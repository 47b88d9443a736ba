"""Promises put to the test: what docs/guarantees.md says, attacked and counted."""
