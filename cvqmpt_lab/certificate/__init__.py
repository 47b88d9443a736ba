"""Certificates of paths and motions, without the planners' code."""
