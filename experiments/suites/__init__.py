"""Which problems and tasks an experiment runs, by name."""
