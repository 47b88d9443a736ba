"""Planners of others: found by name, called under a time limit, their answers checked;
three adapters ship.
"""
