"""Searching a path on the constraint manifold: queries, proposals, searches, shortening."""
