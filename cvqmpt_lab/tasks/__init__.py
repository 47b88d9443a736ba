"""Tasks of several phases: described, walked through and solved."""
