"""What every file uses: errors, files, values, compiled functions."""
