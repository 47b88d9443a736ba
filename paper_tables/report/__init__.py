"""One html file that tells everything about results: verdicts, tables, plots, rows and where they come from."""
