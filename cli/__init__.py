"""The `cvqmpt` command line: argparse only."""
