"""Motions, tree growth, lazy roadmap and shortcuts on a space's arrays."""
