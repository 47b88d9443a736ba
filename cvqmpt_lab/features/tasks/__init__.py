"""Tasks of several phases: their files, their states and how they are solved."""
