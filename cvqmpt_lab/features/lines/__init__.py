"""Straight lines of the hand through poses, and motions that begin or end on the move.

`follow_lines` plans the lines and certifies them; `along_line` is their constraint, with its proof;
`moving_ends` joins a path to given velocities at its ends.

Command: ``cvqmpt follow poses.csv``, ``cvqmpt plan --start-velocity``. Extra: none.
Page: docs/your_own.md.
"""
