"""Robots as data, and how pinocchio reads them."""
