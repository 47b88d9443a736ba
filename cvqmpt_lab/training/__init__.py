"""Training of VQ-MPT and MPNet from a folder of data, on a bare GPU machine: torch and numpy only.

No robot, scene or planner in here: joints come as numbers between limits, scenes as shape
parameters, link positions from the arrays of a serial chain, all out of the dataset's folder.
"""
