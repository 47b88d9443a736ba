"""Depth images and clouds of cameras, cleaned and made a map of obstacles.

`depth` reads images and files of cameras, `scan` filters points and makes the map, `plane` finds
the table, `scan_picture` draws what was read.

Command: ``cvqmpt scan``. Extra: none. Page: docs/your_own.md.
"""
