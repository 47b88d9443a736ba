"""Training of VQ-MPT and MPNet from a folder of data; needs torch and numpy only.

It imports no robot, scene or planner: the dataset's folder holds joints as numbers between limits,
scenes as shape parameters, and link positions as arrays of a serial chain.
"""
