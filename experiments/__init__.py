"""Suites and their runner."""
