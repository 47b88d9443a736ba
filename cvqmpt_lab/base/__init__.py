"""Files that all others use: errors, files, values, compiled functions."""
