"""One html file about results: verdicts, tables, plots, rows and where they come from."""
