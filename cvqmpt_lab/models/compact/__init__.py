"""The compact sequence model, its heads and its inference."""
