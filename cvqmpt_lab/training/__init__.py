"""Making of training data, and training of VQ-MPT and MPNet from a folder of such data.

Training needs only torch and numpy. It imports no robot, scene or planner: the folder has joints as
numbers between limits, scenes as parameters of shapes, and kinematics as arrays of a serial chain.
"""
