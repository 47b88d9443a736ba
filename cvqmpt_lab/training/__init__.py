"""Training of VQ-MPT and MPNet from a folder of paths: torch and numpy only, so that it runs on a
bare GPU machine.

No robot, scene or planner in here: joints come as numbers between limits, scenes as shape
parameters, link positions from the arrays of a serial chain, all out of the dataset's folder.
"""
