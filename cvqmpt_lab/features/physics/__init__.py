"""Execution of motions and tasks in a physics simulation.

`mjcf` writes robot and scene for MuJoCo, `simulation` runs a controller, `execute` states what
happened: the deviation from the plan, contacts, and whether the load arrived.

Command: ``cvqmpt execute``. Extra: `physics`. Page: docs/guarantees.md.
"""
