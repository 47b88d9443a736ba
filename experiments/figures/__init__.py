"""Reproduction of the paper's figures, from runs of the model."""
