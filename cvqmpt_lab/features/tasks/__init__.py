"""Tasks of several phases: reach, grasp, open a door, carry, place.

`task` has the phases and their file, `world` the scene between them, `solve` searches over phases:
when one fails, the last one with goals left is planned again.

Command: ``cvqmpt plan multi-sequence``, ``cvqmpt plan T.json``. Extra: none.
Page: docs/your_own.md.
"""
