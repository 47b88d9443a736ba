"""The studio: drag start, goal and obstacles in the browser; the path is planned again.

`studio` is the page, `studio_look` how it draws, `studio_plots` its plots, `studio_planning` its
planning thread, `studio_guard` states who may connect.

Command: ``cvqmpt studio``. Extra: `studio`. Page: docs/commands.md.
"""
