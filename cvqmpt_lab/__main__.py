"""`python -m cvqmpt_lab` runs the command line `cvqmpt`."""

from cvqmpt_lab.cli.main import entry_point

if __name__ == "__main__":
    entry_point()
