"""Audit of data sets: every episode of a folder is judged for one robot, between its samples too.

`episodes` finds and reads episodes (`lerobot` and `parquet` those of LeRobot), `units` makes
radians of their values, `samples` looks for faults of a recording, `judging` certifies the motion,
`rows` is the table, `run` does it in processes, `page` is the html page.

Command: ``cvqmpt audit FOLDER --robot NAME``. Extra: none; `ros` reads bags. Page: docs/audit.md.
"""
