"""Planners that need a trained network: prediction and search in one, behind the planners' interface."""
