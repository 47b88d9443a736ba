"""The paper's figures as runs."""
