"""Code sequences from any sequence model, by beam search."""
