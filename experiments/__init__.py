"""Runs of planners over suites, and figures of them."""
