"""Depth images and clouds of cameras, cleaned and made a map of obstacles.

`depth` reads images and files of cameras, `scan` filters points and makes the map, `plane` finds
the table, `shadow` what bodies hide, `camera_pose` and `depth_forms` what is probably written
wrongly, `scan_picture` draws what was read.

Command: ``cvqmpt scan``. Extra: none. Page: docs/your_own.md.
"""
